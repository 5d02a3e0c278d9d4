/*
 * Checks of arm_side.c without a network.
 *
 *   check vectors FILE        runs the examples of vectors.txt
 *   check hostile SEED COUNT  passes COUNT samples with random, often malformed commands and measurements, through the
 *                             functions and through arm_side_block, which must agree
 *
 * Exits with 0 if all is well, otherwise prints the first difference and exits with 1.
 */
#include "arm_side.h"

#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define SAMPLE_S 0.01
#define N_READINGS (ARM_SIDE_ARMS * ARM_SIDE_READING_LEN)
#define N_DRIVES (ARM_SIDE_ARMS * (ARM_SIDE_JOINTS + 1))

static void fail(const char *where, const char *what) {
    printf("%s: %s\n", where, what);
    exit(1);
}

static void unpack_readings(const double *numbers, struct arm_reading readings[ARM_SIDE_ARMS]) {
    for (int arm = 0; arm < ARM_SIDE_ARMS; arm++, numbers += ARM_SIDE_READING_LEN) {
        memcpy(readings[arm].angles_rad, numbers, sizeof readings[arm].angles_rad);
        memcpy(readings[arm].rates_radps, numbers + 4, sizeof readings[arm].rates_radps);
        memcpy(readings[arm].torques_nm, numbers + 8, sizeof readings[arm].torques_nm);
        readings[arm].opening = numbers[12];
        readings[arm].has_torques = numbers[13] != 0.0;
        readings[arm].drive_fault = numbers[14] != 0.0;
        readings[arm].contact = numbers[15] != 0.0;
        readings[arm].emergency_stop = numbers[16] != 0.0;
    }
}

/* The arms of a case and the outcome of the last sample. */
struct example {
    struct arm_side side;
    struct arm_drives drives;
    double readings[N_READINGS];
    double state[ARM_SIDE_STATE_LEN];
    bool is_connected;
    bool is_blocked;
    bool has_state;
    /* Changes to the numbers of commands. */
    bool is_changed[ARM_SIDE_COMMAND_LEN];
    double changed[ARM_SIDE_COMMAND_LEN];
};

static void begin_case(struct example *example) {
    memset(example, 0, sizeof *example);
    arm_side_init(&example->side, SAMPLE_S);
}

static void send_command(struct example *example, const double numbers[ARM_SIDE_COMMAND_LEN]) {
    double command[ARM_SIDE_COMMAND_LEN];
    for (int i = 0; i < ARM_SIDE_COMMAND_LEN; i++) {
        command[i] = example->is_changed[i] ? example->changed[i] : numbers[i];
    }
    arm_side_receive(&example->side, command);
}

static void send_short(struct example *example, double number, double order, double rate_radps) {
    double command[ARM_SIDE_COMMAND_LEN] = {ARM_SIDE_COMMAND_MARK, number, number * SAMPLE_S, order};
    if (order == 1.0) {
        for (int i = 4; i < ARM_SIDE_COMMAND_LEN; i++) {
            command[i] = (i - 4) % 5 == 4 ? 0.5 : rate_radps;
        }
    }
    send_command(example, command);
}

static void pass_sample(struct example *example) {
    struct arm_reading readings[ARM_SIDE_ARMS];
    unpack_readings(example->readings, readings);
    arm_side_sample(&example->side, readings, &example->drives);
    example->has_state = arm_side_encode(&example->side, 0.0, readings, example->state) && example->is_connected;
    if (example->has_state && !example->is_blocked) {
        arm_side_sent(&example->side);
    }
}

/* Compares the last sample with "DRIVES FAULT NEWEST". */
static void compare_sample(const struct example *example, const char *where, const char *drives, const char *fault,
                           double newest) {
    if (example->drives.brake != (strcmp(drives, "brake") == 0)) {
        fail(where, example->drives.brake ? "the drives brake" : "the drives do not brake");
    }
    const char *colon = strchr(drives, ':');
    double expected_radps = colon != NULL ? strtod(colon + 1, NULL) : 0.0;
    for (int i = 0; i < ARM_SIDE_ARMS * ARM_SIDE_JOINTS; i++) {
        double rate_radps = example->drives.arms[i / ARM_SIDE_JOINTS].rates_radps[i % ARM_SIDE_JOINTS];
        if ((colon != NULL || example->drives.brake) && rate_radps != expected_radps) {
            fail(where, "another velocity");
        }
    }
    if (example->has_state && (example->state[18] == 1.0) != (strcmp(fault, "fault") == 0)) {
        fail(where, example->state[18] == 1.0 ? "a drive fault" : "no drive fault");
    }
    if (example->has_state && example->state[3] != newest) {
        fail(where, "another newest command");
    }
}

/* Reads `n` numbers from the rest of a line. */
static void read_numbers(const char *where, char *text, double *numbers, int n) {
    for (int i = 0; i < n; i++) {
        char *end = text;
        numbers[i] = strtod(text, &end);
        if (end == text) {
            fail(where, "too few numbers");
        }
        text = end;
    }
}

