/* Controllers that ask as fast as they can, or at a rate: read 4 positions, write 4 torques, on each connection.
 *
 * usage: modbus_client PORT STEP CONNECTIONS SECONDS RATE [FILE]
 *   connection i goes to port PORT + i * STEP; RATE is cycles a second on each connection, 0 as fast as possible
 *   into FILE go two 64-bit numbers a read: when its cycle was over, ns of the wall clock, and the time it took, ns
 * usage: modbus_client churn PORT COUNT
 *   connect, read once, disconnect, COUNT times
 * Prints one JSON object: cycles a second of all connections, and the time of a read and of a cycle in microseconds.
 * At a rate, a cycle that is due while the one before is not answered begins after it, and its time counts from when it
 * was due: a server that falls behind is not asked less often for that.
 * One thread and raw frames: the client costs little beside the server that it measures.
 */
#include <arpa/inet.h>
#include <errno.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

enum { READ_ANSWER = 9 + 8, WRITE_ANSWER = 12, MOST = 256, SAMPLES = 4000000 };

static const uint8_t READ[] = {0, 1, 0, 0, 0, 6, 1, 3, 0, 4, 0, 4};
static const uint8_t WRITE[] = {0, 2, 0, 0, 0, 15, 1, 16, 0, 0, 0, 4, 8, 0, 1, 0, 2, 0, 3, 0, 4};

struct connection {
    int fd;
    int writing, busy;
    size_t have;
    uint8_t answer[300];
    int64_t began, asked, due;
    float read_us;
};

static float *reads, *cycles;
static int64_t *over;
static size_t count;

static int64_t clock_ns(clockid_t clock)
{
    struct timespec t;
    clock_gettime(clock, &t);
    return t.tv_sec * 1000000000LL + t.tv_nsec;
}

static int64_t now(void)
{
    return clock_ns(CLOCK_MONOTONIC);
}

static int dial(int port)
{
    struct sockaddr_in address = {.sin_family = AF_INET, .sin_port = htons((uint16_t)port)};
    int one = 1, fd = socket(AF_INET, SOCK_STREAM, 0);
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    if (connect(fd, (struct sockaddr *)&address, sizeof address)) {
        fprintf(stderr, "can't connect to port %d: %s\n", port, strerror(errno));
        exit(3);
    }
    setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &one, sizeof one);
    return fd;
}

static void ask(struct connection *c, const uint8_t *request, size_t size)
{
    c->have = 0;
    c->asked = now();
    if (send(c->fd, request, size, MSG_NOSIGNAL) != (ssize_t)size) {
        perror("send");
        exit(3);
    }
}

static void begin(struct connection *c, int64_t due)
{
    c->writing = 0;
    c->busy = 1;
    ask(c, READ, sizeof READ);
    if (due) c->asked = due;
    c->began = c->asked;
}

static int by_value(const void *a, const void *b)
{
    float x = *(const float *)a, y = *(const float *)b;
    return (x > y) - (x < y);
}

static void print_times(const char *name, float *times)
{
    qsort(times, count, sizeof *times, by_value);
    printf("\"%s\": {\"p50\": %.2f, \"p99\": %.2f, \"p999\": %.2f, \"max\": %.2f}", name, times[count / 2],
           times[count * 99 / 100], times[count * 999 / 1000], times[count - 1]);
}

static void write_samples(const char *path)
{
    int64_t to_wall = clock_ns(CLOCK_REALTIME) - now();
    FILE *file = fopen(path, "wb");
    if (!file) {
        perror(path);
        exit(3);
    }
    for (size_t i = 0; i < count; i++) {
        int64_t sample[] = {over[i] + to_wall, (int64_t)((double)reads[i] * 1e3)};
        fwrite(sample, sizeof sample, 1, file);
    }
    if (fclose(file)) {
        perror(path);
        exit(3);
    }
}

