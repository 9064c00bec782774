"""Example joint controller over Modbus TCP with pymodbus: holds the arm and moves it between two poses.

    python hold_position.py --host 127.0.0.1 --port 5020 --duration 10

Each cycle reads four positions, computes four torques, writes them in one request, and then waits. (Waiting between
read and write would apply torques that are based on old positions.) The exit code is 0 if the arm is at its goal at
the end.
"""

import argparse
import sys
import time

from pymodbus.client import ModbusTcpClient

PERIOD = 0.02  # period of the control cycle, s
POSES = [(30.0, -45.0, 50.0, 20.0), (-20.0, 60.0, 120.0, -30.0)]  # degrees, degrees, mm, degrees
MOVE_EVERY = 4.0  # s in each pose

# Gains: N·m per degree (N per mm) of error, and N·m per degree/s (N per mm/s) of speed.
KP = (0.25, 0.25, 0.03, 0.004)
KD = (0.04, 0.03, 0.002, 0.0005)
# Joint 3 carries the quill and counts positive downwards: an upward force compensates the weight.
GRAVITY = (0.0, 0.0, -0.5 * 9.81, 0.0)
# Limits of the error, so that the arm does not accelerate too much toward a distant goal.
MAX_ERROR = (30.0, 30.0, 40.0, 60.0)


def signed(word: int) -> int:
    """Convert a register value to a signed number."""
    return word - 65536 if word > 32767 else word


def main() -> int:
    """Run the controller; return 0 if the arm is at its goal at the end."""
    parser = argparse.ArgumentParser(description="Hold the arm and move it between two poses.")
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=5020)
    parser.add_argument("--duration", type=float, default=16.0, help="seconds")
    options = parser.parse_args()

    client = ModbusTcpClient(options.host, port=options.port)
    if not client.connect():
        print(f"can't connect to a rig at {options.host}:{options.port}", file=sys.stderr)
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
            # The registers have a resolution of 0.01, so the difference quotient is filtered.
            speed = [0.5 * s + 0.5 * (p - b) / PERIOD for s, p, b in zip(speed, position, before, strict=True)]
        before = position

        goal = POSES[int((time.monotonic() - begin) / MOVE_EVERY) % len(POSES)]
        error = [g - p for g, p in zip(goal, position, strict=True)]
        limited = [max(-m, min(m, e)) for m, e in zip(MAX_ERROR, error, strict=True)]
        torque = [kp * e - kd * s + w for kp, e, kd, s, w in zip(KP, limited, KD, speed, GRAVITY, strict=True)]
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
