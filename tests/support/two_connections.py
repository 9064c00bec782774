"""Controller whose torques are written on another connection than its positions are read on.

Usage: two_connections.py HOST PORT SECONDS LAW. With LAW "feedback" the torques follow the positions, else they do not.
"""

import socket
import struct
import sys
import time

READ = struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, 4, 4)


def main() -> None:
    host, port, seconds, law = sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), sys.argv[4]
    with (
        socket.create_connection((host, port), timeout=5.0) as reader,
        socket.create_connection((host, port), timeout=5.0) as writer,
    ):
        begin = due = time.monotonic()
        before = None
        while time.monotonic() - begin < seconds:
            reader.sendall(READ)
            position = struct.unpack_from(">h", reader.recv(64), 9)[0] / 100
            speed = 0.0 if before is None else (position - before) / 0.02
            before = position
            torque = 300.0 if law == "constant" else 120 * (30 - position) - 40 * speed
            writer.sendall(struct.pack(">HHHBBHHB4h", 2, 0, 15, 1, 16, 0, 4, 8, round(torque), 0, -4905, 0))
            answer = writer.recv(64)
            assert not answer[7] & 0x80, answer.hex()
            due += 0.02
            time.sleep(max(0.0, due - time.monotonic()))


if __name__ == "__main__":
    main()
