/*
 * The arms' side of the bridge behind QUARC: decodes commands, decides whether the drives move or brake, and encodes
 * states. It implements the rules of docs/drivers.md, section QUARC; comments name the rule.
 *
 * C99 without input, output, clocks or memory allocation. One thread owns a `struct arm_side`.
 *
 * In each sample call, in this order:
 *
 *   1. arm_side_set_connected   whether a bridge is connected
 *   2. arm_side_receive         once for each command that has arrived
 *   3. arm_side_sample          gives the velocities for this sample
 *   4. arm_side_encode          gives the state to send
 *   5. arm_side_sent            if the stream has accepted the state
 */
#ifndef TANDEM_ARM_SIDE_H
#define TANDEM_ARM_SIDE_H

#include <stdbool.h>

#define ARM_SIDE_ARMS 2
#define ARM_SIDE_JOINTS 4
/* Doubles in a command: 4 and, for each arm, 4 velocities and an opening. */
#define ARM_SIDE_COMMAND_LEN 14
/* Doubles in a state: 4 and, for each arm, the 17 of a reading. */
#define ARM_SIDE_STATE_LEN 38
#define ARM_SIDE_READING_LEN 17

/* First numbers of commands and states. */
#define ARM_SIDE_COMMAND_MARK 20001.0
#define ARM_SIDE_STATE_MARK 20002.0

/* Time without a new command after which the drives brake, seconds (rule 1). */
#define ARM_SIDE_SILENCE_S 0.050
/* Highest velocity that a command may contain, radians per second (rule 2). A Mico's fastest joint turns at 0.84. */
#define ARM_SIDE_MAX_RATE_RADPS 1.0

/* The measurements of one arm. Angles follow Kinova's convention: a stretched arm has joints 2 and 3 at pi. */
struct arm_reading {
    double angles_rad[ARM_SIDE_JOINTS];
    double rates_radps[ARM_SIDE_JOINTS];
    /* Torques without those that carry the arm itself, newton metres; ignored unless `has_torques` (rule 6). */
    double torques_nm[ARM_SIDE_JOINTS];
    /* Opening of the gripper: 0 closed, 1 open. */
    double opening;
    bool has_torques;
    bool drive_fault;
    bool contact;
    bool emergency_stop;
};

/* What the drives of one arm do until the next sample. */
struct arm_drive {
    double rates_radps[ARM_SIDE_JOINTS];
    /* Desired opening of the gripper, 0 to 1. Without meaning while the drives brake: the gripper then stays. */
    double opening;
};

/* What all drives do until the next sample. */
struct arm_drives {
    /* Brake as fast as possible and hold the position. All rates are 0. */
    bool brake;
    struct arm_drive arms[ARM_SIDE_ARMS];
};

/* The state machine. Only the functions below change its fields. */
struct arm_side {
    /* Samples without a new command after which the drives brake. */
    unsigned silent_limit;
    bool is_connected;
    /* Whether the drives have braked by themselves and wait for a stop command (rules 1 and 2). */
    bool is_tripped;
    /* Samples since the number of the command changed. */
    unsigned n_silent;
    /* Number of the newest command that the drives follow, 0 before the first (rule 5). */
    double newest;
    /* Vectors that the stream has accepted on this connection (rule 4). */
    double n_sent;
    /* The order of the newest command. */
    struct arm_drives ordered;
};

/*
 * Prepares the state machine for samples of `sample_time_s` seconds, 0.001 to 0.025. The drives brake until a bridge
 * has sent a stop command. Returns false, and prepares drives that brake for ever, if the sample time is not allowed.
 */
bool arm_side_init(struct arm_side *side, double sample_time_s);

/*
 * Reports whether a bridge is connected. Each loss of a connection and each new one stops the drives (rule 1), and
 * sequence and newest command start again (rules 4 and 5). Call it with false between two connections.
 */
void arm_side_set_connected(struct arm_side *side, bool is_connected);

/* Trips the drives, for example because a call of the arms has failed (rule 2). */
void arm_side_trip(struct arm_side *side);

/*
 * Takes a command that has arrived. Returns whether it was well-formed; if not, the drives brake and report a fault
 * (rule 2).
 */
bool arm_side_receive(struct arm_side *side, const double command[ARM_SIDE_COMMAND_LEN]);

/*
 * Passes a sample and gives what the drives do until the next one. `readings` are the arms as measured in this sample;
 * NULL, or a number that is not finite, means that the measurement has failed and trips the drives (rule 2).
 */
void arm_side_sample(struct arm_side *side, const struct arm_reading readings[ARM_SIDE_ARMS],
                     struct arm_drives *drives);

/*
 * Encodes the state of this sample under the next number of the sequence. `stamp_s` is the time of the measurement by
 * the arms' clock. Returns false if a number is not finite; such a state must not be sent.
 */
bool arm_side_encode(const struct arm_side *side, double stamp_s, const struct arm_reading readings[ARM_SIDE_ARMS],
                     double state[ARM_SIDE_STATE_LEN]);

/* Reports that the stream has accepted the encoded state whole. Do not call it if the send would block (rule 4). */
void arm_side_sent(struct arm_side *side);

/*
 * The same as one function for a Simulink block: signals are doubles, flags are 0 or not 0, and the state machine is a
 * static variable, so a program contains one pair of arms. `is_first` is not 0 in the first sample of a run.
 *
 *   received      output `rcv` of the Stream Server block in the previous sample, 14 doubles
 *   is_new        its output `new`
 *   is_connected  whether its output `state` was "connected"
 *   was_sent      its output `sent`: whether it has accepted the state of the previous sample
 *   readings      of each arm 4 angles, 4 rates, 4 torques, opening, has torques, drive fault, contact, emergency stop
 *   rates         gives 4 rates of each arm, radians per second
 *   openings      gives the openings of the grippers; without meaning while `brake` is 1
 *   brake         gives 1 where the drives brake and hold their position, else 0
 *   state         gives input `snd` of the block, 38 doubles
 *   send          gives its input `en`: 1 to send, 0 if the measurement has failed
 */
void arm_side_block(double is_first, double sample_time_s, double stamp_s, const double received[ARM_SIDE_COMMAND_LEN],
                    double is_new, double is_connected, double was_sent,
                    const double readings[ARM_SIDE_ARMS * ARM_SIDE_READING_LEN],
                    double rates[ARM_SIDE_ARMS * ARM_SIDE_JOINTS], double openings[ARM_SIDE_ARMS], double *brake,
                    double state[ARM_SIDE_STATE_LEN], double *send);

#endif
