/* A minimal Modbus server: libmodbus, registers in memory, one client at a time.
 *
 * usage: modbus_echo_server PORT        prints "ready"; stops when its standard input is closed
 */
#include <errno.h>
#include <modbus.h>
#include <stdio.h>
#include <stdlib.h>
#include <pthread.h>
#include <unistd.h>

static void *stop_with_stdin(void *unused)
{
    char byte;
    (void)unused;
    while (read(0, &byte, 1) > 0) {
    }
    _exit(0);
}

int main(int argc, char **argv)
{
    if (argc != 2) {
        fprintf(stderr, "usage: %s PORT\n", argv[0]);
        return 2;
    }
    pthread_t watch;
    pthread_create(&watch, NULL, stop_with_stdin, NULL);
    modbus_t *bus = modbus_new_tcp("127.0.0.1", atoi(argv[1]));
    modbus_mapping_t *map = modbus_mapping_new(8, 8, 16, 16);
    int listening = modbus_tcp_listen(bus, 1);
    if (listening == -1) {
        fprintf(stderr, "can't listen on port %s: %s\n", argv[1], modbus_strerror(errno));
        return 3;
    }
    puts("ready");
    fflush(stdout);
    for (;;) {
        if (modbus_tcp_accept(bus, &listening) == -1) return 3;
        for (;;) {
            uint8_t query[MODBUS_TCP_MAX_ADU_LENGTH];
            int length = modbus_receive(bus, query);
            if (length == -1) break;
            if (length > 0) modbus_reply(bus, query, length, map);
        }
        modbus_close(bus);
    }
}
