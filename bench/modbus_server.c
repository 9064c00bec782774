/* A Modbus server for many clients: libmodbus and select, as in the example of libmodbus.
 *
 * usage: modbus_server PORT        prints "ready"; stops when its standard input is closed
 */
#include <errno.h>
#include <modbus.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/select.h>
#include <sys/socket.h>
#include <unistd.h>

int main(int argc, char **argv)
{
    if (argc != 2) {
        fprintf(stderr, "usage: %s PORT\n", argv[0]);
        return 2;
    }
    modbus_t *bus = modbus_new_tcp("127.0.0.1", atoi(argv[1]));
    modbus_mapping_t *map = modbus_mapping_new(8, 8, 16, 16);
    int listening = modbus_tcp_listen(bus, 64);
    if (listening == -1) {
        fprintf(stderr, "can't listen on port %s: %s\n", argv[1], modbus_strerror(errno));
        return 3;
    }
    puts("ready");
    fflush(stdout);
    fd_set all;
    int max_fd = listening;
    FD_ZERO(&all);
    FD_SET(0, &all);
    FD_SET(listening, &all);
    for (;;) {
        fd_set ready = all;
        if (select(max_fd + 1, &ready, NULL, NULL, NULL) == -1) return 3;
        for (int fd = 0; fd <= max_fd; fd++) {
            if (!FD_ISSET(fd, &ready)) continue;
            if (fd == 0) {
                char byte;
                if (read(0, &byte, 1) <= 0) return 0;
            } else if (fd == listening) {
                int client = accept(listening, NULL, NULL);
                FD_SET(client, &all);
                if (client > max_fd) max_fd = client;
            } else {
                uint8_t query[MODBUS_TCP_MAX_ADU_LENGTH];
                modbus_set_socket(bus, fd);
                int length = modbus_receive(bus, query);
                if (length > 0) {
                    modbus_reply(bus, query, length, map);
                } else if (length == -1) {
                    close(fd);
                    FD_CLR(fd, &all);
                }
            }
        }
    }
}