static void compare_numbers(const char *where, char *text, const double *got, int n) {
    double expected[ARM_SIDE_STATE_LEN];
    read_numbers(where, text, expected, n);
    for (int i = 0; i < n; i++) {
        if (got[i] != expected[i]) {
            printf("%s: number %d is %.17g, expected %.17g\n", where, i, got[i], expected[i]);
            exit(1);
        }
    }
}

static void run_sample(struct example *example, const char *where, const char *text) {
    char drives[32], fault[16], sequence[16];
    int n = 0;
    double newest = 0.0;
    if (sscanf(text, "%d %31s %15s %lf %15s", &n, drives, fault, &newest, sequence) != 5) {
        fail(where, "malformed");
    }
    for (; n > 0; n--) {
        pass_sample(example);
        compare_sample(example, where, drives, fault, newest);
    }
    if (example->has_state != (strcmp(sequence, "none") != 0)) {
        fail(where, example->has_state ? "a state" : "no state");
    }
    if (example->has_state && example->state[1] != strtod(sequence, NULL)) {
        fail(where, "another sequence");
    }
}

static void run_line(struct example *example, const char *where, const char *word, char *rest) {
    double numbers[N_READINGS] = {0.0};
    if (strcmp(word, "case") == 0) {
        begin_case(example);
    } else if (strcmp(word, "connect") == 0 || strcmp(word, "disconnect") == 0) {
        example->is_connected = word[0] == 'c';
        arm_side_set_connected(&example->side, example->is_connected);
    } else if (strcmp(word, "stop") == 0) {
        read_numbers(where, rest, numbers, 1);
        send_short(example, numbers[0], 0.0, 0.0);
    } else if (strcmp(word, "move") == 0) {
        read_numbers(where, rest, numbers, 2);
        send_short(example, numbers[0], 1.0, numbers[1]);
    } else if (strcmp(word, "change") == 0) {
        read_numbers(where, rest, numbers, 2);
        example->is_changed[(int)numbers[0]] = true;
        example->changed[(int)numbers[0]] = numbers[1];
    } else if (strcmp(word, "same") == 0) {
        memset(example->is_changed, 0, sizeof example->is_changed);
    } else if (strcmp(word, "vector") == 0) {
        read_numbers(where, rest, numbers, ARM_SIDE_COMMAND_LEN);
        send_command(example, numbers);
    } else if (strcmp(word, "reading") == 0) {
        read_numbers(where, rest, example->readings, N_READINGS);
    } else if (strcmp(word, "blocked") == 0 || strcmp(word, "free") == 0) {
        example->is_blocked = word[0] == 'b';
    } else if (strcmp(word, "sample") == 0) {
        run_sample(example, where, rest);
    } else if (strcmp(word, "drives") == 0) {
        double got[N_DRIVES];
        for (int i = 0; i < N_DRIVES; i++) {
            const struct arm_drive *arm = &example->drives.arms[i / 5];
            got[i] = i % 5 == 4 ? arm->opening : arm->rates_radps[i % 5];
        }
        compare_numbers(where, rest, got, N_DRIVES);
    } else if (strcmp(word, "state") == 0) {
        compare_numbers(where, rest, example->state, ARM_SIDE_STATE_LEN);
    } else {
        fail(where, "an unknown word");
    }
}

static void run_vectors(const char *path) {
    FILE *file = fopen(path, "r");
    if (file == NULL) {
        fail(path, "cannot be read");
    }
    struct example example;
    char line[1024], where[64];
    int n_lines = 0, n_cases = 0;
    begin_case(&example);
    while (fgets(line, sizeof line, file) != NULL) {
        char word[16];
        int at = 0;
        snprintf(where, sizeof where, "line %d", ++n_lines);
        if (line[0] == '#' || sscanf(line, "%15s%n", word, &at) != 1) {
            continue;
        }
        n_cases += strcmp(word, "case") == 0;
        run_line(&example, where, word, line + at);
    }
    fclose(file);
    printf("%d cases\n", n_cases);
}

static uint64_t random_state;

/* xorshift64*. */
static uint64_t random_bits(void) {
    random_state ^= random_state >> 12;
    random_state ^= random_state << 25;
    random_state ^= random_state >> 27;
    return random_state * UINT64_C(2685821657736338717);
}

static unsigned random_below(unsigned n) {
    return (unsigned)((random_bits() >> 33) % n);
}

static double hostile_number(void) {
    static const double SPECIAL[] = {0.0, -0.0, 1.0, -1.0, 0.5, 2.0, 1e308, -1e308, 5e-324, 9007199254740993.0};
    uint64_t bits = random_bits();
    double number;
    switch (random_below(4)) {
    case 0:
        return SPECIAL[random_below(sizeof SPECIAL / sizeof SPECIAL[0])];
    case 1:
        return random_below(2) == 0 ? (double)NAN : (double)INFINITY;
    case 2:
        return (double)(int64_t)bits / 9223372036854775808.0;
    default:
        memcpy(&number, &bits, sizeof number);
        return number;
    }
}

