#include "stream_side.h"

#include <stddef.h>
#include <string.h>

/* Buffers of one vector each, bytes: nothing queues here, and a vector is accepted or refused as a whole. */
#define SEND_BYTES ((t_int)(ARM_SIDE_STATE_LEN * sizeof(t_double)))
#define RECEIVE_BYTES ((t_int)(ARM_SIDE_COMMAND_LEN * sizeof(t_double)))
/* Most commands in a sample; a bridge sends one. */
#define MAX_COMMANDS 64

t_error stream_side_open(struct stream_side *side, const char *uri, double sample_time_s) {
    memset(side, 0, sizeof *side);
    if (!arm_side_init(&side->arms, sample_time_s)) {
        return -1;
    }
    side->sample_time_s = sample_time_s;
    side->idle_limit = (unsigned)(STREAM_SIDE_IDLE_S / sample_time_s + 0.5);
    return stream_listen(uri, 1, &side->server);
}

/* Ends the connection. The drives brake in the next call of arm_side_sample (rule 1). */
static void drop_client(struct stream_side *side) {
    stream_close(side->client);
    side->has_client = false;
    arm_side_set_connected(&side->arms, false);
}

/* Accepts a bridge if there is none (rule 7). */
static bool accept_client(struct stream_side *side) {
    if (stream_accept(side->server, SEND_BYTES, RECEIVE_BYTES, &side->client) != 0) {
        return false;
    }
    if (stream_set_byte_order(side->client, STREAM_BYTE_ORDER_LITTLE_ENDIAN) != 0) {
        stream_close(side->client);
        return false;
    }
    side->has_client = true;
    side->has_command = false;
    side->n_idle = 0;
    arm_side_set_connected(&side->arms, true);
    return true;
}

/* Takes all commands that have arrived. Returns false if the connection has ended. */
static bool receive_commands(struct stream_side *side) {
    t_double command[ARM_SIDE_COMMAND_LEN];
    side->n_idle++;
    for (int n = 0; n < MAX_COMMANDS; n++) {
        t_int result = stream_receive_double_array(side->client, command, ARM_SIDE_COMMAND_LEN);
        if (result == -QERR_WOULD_BLOCK) {
            break;
        }
        if (result != 1) {
            return false;
        }
        arm_side_receive(&side->arms, command);
        side->has_command = true;
        side->n_idle = 0;
    }
    return !side->has_command || side->n_idle < side->idle_limit;
}

/* Sends the state of this sample, or drops it whole (rule 4). Returns false if the connection has ended. */
static bool send_state(struct stream_side *side, const t_double state[ARM_SIDE_STATE_LEN]) {
    /* What is left of the previous vector goes first. */
    t_error flushed = stream_flush(side->client);
    if (flushed == -QERR_WOULD_BLOCK) {
        return true;
    }
    if (flushed != 0) {
        return false;
    }
    t_int result = stream_send_double_array(side->client, state, ARM_SIDE_STATE_LEN);
    if (result == -QERR_WOULD_BLOCK) {
        return true;
    }
    if (result != 1) {
        return false;
    }
    arm_side_sent(&side->arms);
    flushed = stream_flush(side->client);
    return flushed == 0 || flushed == -QERR_WOULD_BLOCK;
}

enum stream_side_event stream_side_sample(struct stream_side *side, const struct arm_io *io) {
    struct arm_reading readings[ARM_SIDE_ARMS];
    struct arm_drives drives;
    t_double state[ARM_SIDE_STATE_LEN];
    enum stream_side_event event = STREAM_SIDE_NOTHING;

    if (!side->has_client && accept_client(side)) {
        event = STREAM_SIDE_CONNECTED;
    }
    if (side->has_client && !receive_commands(side)) {
        drop_client(side);
        event = STREAM_SIDE_DISCONNECTED;
    }
    memset(readings, 0, sizeof readings);
    bool is_measured = io->read(io->context, readings);
    arm_side_sample(&side->arms, is_measured ? readings : NULL, &drives);
    if (!io->write(io->context, &drives)) {
        arm_side_trip(&side->arms);
    }
    if (side->has_client && is_measured && arm_side_encode(&side->arms, side->time_s, readings, state) &&
        !send_state(side, state)) {
        drop_client(side);
        event = STREAM_SIDE_DISCONNECTED;
    }
    side->time_s += side->sample_time_s;
    return event;
}

void stream_side_close(struct stream_side *side, const struct arm_io *io) {
    struct arm_drives drives;
    arm_side_set_connected(&side->arms, false);
    arm_side_sample(&side->arms, NULL, &drives);
    io->write(io->context, &drives);
    if (side->has_client) {
        stream_close(side->client);
        side->has_client = false;
    }
    stream_close(side->server);
}
