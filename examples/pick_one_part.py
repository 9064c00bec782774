"""Example for a first own program: picks the red part and puts it down in the tray.

    pip install "pymodbus>=3.16"
    python pick_one_part.py --host 127.0.0.1 --port 5020

PART is the position of the part. Each run begins with a reset, which moves arm and parts back to their start.
"""

import argparse
import math
import sys
import time

from pymodbus.client import ModbusTcpClient

# Positions in mm from the foot of the arm; z is up. The tip has to be 2 mm above the top of the part.
PART = (376.0, 137.0, -28.0)
PLACE = (271.0, -229.0, -20.0)
SAFE_Z = 30.0  # height of the tip while it moves sideways, mm

PERIOD = 0.02  # period of the control cycle, s
KP = (0.25, 0.25, 0.03, 0.004)  # N·m per degree of error; joint 3: N per mm
KD = (0.04, 0.03, 0.002, 0.0005)  # N·m per degree/s of speed; joint 3: N per mm/s
MAX_ERROR = (30.0, 30.0, 40.0, 60.0)  # a larger error counts as this, so that the arm stays slow
QUILL, PART_WEIGHT = 0.5 * 9.81, 0.2 * 9.81  # weights of the quill and of the red part, N


def joints_for(x: float, y: float, z: float) -> tuple[float, float, float, float]:
    """Return the joints (degrees, degrees, mm, degrees) that move the tip to a point; both links have 300 mm."""
    theta2 = math.acos((x * x + y * y - 2 * 300**2) / (2 * 300**2))
    theta1 = math.atan2(y, x) - theta2 / 2
    return math.degrees(theta1), math.degrees(theta2), 139.0 - z, 0.0


class Arm:
    """The arm behind its Modbus registers."""

    def __init__(self, client: ModbusTcpClient) -> None:
        self.client = client
        self.weight = QUILL
        self.before: list[float] = []
        self.speed = [0.0] * 4

    def cycle(self, goal: tuple[float, ...]) -> bool:
        """Do one control cycle; return whether the arm is at rest at its goal."""
        due = time.monotonic() + PERIOD
        # 1. Read registers 5-8. A word is not negative, so those from 32768 on are negative numbers.
        words = checked(self.client.read_holding_registers(4, count=4)).registers
        position = [(word - 65536 if word > 32767 else word) / 100 for word in words]
        # 2. The speed is a difference of positions, filtered because they have steps of 0.01.
        if self.before:
            self.speed = [
                0.5 * s + 0.5 * (p - b) / PERIOD for s, p, b in zip(self.speed, position, self.before, strict=True)
            ]
        self.before = position
        # 3. A spring to the goal, and a damper. Joint 3 counts positive downwards and carries the weight.
        error = [g - p for g, p in zip(goal, position, strict=True)]
        torque = [
            kp * max(-most, min(most, e)) - kd * s
            for kp, most, e, kd, s in zip(KP, MAX_ERROR, error, KD, self.speed, strict=True)
        ]
        torque[2] -= self.weight
        # 4. Write registers 1-4, then wait.
        checked(self.client.write_registers(0, [round(1000 * t) & 0xFFFF for t in torque]))
        time.sleep(max(0.0, due - time.monotonic()))
        return max(map(abs, error[:3])) < 0.5 and max(map(abs, self.speed[:3])) < 3.0

    def move_to(self, what: str, x: float, y: float, z: float) -> None:
        """Move the tip to a point."""
        print(what)
        goal, latest = joints_for(x, y, z), time.monotonic() + 10.0
        while not self.cycle(goal):
            if time.monotonic() > latest:
                raise RuntimeError(f"{what}: not there after 10 s, at {self.before}")

    def magnet(self, on: bool, x: float, y: float, z: float) -> None:
        """Switch the magnet, and hold the tip at a point until discrete input 11 reports a held part, or none."""
        checked(self.client.write_coil(0, on))
        latest = time.monotonic() + 2.0
        while checked(self.client.read_discrete_inputs(10, count=1)).bits[0] != on:
            if time.monotonic() > latest:
                raise RuntimeError("the magnet holds no part" if on else "the magnet still holds the part")
            self.cycle(joints_for(x, y, z))
        # Only now: with more force and without the part, the tip would rise.
        self.weight = QUILL + (PART_WEIGHT if on else 0.0)


def checked(answer):
    """Return the response of the rig, or raise its exception: 02 no such register, 06 another controller writes."""
    if answer.isError():
        raise RuntimeError(f"the rig refuses a request: {answer}")
    return answer


def main() -> None:
    """Pick the part and put it down."""
    parser = argparse.ArgumentParser(description="Pick the red part and put it down in the tray.")
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=5020)
    options = parser.parse_args()
    client = ModbusTcpClient(options.host, port=options.port)
    if not client.connect():
        raise RuntimeError(f"can't connect to a rig at {options.host}:{options.port}: is hilrig up running?")
    checked(client.write_coil(100, True))  # coil 101: reset
    time.sleep(0.1)
    arm = Arm(client)
    for what, point, on in (("the part", PART, True), ("the tray", PLACE, False)):
        arm.move_to(f"over {what}", *point[:2], SAFE_Z)
        arm.move_to(f"down to {what}", *point)
        arm.magnet(on, *point)
        arm.move_to("up", *point[:2], SAFE_Z)
    client.write_registers(0, [0, 0, 0, 0])
    print("done")


if __name__ == "__main__":
    try:
        main()
    except RuntimeError as error:
        sys.exit(f"pick_one_part: {error}")