/* Fills a command that is often well-formed, so that the arms move at times. */
static void hostile_command(double command[ARM_SIDE_COMMAND_LEN], unsigned number) {
    command[0] = ARM_SIDE_COMMAND_MARK;
    command[1] = number;
    command[2] = number * SAMPLE_S;
    command[3] = random_below(3) == 0 ? 0.0 : 1.0;
    for (int i = 4; i < ARM_SIDE_COMMAND_LEN; i++) {
        command[i] = (double)random_below(1001) / 1000.0;
    }
    for (unsigned n = random_below(6); n > 3; n--) {
        command[random_below(ARM_SIDE_COMMAND_LEN)] = hostile_number();
    }
}

static void check_drives(const struct arm_drives *drives) {
    for (int i = 0; i < ARM_SIDE_ARMS * ARM_SIDE_JOINTS; i++) {
        double rate_radps = drives->arms[i / ARM_SIDE_JOINTS].rates_radps[i % ARM_SIDE_JOINTS];
        if (!(fabs(rate_radps) <= (drives->brake ? 0.0 : ARM_SIDE_MAX_RATE_RADPS))) {
            fail("hostile", "a velocity out of range");
        }
    }
    for (int arm = 0; arm < ARM_SIDE_ARMS; arm++) {
        if (!(drives->arms[arm].opening >= 0.0 && drives->arms[arm].opening <= 1.0)) {
            fail("hostile", "an opening out of range");
        }
    }
}

static void run_hostile(uint64_t seed, long n_samples) {
    struct arm_side side;
    struct arm_drives drives;
    struct arm_reading readings[ARM_SIDE_ARMS];
    double numbers[N_READINGS] = {0.0}, command[ARM_SIDE_COMMAND_LEN] = {0.0}, state[ARM_SIDE_STATE_LEN];
    double rates[ARM_SIDE_ARMS * ARM_SIDE_JOINTS], openings[ARM_SIDE_ARMS], brake, send;
    double block_state[ARM_SIDE_STATE_LEN];
    bool was_sent = false;
    long n_followed = 0, n_unsent = 0;
    random_state = seed | 1;
    arm_side_init(&side, SAMPLE_S);
    for (long n = 0; n < n_samples; n++) {
        bool is_connected = random_below(50) != 0, is_new = random_below(4) != 0;
        double stamp_s = random_below(100) == 0 ? hostile_number() : (double)n * SAMPLE_S;
        for (int i = 0; i < N_READINGS; i++) {
            numbers[i] = random_below(3000) == 0 ? hostile_number() : 0.25 * i;
        }
        unpack_readings(numbers, readings);
        arm_side_set_connected(&side, is_connected);
        if (is_new) {
            hostile_command(command, (unsigned)n);
            if (is_connected) {
                arm_side_receive(&side, command);
            }
        }
        arm_side_sample(&side, readings, &drives);
        bool has_state = arm_side_encode(&side, stamp_s, readings, state);
        check_drives(&drives);
        arm_side_block(n == 0, SAMPLE_S, stamp_s, command, is_new, is_connected, was_sent, numbers, rates, openings,
                       &brake, block_state, &send);
        bool agrees = (brake == 1.0) == drives.brake && (send == 1.0) == has_state;
        for (int i = 0; i < ARM_SIDE_ARMS * ARM_SIDE_JOINTS; i++) {
            agrees = agrees && rates[i] == drives.arms[i / ARM_SIDE_JOINTS].rates_radps[i % ARM_SIDE_JOINTS];
        }
        if (!agrees || (has_state && memcmp(state, block_state, sizeof state) != 0)) {
            fail("hostile", "arm_side_block gives something else");
        }
        for (int i = 0; has_state && i < ARM_SIDE_STATE_LEN; i++) {
            if (!isfinite(state[i])) {
                fail("hostile", "a number of the state is not finite");
            }
        }
        was_sent = has_state && is_connected && random_below(5) != 0;
        if (was_sent) {
            arm_side_sent(&side);
        }
        n_followed += !drives.brake;
        n_unsent += !has_state;
    }
    printf("%ld of %ld samples followed, %ld without a state\n", n_followed, n_samples, n_unsent);
}

int main(int argc, char **argv) {
    if (argc == 3 && strcmp(argv[1], "vectors") == 0) {
        run_vectors(argv[2]);
    } else if (argc == 4 && strcmp(argv[1], "hostile") == 0) {
        run_hostile(strtoull(argv[2], NULL, 10), atol(argv[3]));
    } else {
        fail("check", "expected vectors FILE or hostile SEED COUNT");
    }
    return 0;
}
