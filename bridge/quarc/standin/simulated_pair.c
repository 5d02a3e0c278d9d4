/*
 * Two simulated arms behind stream_side.c, to try the arms' side without QUARC and without arms. The joints follow
 * their commanded velocities with a lag; nothing else is simulated.
 *
 *   simulated_pair [--uri URI] [--send-bytes N] [--real-time] [ANGLE ...]
 *
 * The angles are those of joints 1 to 4 of both arms, radians. The program prints its address and then, with
 * --real-time, passes a sample every 10 ms and prints what happens. Without it, time passes on request: for each line
 * "sample N" on standard input the program passes N samples and prints one line:
 *
 *   time_s n_connected n_disconnected brake fastest_commanded fastest angle*8 opening*2
 *
 * "sensors off" lets the measurement of the arms fail from then on, "drives off" their commands; "on" ends that.
 */
#define _POSIX_C_SOURCE 200809L

#include "standin.h"
#include "stream_side.h"

#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <time.h>

#define SAMPLE_S 0.01
/* Lag of the velocities behind the commanded ones, seconds. */
#define LAG_S 0.025
/* Deceleration of braking drives: from 0.84 rad/s to rest in 50 ms, radians per second squared. */
#define BRAKE_RADPS2 16.8
/* Change of a gripper's opening in a second. */
#define OPENING_PER_S 2.0
/* Speed below which a joint counts as resting, radians per second. */
#define REST_RADPS 1e-3

struct pair {
    struct arm_reading arms[ARM_SIDE_ARMS];
    struct arm_drives drives;
    bool has_sensors;
    /* Whether the drives take commands; otherwise they brake. */
    bool has_drives;
};

static bool read_pair(void *context, struct arm_reading readings[ARM_SIDE_ARMS]) {
    const struct pair *pair = context;
    memcpy(readings, pair->arms, sizeof pair->arms);
    return pair->has_sensors;
}

/* Moves `value` towards `goal` by `most` at most. */
static double approach(double value, double goal, double most) {
    return fabs(goal - value) <= most ? goal : value + (goal > value ? most : -most);
}

static bool write_pair(void *context, const struct arm_drives *drives) {
    struct pair *pair = context;
    const bool brake = drives->brake || !pair->has_drives;
    pair->drives = *drives;
    for (int arm = 0; arm < ARM_SIDE_ARMS; arm++) {
        struct arm_reading *now = &pair->arms[arm];
        for (int joint = 0; joint < ARM_SIDE_JOINTS; joint++) {
            double *rate = &now->rates_radps[joint];
            if (brake) {
                *rate = approach(*rate, 0.0, BRAKE_RADPS2 * SAMPLE_S);
            } else {
                *rate += (drives->arms[arm].rates_radps[joint] - *rate) * SAMPLE_S / (LAG_S + SAMPLE_S);
            }
            now->angles_rad[joint] += *rate * SAMPLE_S;
        }
        if (!brake) {
            now->opening = approach(now->opening, drives->arms[arm].opening, OPENING_PER_S * SAMPLE_S);
        }
    }
    return pair->has_drives;
}

static double fastest(const struct pair *pair, bool commanded) {
    double most = 0.0;
    for (int arm = 0; arm < ARM_SIDE_ARMS; arm++) {
        const double *rates = commanded ? pair->drives.arms[arm].rates_radps : pair->arms[arm].rates_radps;
        for (int joint = 0; joint < ARM_SIDE_JOINTS; joint++) {
            most = fmax(most, fabs(rates[joint]));
        }
    }
    return most;
}

