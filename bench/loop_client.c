/* A controller on libmodbus that polls without pauses or with a period: it reads the four positions, computes a PD law
 * with gravity compensation and writes the four torques. Prints one JSON object with its round-trip times.
 *
 * usage: loop_client HOST PORT SECONDS PERIOD_MS        (PERIOD_MS 0: without pauses)
 */
#include <errno.h>
#include <modbus.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <time.h>

static int64_t now_ns(void)
{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (int64_t)t.tv_sec * 1000000000 + t.tv_nsec;
}

static int compare(const void *a, const void *b)
{
    int64_t x = *(const int64_t *)a, y = *(const int64_t *)b;
    return (x > y) - (x < y);
}

static void print_percentiles(const char *name, int64_t *ns, size_t n)
{
    qsort(ns, n, sizeof *ns, compare);
    printf("\"%s_us\": {\"p50\": %.2f, \"p99\": %.2f, \"max\": %.2f}", name, n ? ns[n / 2] / 1e3 : 0.0,
           n ? ns[(size_t)(0.99 * (n - 1))] / 1e3 : 0.0, n ? ns[n - 1] / 1e3 : 0.0);
}

static uint16_t limit(double value)
{
    if (value > 32767) value = 32767;
    if (value < -32768) value = -32768;
    return (uint16_t)(int16_t)value;
}

int main(int argc, char **argv)
{
    if (argc != 5) {
        fprintf(stderr, "usage: %s HOST PORT SECONDS PERIOD_MS\n", argv[0]);
        return 2;
    }
    double seconds = atof(argv[3]), period_ms = atof(argv[4]);
    modbus_t *bus = modbus_new_tcp(argv[1], atoi(argv[2]));
    modbus_set_response_timeout(bus, 5, 0);
    if (modbus_connect(bus) == -1) {
        fprintf(stderr, "can't connect to %s:%s: %s\n", argv[1], argv[2], modbus_strerror(errno));
        return 3;
    }
    size_t room = 1 << 22, cycles = 0;
    int64_t *reads = malloc(room * sizeof *reads), *writes = malloc(room * sizeof *writes);
    int64_t begin = now_ns(), end = begin + (int64_t)(seconds * 1e9), due = begin;
    while (now_ns() < end && cycles < room) {
        uint16_t position[4], torque[4];
        int64_t t0 = now_ns();
        if (modbus_read_registers(bus, 4, 4, position) != 4) goto failed;
        int64_t t1 = now_ns();
        /* Soft position control at the start pose; the quill has a mass of 0.5 kg. The low bit makes writes differ. */
        torque[0] = limit(-0.02 * (int16_t)position[0] / 100.0 * 1000);
        torque[1] = limit(-0.01 * (int16_t)position[1] / 100.0 * 1000);
        torque[2] = limit((-4.905 + 0.05 * (50.0 - (int16_t)position[2] / 100.0)) * 1000);
        torque[3] = (uint16_t)(cycles & 1);
        int64_t t2 = now_ns();
        if (modbus_write_registers(bus, 0, 4, torque) != 4) goto failed;
        int64_t t3 = now_ns();
        reads[cycles] = t1 - t0;
        writes[cycles] = t3 - t2;
        cycles++;
        if (period_ms > 0) {
            due += (int64_t)(period_ms * 1e6);
            struct timespec t = {due / 1000000000, due % 1000000000};
            clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &t, NULL);
        }
    }
    printf("{\"cycles\": %zu, \"cycles_per_s\": %.1f, ", cycles, cycles / ((now_ns() - begin) / 1e9));
    print_percentiles("read", reads, cycles);
    printf(", ");
    print_percentiles("write", writes, cycles);
    printf("}\n");
    modbus_close(bus);
    modbus_free(bus);
    return 0;
failed:
    fprintf(stderr, "request failed: %s\n", modbus_strerror(errno));
    return 3;
}
