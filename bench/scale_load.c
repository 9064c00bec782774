/* Many controllers in one process: each holds a TCP connection to its own rig and reads the four positions (function 3)
 * and writes the four torques (function 16) once per period, with phases spread over the period. Raw sockets and one
 * epoll instance keep the CPU load low. Prints one JSON object.
 *
 * usage: scale_load HOST PORT COUNT SECONDS PERIOD_MS        (rig k listens on PORT + k)
 */
#include <arpa/inet.h>
#include <errno.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <sched.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/epoll.h>
#include <sys/prctl.h>
#include <sys/socket.h>
#include <time.h>
#include <unistd.h>

enum { READ_RESPONSE_SIZE = 17, WRITE_RESPONSE_SIZE = 12, RESPONSE_CAPACITY = 64 };
enum phase { WAITING, READING, WRITING };

struct controller {
    int socket;
    enum phase phase;
    int64_t due, sent;
    uint16_t transaction;
    size_t filled;
    unsigned char response[RESPONSE_CAPACITY];
};

static int64_t *reads, *writes;
static size_t read_count, write_count, capacity, skipped, failed, refused;

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

static int connect_to(const char *host, int port)
{
    struct sockaddr_in address = {.sin_family = AF_INET, .sin_port = htons(port)};
    int on = 1, s = socket(AF_INET, SOCK_STREAM, 0);
    if (inet_pton(AF_INET, host, &address.sin_addr) != 1 || connect(s, (struct sockaddr *)&address, sizeof address)) {
        fprintf(stderr, "can't connect to %s:%d: %s\n", host, port, strerror(errno));
        exit(3);
    }
    setsockopt(s, IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
    return s;
}

static void send_request(struct controller *c, enum phase phase, int64_t now)
{
    /* The torque of the first joint alternates, so that the arms move and consecutive writes differ. */
    int16_t torque = (int16_t)(c->transaction % 400 < 200 ? 300 + c->transaction % 7 : -300 - c->transaction % 7);
    unsigned char request[21] = {0, 0, 0, 0, 0, 6, 1, 3, 0, 4, 0, 4};
    size_t size = 12;
    if (phase == WRITING) {
        const unsigned char write[] = {0, 0, 0, 0, 0, 15, 1, 16, 0, 0, 0, 4, 8};
        memcpy(request, write, sizeof write);
        request[13] = (unsigned char)((uint16_t)torque >> 8);
        request[14] = (unsigned char)torque;
        size = sizeof request;
    }
    c->transaction++;
    request[0] = c->transaction >> 8;
    request[1] = c->transaction & 0xFF;
    c->phase = phase;
    c->sent = now;
    c->filled = 0;
    if (send(c->socket, request, size, MSG_NOSIGNAL) != (ssize_t)size) failed++;
}

static void receive(struct controller *c, int64_t now, int64_t period)
{
    ssize_t got = recv(c->socket, c->response + c->filled, RESPONSE_CAPACITY - c->filled, MSG_DONTWAIT);
    if (got <= 0) {
        if (got < 0 && errno == EAGAIN) return;
        failed++;
        close(c->socket);
        c->socket = -1;
        return;
    }
    c->filled += got;
    if (c->filled >= 9 && (c->response[7] & 0x80)) {
        refused++;
        c->phase = WAITING;
        c->due = now + period;
        return;
    }
    if (c->filled < (c->phase == READING ? READ_RESPONSE_SIZE : WRITE_RESPONSE_SIZE)) return;
    if (c->phase == READING) {
        if (read_count < capacity) reads[read_count++] = now - c->sent;
        send_request(c, WRITING, now_ns());
        return;
    }
    if (write_count < capacity) writes[write_count++] = now - c->sent;
    c->phase = WAITING;
    for (c->due += period; c->due <= now; c->due += period) skipped++;
}

int main(int argc, char **argv)
{
    if (argc != 6) {
        fprintf(stderr, "usage: %s HOST PORT COUNT SECONDS PERIOD_MS\n", argv[0]);
        return 2;
    }
    int port = atoi(argv[2]), count = atoi(argv[3]);
    double seconds = atof(argv[4]);
    int64_t period = (int64_t)(atof(argv[5]) * 1e6);
    struct controller *all = calloc(count, sizeof *all);
    capacity = (size_t)(count * (seconds / (period * 1e-9) + 10));
    reads = malloc(capacity * sizeof *reads);
    writes = malloc(capacity * sizeof *writes);
    prctl(PR_SET_TIMERSLACK, 1);
    /* The controllers represent other machines: with the permission for it, they preempt the processes of the lab. */
    struct sched_param first = {.sched_priority = 10};
    sched_setscheduler(0, SCHED_FIFO, &first);
    int poll = epoll_create1(0);
    int64_t begin = now_ns();
    for (int k = 0; k < count; k++) {
        all[k].socket = connect_to(argv[1], port + k);
        struct epoll_event interest = {.events = EPOLLIN, .data.ptr = &all[k]};
        epoll_ctl(poll, EPOLL_CTL_ADD, all[k].socket, &interest);
    }
    begin = now_ns();
    for (int k = 0; k < count; k++) all[k].due = begin + period * k / count;
    int64_t end = begin + (int64_t)(seconds * 1e9);
    struct epoll_event events[256];
    for (int64_t now = begin; now < end; now = now_ns()) {
        int64_t next = end;
        for (int k = 0; k < count; k++) {
            struct controller *c = &all[k];
            if (c->phase != WAITING || c->socket < 0) continue;
            if (c->due <= now) send_request(c, READING, now_ns());
            else if (c->due < next) next = c->due;
        }
        struct timespec pause = {0, 0};
        int64_t left = next - now_ns();
        if (left > 0) pause = (struct timespec){left / 1000000000, left % 1000000000};
        int ready = epoll_pwait2(poll, events, 256, &pause, NULL);
        for (int k = 0; k < ready; k++) receive(events[k].data.ptr, now_ns(), period);
    }
    double took = (now_ns() - begin) * 1e-9;
    struct timespec cpu;
    clock_gettime(CLOCK_PROCESS_CPUTIME_ID, &cpu);
    printf("{\"cycles\": %zu, \"seconds\": %.3f, \"cycles_per_s\": %.1f, \"skipped\": %zu, \"failed\": %zu, "
           "\"refused\": %zu, \"cpu_s\": %.3f, ",
           write_count, took, write_count / took, skipped, failed, refused, cpu.tv_sec + cpu.tv_nsec * 1e-9);
    print_percentiles("read", reads, read_count);
    printf(", ");
    print_percentiles("write", writes, write_count);
    printf("}\n");
    return failed ? 3 : 0;
}
