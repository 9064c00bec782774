/* Example joint controller over Modbus TCP with libmodbus: holds the arm and moves it between two poses.
 *
 *     gcc -O2 -o hold_position hold_position.c $(pkg-config --cflags --libs libmodbus) -lm
 *     ./hold_position 127.0.0.1 5020 16
 *
 * Each cycle reads four positions, computes four torques, writes them in one request, and waits for an absolute
 * deadline, so the period does not drift. The exit code is 0 if the arm is at its goal at the end.
 */
#define _POSIX_C_SOURCE 200809L
#include <errno.h>
#include <math.h>
#include <modbus.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

enum { JOINTS = 4, POSES = 2 };

static const double PERIOD = 0.02;     /* period of the control cycle, s */
static const double MOVE_EVERY = 4.0;  /* s in each pose */
static const double POSE[POSES][JOINTS] = {{30, -45, 50, 20}, {-20, 60, 120, -30}}; /* degrees, degrees, mm, degrees */

/* Gains: N·m per degree (N per mm) of error, and N·m per degree/s (N per mm/s) of speed. */
static const double KP[JOINTS] = {0.25, 0.25, 0.03, 0.004};
static const double KD[JOINTS] = {0.04, 0.03, 0.002, 0.0005};
/* Joint 3 carries the quill and counts positive downwards: an upward force compensates the weight. */
static const double GRAVITY[JOINTS] = {0, 0, -0.5 * 9.81, 0};
/* Limits of the error, so that the arm does not accelerate too much toward a distant goal. */
static const double MAX_ERROR[JOINTS] = {30, 30, 40, 60};

static double limit(double value, double bound)
{
    return fmax(-bound, fmin(bound, value));
}

static double seconds(struct timespec t)
{
    return (double)t.tv_sec + (double)t.tv_nsec * 1e-9;
}

int main(int argc, char **argv)
{
    const char *host = argc > 1 ? argv[1] : "127.0.0.1";
    int port = argc > 2 ? atoi(argv[2]) : 5020;
    double duration = argc > 3 ? atof(argv[3]) : 16.0;
    modbus_t *rig = modbus_new_tcp(host, port);
    if (rig == NULL || modbus_connect(rig) == -1) {
        fprintf(stderr, "can't connect to a rig at %s:%d: %s\n", host, port, modbus_strerror(errno));
        return 3;
    }

    struct timespec due, now;
    double before[JOINTS], speed[JOINTS] = {0}, error[JOINTS] = {0};
    int first = 1;
    clock_gettime(CLOCK_MONOTONIC, &due);
    double begin = seconds(due);
    for (;;) {
        clock_gettime(CLOCK_MONOTONIC, &now);
        double time = seconds(now) - begin;
        if (time >= duration) break;

        uint16_t words[JOINTS];
        if (modbus_read_registers(rig, 4, JOINTS, words) == -1) { /* registers 5-8 */
            fprintf(stderr, "reading failed: %s\n", modbus_strerror(errno));
            return 3;
        }
        const double *goal = POSE[(int)(time / MOVE_EVERY) % POSES];
        for (int j = 0; j < JOINTS; j++) {
            double position = (int16_t)words[j] / 100.0;
            /* The registers have a resolution of 0.01, so the difference quotient is filtered. */
            if (!first) speed[j] = 0.5 * speed[j] + 0.5 * (position - before[j]) / PERIOD;
            before[j] = position;
            error[j] = goal[j] - position;
            double torque = KP[j] * limit(error[j], MAX_ERROR[j]) - KD[j] * speed[j] + GRAVITY[j];
            words[j] = (uint16_t)(int16_t)lround(limit(1000 * torque, 32767));
        }
        first = 0;
        if (modbus_write_registers(rig, 0, JOINTS, words) == -1) { /* registers 1-4 */
            fprintf(stderr, "writing failed: %s\n", modbus_strerror(errno));
            return 3;
        }

        due.tv_nsec += (long)(PERIOD * 1e9);
        if (due.tv_nsec >= 1000000000L) {
            due.tv_nsec -= 1000000000L;
            due.tv_sec++;
        }
        clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &due, NULL);
    }

    uint16_t rest[JOINTS] = {0};
    modbus_write_registers(rig, 0, JOINTS, rest);
    modbus_close(rig);
    modbus_free(rig);
    double worst = 0;
    printf("error at the end:");
    for (int j = 0; j < JOINTS; j++) {
        printf(" %+.2f", error[j]);
        worst = fmax(worst, fabs(error[j]));
    }
    printf("\n");
    return worst < 2.0 ? 0 : 1;
}
