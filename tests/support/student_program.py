"""Programs with one mistake each, as students write them, on a plain socket.

Usage: student_program.py HOST PORT SECONDS MISTAKE [VALUE_MS]. The law is a PD law with a moving set point. The mistake
`none` polls twice a step of 20 ms; the others poll once, and miss ticks if their phase is unfavorable.
"""

import socket
import struct
import sys
import time

READ = struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, 4, 4)
SPLIT = 7
"""Bytes of the header, which a client that does not set TCP_NODELAY sends on its own."""


def main() -> None:
    host, port, seconds, mistake = sys.argv[1], int(sys.argv[2]), float(sys.argv[3]), sys.argv[4]
    value_s = float(sys.argv[5]) / 1e3 if len(sys.argv) > 5 else 0.0
    with socket.create_connection((host, port), timeout=10.0) as connection:
        split = mistake == "two segments"
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 0 if split else 1)

        def ask(frame: bytes) -> bytes:
            for part in (frame[:SPLIT], frame[SPLIT:]) if split else (frame,):
                connection.sendall(part)
            return connection.recv(300)

        begin = due = time.monotonic()
        before, before_s = (0, 0, 0, 0), begin
        words = old = (0, 0, -4905, 0)
        period_s = {"slow polling": value_s, "none": 0.01}.get(mistake, 0.02)
        have_read = False
        while (now := time.monotonic()) - begin < seconds:
            if not (mistake == "read once" and have_read):
                have_read = True
                position = struct.unpack_from(">4h", ask(READ), 9)
            goal = (3000, -2000, 6000, 500) if (now - begin) % 6 < 3 else (-1500, 2500, 9000, -500)
            span = max(now - before_s, 1e-3)
            words = tuple(
                max(-32767, min(32767, round(p * (g - q) - d * (q - b) / span) + w))
                for p, d, w, g, q, b in zip(
                    (1.5, 0.9, 0.3, 0.04),
                    (0.3, 0.15, 0.02, 0.003),
                    (0, 0, -4905, 0),
                    goal,
                    position,
                    before,
                    strict=True,
                )
            )
            before, before_s = position, now
            if mistake == "wait before write":
                time.sleep(value_s)  # the mistake
            if mistake == "computing":
                # The amount of work varies, as that of an optimization does.
                end = time.perf_counter() + value_s * (0.8 + 0.4 * ((now * 7.3) % 1))
                while time.perf_counter() < end:
                    pass
            sent, old = (old, words) if mistake == "previous poll" else (words, words)
            answer = ask(struct.pack(">HHHBBHHB4h", 2, 0, 15, 1, 16, 0, 4, 8, *sent))
            if mistake != "competitor":
                assert not answer[7] & 0x80, answer.hex()
            if mistake in ("wait before write", "computing"):
                continue
            due = max(due + period_s, time.monotonic())
            time.sleep(max(0.0, due - time.monotonic()))


if __name__ == "__main__":
    main()
