"""Controller for fault tests: writes a constant torque fifty times per second and reconnects after errors.

Usage: steady_controller.py HOST PORT. Ends with its standard input, then prints the number of answered writes.
"""

import socket
import struct
import sys
import threading
import time

READ = struct.pack(">HHHBBHH", 2, 0, 6, 1, 3, 4, 4)
WRITE = struct.pack(">HHHBBHHB4h", 1, 0, 15, 1, 16, 0, 4, 8, 300, 0, 0, 0)


def main() -> None:
    host, port = sys.argv[1], int(sys.argv[2])
    stopping = threading.Event()

    def stop_at_end_of_input() -> None:
        sys.stdin.read()
        stopping.set()

    threading.Thread(target=stop_at_end_of_input, daemon=True).start()
    answered = 0
    while not stopping.is_set():
        try:
            with socket.create_connection((host, port), timeout=1.0) as connection:
                while not stopping.is_set():
                    connection.sendall(WRITE)
                    answer = connection.recv(64)
                    if not answer:
                        break
                    answered += not answer[7] & 0x80
                    # Read a state, as a control loop does; the response may be an exception.
                    connection.sendall(READ)
                    if not connection.recv(64):
                        break
                    time.sleep(0.02)  # the period of a controller
        except OSError:
            time.sleep(0.1)  # the rig is not reachable: try again
    print(answered)


if __name__ == "__main__":
    main()
