/*
 * The arms' side on Quanser's Stream API: serves one bridge at a time (rule 7 of docs/drivers.md, section QUARC) and
 * connects its commands and states with the state machine of arm_side.h and the calls that read and move the arms.
 */
#ifndef TANDEM_STREAM_SIDE_H
#define TANDEM_STREAM_SIDE_H

#include "arm_side.h"
#include "quanser_stream.h"

/* Time without a command after which a connection that has sent commands is closed, seconds (rule 7). */
#define STREAM_SIDE_IDLE_S 1.0

/* The calls of the arms, which the user of this file fills in. Both must return within the sample. */
struct arm_io {
    /* Measures both arms. Returns false if that fails; the drives then brake. */
    bool (*read)(void *context, struct arm_reading readings[ARM_SIDE_ARMS]);
    /* Makes the drives brake or move until the next call. Returns false if that fails; later calls then brake. */
    bool (*write)(void *context, const struct arm_drives *drives);
    void *context;
};

/* What happened in a sample, for logs. */
enum stream_side_event {
    STREAM_SIDE_NOTHING,
    STREAM_SIDE_CONNECTED,
    /* The connection has ended: by the bridge, by an error, or because it was idle. */
    STREAM_SIDE_DISCONNECTED
};

struct stream_side {
    struct arm_side arms;
    t_stream server;
    t_stream client;
    bool has_client;
    /* Whether the connection has sent a command. */
    bool has_command;
    unsigned n_idle;
    unsigned idle_limit;
    /* Time since the start, seconds: samples times the sample time. */
    double time_s;
    double sample_time_s;
};

/*
 * Listens at `uri`, for example "tcpip://0.0.0.0:18000?nagle='off'". Without that option the stream holds states back.
 * Returns 0, or a negative error: that of the Stream API, or -1 if the sample time is not 0.001 to 0.025 s.
 */
t_error stream_side_open(struct stream_side *side, const char *uri, double sample_time_s);

/* Passes a sample. Call it once per sample time. Never waits. */
enum stream_side_event stream_side_sample(struct stream_side *side, const struct arm_io *io);

/* Brakes the drives and closes all streams. */
void stream_side_close(struct stream_side *side, const struct arm_io *io);

#endif
