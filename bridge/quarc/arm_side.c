#include "arm_side.h"

#include <math.h>
#include <stddef.h>
#include <string.h>

#if (defined(__FINITE_MATH_ONLY__) && __FINITE_MATH_ONLY__) || defined(_M_FP_FAST)
#error "compile without -ffast-math or /fp:fast: rule 2 needs numbers that are not finite to be recognised"
#endif

/* The largest count that doubles represent exactly. */
#define LARGEST_COUNT 9007199254740992.0
/* The layout of both vectors: a head of 4 numbers, then one block per arm. */
#define HEAD_LEN 4
#define COMMAND_BLOCK_LEN (ARM_SIDE_JOINTS + 1)

static const struct arm_drives BRAKE = {true, {{{0.0, 0.0, 0.0, 0.0}, 0.0}, {{0.0, 0.0, 0.0, 0.0}, 0.0}}};

static bool all_finite(const double *numbers, size_t n) {
    for (size_t i = 0; i < n; i++) {
        if (!isfinite(numbers[i])) {
            return false;
        }
    }
    return true;
}

static bool is_count(double number) {
    return number >= 0.0 && number <= LARGEST_COUNT && floor(number) == number;
}

/* Rule 2: whether a vector is a command. */
static bool is_well_formed(const double command[ARM_SIDE_COMMAND_LEN]) {
    if (!all_finite(command, ARM_SIDE_COMMAND_LEN) || command[0] != ARM_SIDE_COMMAND_MARK || !is_count(command[1])) {
        return false;
    }
    if (command[3] == 0.0) {
        return true;
    }
    if (command[3] != 1.0) {
        return false;
    }
    for (int arm = 0; arm < ARM_SIDE_ARMS; arm++) {
        const double *block = command + HEAD_LEN + arm * COMMAND_BLOCK_LEN;
        for (int joint = 0; joint < ARM_SIDE_JOINTS; joint++) {
            if (fabs(block[joint]) > ARM_SIDE_MAX_RATE_RADPS) {
                return false;
            }
        }
        if (block[ARM_SIDE_JOINTS] < 0.0 || block[ARM_SIDE_JOINTS] > 1.0) {
            return false;
        }
    }
    return true;
}

bool arm_side_init(struct arm_side *side, double sample_time_s) {
    memset(side, 0, sizeof *side);
    side->is_tripped = true;
    side->ordered = BRAKE;
    if (!(sample_time_s >= 0.001 && sample_time_s <= 0.025)) {
        return false;
    }
    side->silent_limit = (unsigned)(ARM_SIDE_SILENCE_S / sample_time_s + 0.5);
    return true;
}

void arm_side_set_connected(struct arm_side *side, bool is_connected) {
    if (side->is_connected == is_connected) {
        return;
    }
    side->is_connected = is_connected;
    side->is_tripped = true;
    side->n_silent = 0;
    side->newest = 0.0;
    side->n_sent = 0.0;
    side->ordered = BRAKE;
}

void arm_side_trip(struct arm_side *side) {
    side->is_tripped = true;
}

bool arm_side_receive(struct arm_side *side, const double command[ARM_SIDE_COMMAND_LEN]) {
    if (!side->is_connected || !is_well_formed(command)) {
        side->is_tripped = true;
        return false;
    }
    if (command[3] == 0.0) {
        /* Rule 3: a stop counts under any number. */
        side->ordered = BRAKE;
        side->is_tripped = false;
    } else if (side->is_tripped || command[1] == side->newest) {
        /* Rule 1: drives that braked by themselves wait for a stop, and a repeated number is no new command. */
        return true;
    } else {
        side->ordered.brake = false;
        for (int arm = 0; arm < ARM_SIDE_ARMS; arm++) {
            const double *block = command + HEAD_LEN + arm * COMMAND_BLOCK_LEN;
            memcpy(side->ordered.arms[arm].rates_radps, block, sizeof side->ordered.arms[arm].rates_radps);
            side->ordered.arms[arm].opening = block[ARM_SIDE_JOINTS];
        }
    }
    side->newest = command[1];
    side->n_silent = 0;
    return true;
}

static bool is_measured(const struct arm_reading *readings) {
    for (int arm = 0; arm < ARM_SIDE_ARMS; arm++) {
        const struct arm_reading *reading = &readings[arm];
        if (!all_finite(reading->angles_rad, ARM_SIDE_JOINTS) || !all_finite(reading->rates_radps, ARM_SIDE_JOINTS) ||
            !isfinite(reading->opening) ||
            (reading->has_torques && !all_finite(reading->torques_nm, ARM_SIDE_JOINTS))) {
            return false;
        }
    }
    return true;
}

