"""Hold the arm, and move it: a joint controller over Modbus TCP with pymodbus. A place to start from.

    python hold_position.py --host 127.0.0.1 --port 5020 --duration 10

Each turn of the loop reads four positions, computes four torques and writes them at once: read, compute, write, then
wait. (Waiting between read and write would let the torques act on positions that are old.) Ends with exit code 0 if
the arm is where it was sent.
"""

import argparse
import sys
import time

from pymodbus.client import ModbusTcpClient

PERIOD = 0.02  # s between two turns of the loop
POSES = [(30.0, -45.0, 50.0, 20.0), (-20.0, 60.0, 120.0, -30.0)]  # degrees, degrees, mm, degrees
MOVE_EVERY = 4.0  # s in each pose

# What one degree (mm) of error, and one degree (mm) a second of speed, is worth; N·m and N.
KP = (0.25, 0.25, 0.03, 0.004)
KD = (0.04, 0.03, 0.002, 0.0005)
# The quill hangs on joint 3, which counts positive downwards: its weight is carried with a force upwards.
GRAVITY = (0.0, 0.0, -0.5 * 9.81, 0.0)
# Errors that count no further: the arm does not leap at a far goal.
MOST = (30.0, 30.0, 40.0, 60.0)


def signed(word: int) -> int:
    """A register as a signed number."""
    return word - 65536 if word > 32767 else word


def main() -> int:
    """Run the controller; 0: the arm is where it was sent."""
    parser = argparse.ArgumentParser(description="Hold the arm, and move it.")
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=5020)
    parser.add_argument("--duration", type=float, default=16.0, help="seconds")
    options = parser.parse_args()

    client = ModbusTcpClient(options.host, port=options.port)
    if not client.connect():
        print(f"no rig answers at {options.host}:{options.port}", file=sys.stderr)
        return 3
    begin = due = time.monotonic()
    before = None
    speed = [0.0] * 4
    error = [0.0] * 4
    while time.monotonic() - begin < options.duration:
        answer = client.read_holding_registers(4, count=4)  # registers 5-8
        if answer.isError():
            print(f"reading failed: {answer}", file=sys.stderr)
            return 3
        position = [signed(word) / 100 for word in answer.registers]
        if before is not None:
            # The registers step by 0.01: the difference of two is rough, so it is smoothed.
            speed = [0.5 * s + 0.5 * (p - b) / PERIOD for s, p, b in zip(speed, position, before, strict=True)]
        before = position

        goal = POSES[int((time.monotonic() - begin) / MOVE_EVERY) % len(POSES)]
        error = [g - p for g, p in zip(goal, position, strict=True)]
        near = [max(-m, min(m, e)) for m, e in zip(MOST, error, strict=True)]
        torque = [kp * e - kd * s + w for kp, e, kd, s, w in zip(KP, near, KD, speed, GRAVITY, strict=True)]
        words = [max(-32767, min(32767, round(1000 * t))) & 0xFFFF for t in torque]
        answer = client.write_registers(0, words)  # registers 1-4
        if answer.isError():
            print(f"writing failed: {answer}", file=sys.stderr)
            return 3
        due += PERIOD
        time.sleep(max(0.0, due - time.monotonic()))
    client.write_registers(0, [0, 0, 0, 0])
    client.close()
    print("error at the end: " + ", ".join(f"{e:+.2f}" for e in error))
    return 0 if max(abs(e) for e in error) < 2.0 else 1


if __name__ == "__main__":
    sys.exit(main())
