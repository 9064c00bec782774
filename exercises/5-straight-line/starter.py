"""Starter of "Straight line": moves from end to end in joint space: the path of the tool is an arc.

    python starter.py --host 127.0.0.1 --port 5020

Positions and torques are lists of joints 1 to 4: degrees, degrees, mm, degrees; N·m, N·m, N, N·m.
"""

import argparse
import time

from pymodbus.client import ModbusTcpClient

PERIOD = 0.02  # period of the control cycle, s
DURATION = 9.0  # s

KP = (0.25, 0.25, 0.03, 0.004)  # N·m per degree of error; joint 3: N per mm
KD = (0.04, 0.03, 0.002, 0.0005)  # N·m per degree/s of speed; joint 3: N per mm/s
WEIGHT = (0.0, 0.0, -0.5 * 9.81, 0.0)  # joint 3 counts positive downwards and carries the quill
MAX_ERROR = (30.0, 30.0, 40.0, 60.0)  # a larger error counts as this, so that the arm stays slow
START = [-68.4, 83.6, 79.0, 0.0]
END = [-15.2, 83.6, 79.0, 0.0]


def goal(now: float) -> list[float]:
    """Return the wanted position of the joints at a time, s."""
    # Yours: points on the line, each with its inverse kinematics.
    share = min(max((now - 3) / 4, 0.0), 1.0)
    return [a + share * (b - a) for a, b in zip(START, END, strict=True)]


def torques(now: float, position: list[float], speed: list[float]) -> list[float]:
    """Return the torques of a proportional and derivative law toward `goal(now)`."""
    result = []
    for joint, wanted in enumerate(goal(now)):
        error = max(-MAX_ERROR[joint], min(MAX_ERROR[joint], wanted - position[joint]))
        result.append(KP[joint] * error - KD[joint] * speed[joint] + WEIGHT[joint])
    return result


def main() -> None:
    """Close the loop for DURATION."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=5020)
    options = parser.parse_args()
    client = ModbusTcpClient(options.host, port=options.port)
    if not client.connect():
        raise SystemExit(f"can't connect to a rig at {options.host}:{options.port}: is hilrig up running?")
    begin = due = time.monotonic()
    before, speed = None, [0.0] * 4
    while (now := time.monotonic() - begin) < DURATION:
        # 1. Read registers 5-8. A word from 32768 on is a negative number.
        answer = client.read_holding_registers(4, count=4)
        if answer.isError():
            raise SystemExit(f"reading failed: {answer}")
        position = [(word - 65536 if word > 32767 else word) / 100 for word in answer.registers]
        # 2. The speed is a filtered difference, because positions have steps of 0.01.
        if before is not None:
            speed = [0.5 * s + 0.5 * (p - b) / PERIOD for s, p, b in zip(speed, position, before, strict=True)]
        before = position
        # 3. Compute and write registers 1-4, then wait.
        words = [round(1000 * max(-32.7, min(32.7, torque))) & 0xFFFF for torque in torques(now, position, speed)]
        answer = client.write_registers(0, words)
        if answer.isError():
            raise SystemExit(f"writing failed: {answer}")
        due = max(due + PERIOD, time.monotonic() - PERIOD)
        time.sleep(max(0.0, due - time.monotonic()))
    client.write_registers(0, [0, 0, 0, 0])
    client.close()


if __name__ == "__main__":
    main()