void arm_side_sample(struct arm_side *side, const struct arm_reading readings[ARM_SIDE_ARMS],
                     struct arm_drives *drives) {
    /* Rule 1: silence, a lost connection. Rule 2: a failed measurement. */
    if (!side->is_connected || side->n_silent >= side->silent_limit || readings == NULL || !is_measured(readings)) {
        side->is_tripped = true;
    } else {
        side->n_silent++;
    }
    *drives = side->is_tripped ? BRAKE : side->ordered;
}

static double flag(bool is_set) {
    return is_set ? 1.0 : 0.0;
}

bool arm_side_encode(const struct arm_side *side, double stamp_s, const struct arm_reading readings[ARM_SIDE_ARMS],
                     double state[ARM_SIDE_STATE_LEN]) {
    memset(state, 0, ARM_SIDE_STATE_LEN * sizeof *state);
    if (!isfinite(stamp_s) || readings == NULL || !is_measured(readings)) {
        return false;
    }
    state[0] = ARM_SIDE_STATE_MARK;
    state[1] = side->n_sent + 1.0;
    state[2] = stamp_s;
    state[3] = side->newest;
    for (int arm = 0; arm < ARM_SIDE_ARMS; arm++) {
        const struct arm_reading *reading = &readings[arm];
        double *block = state + HEAD_LEN + arm * ARM_SIDE_READING_LEN;
        memcpy(block, reading->angles_rad, sizeof reading->angles_rad);
        memcpy(block + 4, reading->rates_radps, sizeof reading->rates_radps);
        if (reading->has_torques) {
            memcpy(block + 8, reading->torques_nm, sizeof reading->torques_nm);
        }
        block[12] = reading->opening;
        block[13] = flag(reading->has_torques);
        block[14] = flag(reading->drive_fault || side->is_tripped);
        block[15] = flag(reading->contact);
        block[16] = flag(reading->emergency_stop);
    }
    return true;
}

void arm_side_sent(struct arm_side *side) {
    side->n_sent += 1.0;
}

/* Flags that are not numbers count as set: a fault is rather reported than missed. */
static void unpack(const double block[ARM_SIDE_READING_LEN], struct arm_reading *reading) {
    memcpy(reading->angles_rad, block, sizeof reading->angles_rad);
    memcpy(reading->rates_radps, block + 4, sizeof reading->rates_radps);
    memcpy(reading->torques_nm, block + 8, sizeof reading->torques_nm);
    reading->opening = block[12];
    reading->has_torques = block[13] != 0.0;
    reading->drive_fault = block[14] != 0.0;
    reading->contact = block[15] != 0.0;
    reading->emergency_stop = block[16] != 0.0;
}

void arm_side_block(double is_first, double sample_time_s, double stamp_s, const double received[ARM_SIDE_COMMAND_LEN],
                    double is_new, double is_connected, double was_sent,
                    const double readings[ARM_SIDE_ARMS * ARM_SIDE_READING_LEN],
                    double rates[ARM_SIDE_ARMS * ARM_SIDE_JOINTS], double openings[ARM_SIDE_ARMS], double *brake,
                    double state[ARM_SIDE_STATE_LEN], double *send) {
    static struct arm_side side;
    struct arm_reading measured[ARM_SIDE_ARMS];
    struct arm_drives drives;

    if (is_first != 0.0 || side.silent_limit == 0) {
        arm_side_init(&side, sample_time_s);
    } else if (was_sent != 0.0 && side.is_connected) {
        arm_side_sent(&side);
    }
    arm_side_set_connected(&side, is_connected == 1.0);
    if (is_new != 0.0 && side.is_connected) {
        arm_side_receive(&side, received);
    }
    for (int arm = 0; arm < ARM_SIDE_ARMS; arm++) {
        unpack(readings + arm * ARM_SIDE_READING_LEN, &measured[arm]);
    }
    arm_side_sample(&side, measured, &drives);
    for (int arm = 0; arm < ARM_SIDE_ARMS; arm++) {
        memcpy(rates + arm * ARM_SIDE_JOINTS, drives.arms[arm].rates_radps, sizeof drives.arms[arm].rates_radps);
        openings[arm] = drives.arms[arm].opening;
    }
    *brake = flag(drives.brake);
    *send = flag(arm_side_encode(&side, stamp_s, measured, state));
}
