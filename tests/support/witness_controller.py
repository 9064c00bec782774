"""Controller whose packets show the loop: it reads step and applied efforts, and numbers its commands in effort 4.

Usage: witness_controller.py HOST PORT SECONDS PERIOD_MS THINK_MS. It computes for THINK_MS between reading and writing.
"""

import socket
import struct
import sys
import time

READ = struct.pack(">HHHBBHH", 1, 0, 6, 1, 4, 0, 36)


def main() -> None:
    host, port, seconds, period_s, think_s = sys.argv[1], int(sys.argv[2]), *map(float, sys.argv[3:])
    period_s, think_s = period_s / 1e3, think_s / 1e3
    with socket.create_connection((host, port), timeout=10.0) as connection:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        begin = due = time.monotonic()
        number = 0
        while time.monotonic() - begin < seconds:
            connection.sendall(READ)
            response = receive(connection)
            position, speed = (
                struct.unpack_from(">f", response, 9 + 2 * 12)[0],
                struct.unpack_from(">f", response, 9 + 2 * 20)[0],
            )
            time.sleep(think_s)  # the time in which a controller computes
            number += 1
            # Alternating signs: joint 4 does not speed up.
            mark = (number % 100 + 1) * (1 if number % 2 else -1)
            torque = max(-5000, min(5000, round(200 * (30 - position) - 30 * speed)))
            connection.sendall(struct.pack(">HHHBBHHB4h", 2, 0, 15, 1, 16, 0, 4, 8, torque, 0, -4905, mark))
            receive(connection)
            due += period_s
            time.sleep(max(0.0, due - time.monotonic()))


def receive(connection: socket.socket) -> bytes:
    """Return the next response."""
    data = b""
    while len(data) < 6 or len(data) < 6 + data[5]:
        part = connection.recv(300)
        if not part:
            raise ConnectionError("closed")
        data += part
    assert not data[7] & 0x80, data.hex()
    return data


if __name__ == "__main__":
    main()