/* Passes samples as lines on standard input request them. */
static void run_on_request(struct stream_side *side, const struct arm_io *io, struct pair *pair) {
    char line[64];
    unsigned n_connected = 0, n_disconnected = 0;
    while (fgets(line, sizeof line, stdin) != NULL) {
        unsigned n_samples = 0;
        if (strncmp(line, "sensors", 7) == 0) {
            pair->has_sensors = strstr(line, "off") == NULL;
        } else if (strncmp(line, "drives", 6) == 0) {
            pair->has_drives = strstr(line, "off") == NULL;
        } else if (sscanf(line, "sample %u", &n_samples) != 1) {
            break;
        }
        for (; n_samples > 0; n_samples--) {
            enum stream_side_event event = stream_side_sample(side, io);
            n_connected += event == STREAM_SIDE_CONNECTED;
            n_disconnected += event == STREAM_SIDE_DISCONNECTED;
        }
        printf("%.3f %u %u %d %.9f %.9f", side->time_s, n_connected, n_disconnected, pair->drives.brake,
               fastest(pair, true), fastest(pair, false));
        for (int i = 0; i < ARM_SIDE_ARMS * ARM_SIDE_JOINTS; i++) {
            printf(" %.9f", pair->arms[i / ARM_SIDE_JOINTS].angles_rad[i % ARM_SIDE_JOINTS]);
        }
        printf(" %.9f %.9f\n", pair->arms[0].opening, pair->arms[1].opening);
        fflush(stdout);
    }
}

/* Passes a sample every 10 ms until the process is killed. */
static void run_in_real_time(struct stream_side *side, const struct arm_io *io, struct pair *pair) {
    struct timespec next;
    bool was_braking = true, was_resting = true;
    clock_gettime(CLOCK_MONOTONIC, &next);
    for (;;) {
        double at_s = side->time_s;
        enum stream_side_event event = stream_side_sample(side, io);
        bool is_resting = fastest(pair, false) < REST_RADPS;
        if (event != STREAM_SIDE_NOTHING) {
            printf("%.2f s: %s\n", at_s, event == STREAM_SIDE_CONNECTED ? "connected" : "disconnected");
        }
        if (pair->drives.brake != was_braking) {
            printf("%.2f s: the drives %s\n", at_s, pair->drives.brake ? "brake" : "follow commands");
        }
        if (is_resting != was_resting) {
            printf("%.2f s: the arms %s\n", at_s, is_resting ? "are at rest" : "move");
        }
        fflush(stdout);
        was_braking = pair->drives.brake;
        was_resting = is_resting;
        next.tv_nsec += (long)(SAMPLE_S * 1e9);
        if (next.tv_nsec >= 1000000000L) {
            next.tv_nsec -= 1000000000L;
            next.tv_sec++;
        }
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &next, NULL);
    }
}

int main(int argc, char **argv) {
    const char *uri = "tcpip://localhost:18000?nagle='off'";
    /* Both tools 5 cm above their workspaces: the start of deploy/first-motion.json. */
    double angles_rad[ARM_SIDE_ARMS * ARM_SIDE_JOINTS] = {-0.026595, 1.931844, 5.078557, 3.115926,
                                                          -0.026595, 1.931844, 5.078557, 3.115926};
    int n_angles = 0;
    bool real_time = false;
    for (int i = 1; i < argc; i++) {
        if (strcmp(argv[i], "--uri") == 0 && i + 1 < argc) {
            uri = argv[++i];
        } else if (strcmp(argv[i], "--send-bytes") == 0 && i + 1 < argc) {
            standin_limit_socket(atoi(argv[++i]));
        } else if (strcmp(argv[i], "--real-time") == 0) {
            real_time = true;
        } else if (n_angles < ARM_SIDE_ARMS * ARM_SIDE_JOINTS) {
            angles_rad[n_angles++] = atof(argv[i]);
        }
    }
    struct pair pair;
    memset(&pair, 0, sizeof pair);
    pair.has_sensors = pair.has_drives = true;
    for (int i = 0; i < ARM_SIDE_ARMS * ARM_SIDE_JOINTS; i++) {
        pair.arms[i / ARM_SIDE_JOINTS].angles_rad[i % ARM_SIDE_JOINTS] = angles_rad[i];
    }
    pair.arms[0].opening = pair.arms[1].opening = 0.5;

    struct stream_side side;
    const struct arm_io io = {read_pair, write_pair, &pair};
    t_error error = stream_side_open(&side, uri, SAMPLE_S);
    if (error != 0) {
        fprintf(stderr, "cannot listen at %s: error %d\n", uri, error);
        return 1;
    }
    printf("listening on 127.0.0.1:%d\n", standin_port(side.server));
    fflush(stdout);
    if (real_time) {
        run_in_real_time(&side, &io, &pair);
    } else {
        run_on_request(&side, &io, &pair);
    }
    stream_side_close(&side, &io);
    return 0;
}