static int churn(int port, int times)
{
    for (int i = 0; i < times; i++) {
        struct connection c = {.fd = dial(port)};
        ask(&c, READ, sizeof READ);
        if (recv(c.fd, c.answer, sizeof c.answer, 0) <= 0) {
            fprintf(stderr, "connection %d was not served\n", i + 1);
            return 3;
        }
        close(c.fd);
    }
    printf("{\"connections\": %d}\n", times);
    return 0;
}

int main(int argc, char **argv)
{
    if (argc == 4 && !strcmp(argv[1], "churn")) return churn(atoi(argv[2]), atoi(argv[3]));
    if (argc != 6 && argc != 7) {
        fprintf(stderr, "usage: %s PORT STEP CONNECTIONS SECONDS RATE [FILE]\n", argv[0]);
        return 2;
    }
    int port = atoi(argv[1]), step = atoi(argv[2]), connections = atoi(argv[3]);
    double seconds = atof(argv[4]), rate = atof(argv[5]);
    int64_t period = rate > 0 ? (int64_t)(1e9 / rate) : 0;
    static struct connection all[MOST];
    struct epoll_event events[MOST];
    int poller = epoll_create1(0);
    if (connections > MOST) return 2;
    reads = malloc(SAMPLES * sizeof *reads);
    cycles = malloc(SAMPLES * sizeof *cycles);
    over = malloc(SAMPLES * sizeof *over);

    for (int i = 0; i < connections; i++) {
        struct epoll_event event = {.events = EPOLLIN, .data.ptr = &all[i]};
        all[i].fd = dial(port + i * step);
        epoll_ctl(poller, EPOLL_CTL_ADD, all[i].fd, &event);
    }
    int64_t start = now(), end = start + (int64_t)(seconds * 1e9);
    for (int i = 0; i < connections; i++) {
        /* At a rate, the connections are spread over the period. */
        all[i].due = start + (period ? period * i / connections : 0);
        if (!period) begin(&all[i], 0);
    }
    while (now() < end) {
        int timeout = 100;
        if (period) {
            int64_t t = now(), next = end;
            for (int i = 0; i < connections; i++) {
                if (all[i].due <= t && !all[i].busy) {
                    begin(&all[i], 0);
                    all[i].due += period;
                }
                if (!all[i].busy && all[i].due < next) next = all[i].due;
            }
            timeout = (int)((next - t) / 1000000);
        }
        int ready = epoll_wait(poller, events, MOST, timeout);
        for (int i = 0; i < ready; i++) {
            struct connection *c = events[i].data.ptr;
            ssize_t got = recv(c->fd, c->answer + c->have, sizeof c->answer - c->have, 0);
            if (got <= 0) {
                fprintf(stderr, "the server closed a connection\n");
                return 3;
            }
            c->have += (size_t)got;
            if (c->have >= 9 && c->answer[7] & 0x80) {
                fprintf(stderr, "function %d: exception %d\n", c->answer[7] & 0x7f, c->answer[8]);
                return 3;
            }
            if (c->have < (c->writing ? (size_t)WRITE_ANSWER : (size_t)READ_ANSWER)) continue;
            int64_t t = now();
            if (!c->writing) {
                c->read_us = (float)((double)(t - c->asked) * 1e-3);
                c->writing = 1;
                ask(c, WRITE, sizeof WRITE);
                continue;
            }
            over[count] = t;
            reads[count] = c->read_us;
            cycles[count] = (float)((double)(t - c->began) * 1e-3);
            if (++count == SAMPLES) end = t;
            c->busy = 0;
            if (!period) {
                begin(c, 0);
            } else if (c->due <= t) {
                begin(c, c->due);
                c->due += period;
            }
        }
    }
    double lasted = (double)(now() - start) * 1e-9;
    if (!count) {
        fprintf(stderr, "no cycle was completed\n");
        return 3;
    }
    if (argc == 7) write_samples(argv[6]);
    printf("{\"cycles_per_s\": %.1f, ", (double)count / lasted);
    print_times("read_us", reads);
    printf(", ");
    print_times("cycle_us", cycles);
    printf("}\n");
    return 0;
}
