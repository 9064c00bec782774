/* Controllers that poll without pauses or at a rate: read 4 positions and write 4 torques on each connection.
 *
 * usage: modbus_client PORT STEP CONNECTIONS SECONDS RATE [FILE]
 *   connection i uses port PORT + i * STEP; RATE: cycles per second on each connection, 0: without pauses
 *   FILE receives two 64-bit numbers per read: the end of its cycle, wall clock, ns, and the duration of the read, ns
 * usage: modbus_client churn PORT COUNT
 *   connect, read once, disconnect, COUNT times
 * Prints one JSON object: cycles per second of all connections, and the times of a read and of a cycle in microseconds.
 * At a rate, a cycle that is due before the previous one has finished starts after it, and its time counts from its due
 * time: an overloaded server does not receive fewer requests.
 * One thread and raw frames: the client needs little CPU time compared with the server.
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

enum { READ_RESPONSE_SIZE = 9 + 8, WRITE_RESPONSE_SIZE = 12, MAX_CONNECTIONS = 256, MAX_SAMPLES = 4000000 };

static const uint8_t READ[] = {0, 1, 0, 0, 0, 6, 1, 3, 0, 4, 0, 4};
static const uint8_t WRITE[] = {0, 2, 0, 0, 0, 15, 1, 16, 0, 0, 0, 4, 8, 0, 1, 0, 2, 0, 3, 0, 4};

struct connection {
    int fd;
    int writing, busy;
    size_t have;
    uint8_t response[300];
    int64_t began, sent, due;
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

static int connect_to(int port)
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

static void send_request(struct connection *c, const uint8_t *request, size_t size)
{
    c->have = 0;
    c->sent = now();
    if (send(c->fd, request, size, MSG_NOSIGNAL) != (ssize_t)size) {
        perror("send");
        exit(3);
    }
}

static void begin(struct connection *c, int64_t due)
{
    c->writing = 0;
    c->busy = 1;
    send_request(c, READ, sizeof READ);
    if (due) c->sent = due;
    c->began = c->sent;
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
        struct connection c = {.fd = connect_to(port)};
        send_request(&c, READ, sizeof READ);
        if (recv(c.fd, c.response, sizeof c.response, 0) <= 0) {
            fprintf(stderr, "connection %d: no response\n", i + 1);
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
    static struct connection all[MAX_CONNECTIONS];
    struct epoll_event events[MAX_CONNECTIONS];
    int poller = epoll_create1(0);
    if (connections > MAX_CONNECTIONS) return 2;
    reads = malloc(MAX_SAMPLES * sizeof *reads);
    cycles = malloc(MAX_SAMPLES * sizeof *cycles);
    over = malloc(MAX_SAMPLES * sizeof *over);

    for (int i = 0; i < connections; i++) {
        struct epoll_event event = {.events = EPOLLIN, .data.ptr = &all[i]};
        all[i].fd = connect_to(port + i * step);
        epoll_ctl(poller, EPOLL_CTL_ADD, all[i].fd, &event);
    }
    int64_t start = now(), end = start + (int64_t)(seconds * 1e9);
    for (int i = 0; i < connections; i++) {
        /* The connections are spread over the period. */
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
        int ready = epoll_wait(poller, events, MAX_CONNECTIONS, timeout);
        for (int i = 0; i < ready; i++) {
            struct connection *c = events[i].data.ptr;
            ssize_t got = recv(c->fd, c->response + c->have, sizeof c->response - c->have, 0);
            if (got <= 0) {
                fprintf(stderr, "the server closed the connection\n");
                return 3;
            }
            c->have += (size_t)got;
            if (c->have >= 9 && c->response[7] & 0x80) {
                fprintf(stderr, "function %d: exception %d\n", c->response[7] & 0x7f, c->response[8]);
                return 3;
            }
            if (c->have < (c->writing ? (size_t)WRITE_RESPONSE_SIZE : (size_t)READ_RESPONSE_SIZE)) continue;
            int64_t t = now();
            if (!c->writing) {
                c->read_us = (float)((double)(t - c->sent) * 1e-3);
                c->writing = 1;
                send_request(c, WRITE, sizeof WRITE);
                continue;
            }
            over[count] = t;
            reads[count] = c->read_us;
            cycles[count] = (float)((double)(t - c->began) * 1e-3);
            if (++count == MAX_SAMPLES) end = t;
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
