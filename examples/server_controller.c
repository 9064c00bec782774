/* Example joint controller that is a Modbus server, as a PLC is, with libmodbus: the rig connects to it.
 *
 *     gcc -O2 -o server_controller server_controller.c $(pkg-config --cflags --libs libmodbus) -lm
 *     ./server_controller 127.0.0.1 5502 16
 *     hilrig up --controller 127.0.0.1:5502
 *
 * The rig writes the positions to holding registers 4-7 and reads the torques from 0-3, and the magnet from coil 0. With
 * echo = 9 in [rigs.registers] it also writes the step number to 8, and the program copies it to 9. The program runs
 * every 10 ms, between two requests. The exit code is 0 if the arm is at its goal at the end.
 */
#define _POSIX_C_SOURCE 200809L
#include <errno.h>
#include <math.h>
#include <modbus.h>
#include <poll.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>
#include <unistd.h>

enum { JOINTS = 4, POSES = 2, TORQUES = 0, POSITIONS = 4, STEP = 8, ECHO = 9, REGISTERS = 16 };

static const double PERIOD = 0.01;     /* period of the program, s: half a step of the simulation */
static const double MOVE_EVERY = 4.0;  /* s in each pose */
static const double POSE[POSES][JOINTS] = {{30, -45, 50, 20}, {-20, 60, 120, -30}}; /* degrees, degrees, mm, degrees */

/* Gains: N·m per degree (N per mm) of error, and N·m per degree/s (N per mm/s) of speed. */
static const double KP[JOINTS] = {0.25, 0.25, 0.03, 0.004};
static const double KD[JOINTS] = {0.04, 0.03, 0.002, 0.0005};
/* Joint 3 carries the quill and counts positive downwards: an upward force compensates the weight. */
static const double GRAVITY[JOINTS] = {0, 0, -0.5 * 9.81, 0};
/* Limits of the error, so that the arm does not accelerate too much toward a distant goal. */
static const double MAX_ERROR[JOINTS] = {30, 30, 40, 60};

static double before[JOINTS], speed[JOINTS], error[JOINTS];
static int cycles;

static double limit(double value, double bound)
{
    return fmax(-bound, fmin(bound, value));
}

static double now(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + (double)t.tv_nsec * 1e-9;
}

/* One cycle of the program at a time since the first connection, s. */
static void run_program(uint16_t *registers, double time)
{
    const double *goal = POSE[(int)(time / MOVE_EVERY) % POSES];
    for (int j = 0; j < JOINTS; j++) {
        double position = (int16_t)registers[POSITIONS + j] / 100.0;
        /* The registers have a resolution of 0.01, so the difference quotient is filtered. */
        if (cycles) speed[j] = 0.9 * speed[j] + 0.1 * (position - before[j]) / PERIOD;
        before[j] = position;
        error[j] = goal[j] - position;
        double torque = KP[j] * limit(error[j], MAX_ERROR[j]) - KD[j] * speed[j] + GRAVITY[j];
        registers[TORQUES + j] = (uint16_t)(int16_t)lround(limit(1000 * torque, 32767));
    }
    registers[ECHO] = registers[STEP];
    cycles++;
}

int main(int argc, char **argv)
{
    const char *host = argc > 1 ? argv[1] : "127.0.0.1";
    int port = argc > 2 ? atoi(argv[2]) : 5502;
    double duration = argc > 3 ? atof(argv[3]) : 16.0;
    modbus_t *server = modbus_new_tcp(host, port);
    modbus_mapping_t *map = modbus_mapping_new(8, 0, REGISTERS, 0);
    int listening = server == NULL ? -1 : modbus_tcp_listen(server, 1);
    if (listening == -1 || map == NULL) {
        fprintf(stderr, "can't serve at %s:%d: %s\n", host, port, modbus_strerror(errno));
        return 3;
    }
    printf("serving at %s:%d\n", host, port);
    fflush(stdout);

    int connected = modbus_tcp_accept(server, &listening);
    double begin = now(), due = begin;
    while (now() - begin < duration) {
        struct pollfd ready = {.fd = connected == -1 ? listening : connected, .events = POLLIN};
        int wait = (int)ceil(1000 * (due - now()));
        if (poll(&ready, 1, wait > 0 ? wait : 0) > 0) {
            uint8_t request[MODBUS_TCP_MAX_ADU_LENGTH];
            if (connected == -1) {
                connected = modbus_tcp_accept(server, &listening);
            } else {
                int length = modbus_receive(server, request);
                if (length > 0) modbus_reply(server, request, length, map);
                if (length == -1) { /* the rig has disconnected */
                    close(connected);
                    connected = -1;
                }
            }
        }
        if (now() >= due) {
            run_program(map->tab_registers, now() - begin);
            due += PERIOD;
        }
    }

    double worst = 0;
    printf("error at the end:");
    for (int j = 0; j < JOINTS; j++) {
        printf(" %+.2f", error[j]);
        worst = fmax(worst, fabs(error[j]));
    }
    printf("\n");
    close(listening);
    modbus_mapping_free(map);
    modbus_free(server);
    return worst < 2.0 ? 0 : 1;
}
