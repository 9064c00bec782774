"""Control of the arm for the reference solutions: model, inverse kinematics, moves, and the loop over Modbus TCP."""

import argparse
import math
import time
from collections.abc import Callable, Sequence

import numpy as np
from pymodbus.client import ModbusTcpClient

L1, L2, L3 = 0.139, 0.300, 0.300
M1, M2, M3, J4 = 1.0, 1.0, 0.5, 0.005
FRICTION = np.array([2.0, 2.0, 5.0, 0.05])
GRAVITY = 9.81
TO_REGISTER = np.array([18000 / math.pi, 18000 / math.pi, 100_000.0, 18000 / math.pi])
PERIOD = 0.02
DIFFERENCE = 0.004  # step of the difference quotients of a reference, s

Reference = Callable[[float], np.ndarray]
"""Joint positions (rad, rad, m, rad) at a time, s."""


def joints_for(x: float, y: float, z: float, yaw: float = 0.0, elbow: int = 1) -> np.ndarray:
    """Inverse kinematics of a tool pose, mm and degrees; `elbow`: sign of joint 2."""
    x, y, z, yaw = x / 1000, y / 1000, z / 1000, math.radians(yaw)
    theta2 = elbow * math.acos((x * x + y * y - L2 * L2 - L3 * L3) / (2 * L2 * L3))
    theta1 = math.atan2(y, x) - math.atan2(L3 * math.sin(theta2), L2 + L3 * math.cos(theta2))
    return np.array([theta1, theta2, L1 - z, yaw - theta1 - theta2])


def joints(*degrees_and_mm: float) -> np.ndarray:
    """Joint positions in degrees and mm as rad and m."""
    return np.array(degrees_and_mm) / TO_REGISTER * 100


def smooth(share: float) -> float:
    """Share of a quintic move, with zero speed and acceleration at both ends, at a share of its time."""
    s = min(max(share, 0.0), 1.0)
    return s**3 * (10 - 15 * s + 6 * s * s)


def move(start: np.ndarray, goal: np.ndarray, seconds: float) -> Reference:
    """Move of all joints from one position to another one."""
    return lambda t: start + smooth(t / seconds) * (goal - start)


def line(start: Sequence[float], goal: Sequence[float], seconds: float, elbow: int = 1) -> Reference:
    """Straight motion of the tool between two points, mm."""
    begin, way = np.array(start, float), np.subtract(goal, start)

    def reference(t: float) -> np.ndarray:
        x, y, z = begin + smooth(t / seconds) * way
        return joints_for(x, y, z, elbow=elbow)

    return reference


def efforts(q: np.ndarray, v: np.ndarray, a: np.ndarray, held: float) -> tuple[np.ndarray, np.ndarray]:
    """Inverse dynamics: torques for a motion with a held mass, kg, and the mass matrix."""
    mass = M2 + M3 + held
    p, ps, a22 = mass * L2 * L3 * math.cos(q[1]), mass * L2 * L3 * math.sin(q[1]), mass * L3 * L3
    matrix = np.diag([L2 * L2 * (M1 + mass) + 2 * p + a22, a22, M3 + held, J4])
    matrix[0, 1] = matrix[1, 0] = p + a22
    forces = np.array([-ps * v[1] * (2 * v[0] + v[1]), ps * v[0] ** 2, -GRAVITY * (M3 + held), 0.0])
    return matrix @ a + forces + FRICTION * v, matrix


class Arm:
    """The arm behind its registers; `delay`: known additional delay of the loop, s, `rate`: of the feedback, 1/s."""

    def __init__(self, delay: float = 0.0, rate: float = 6.0) -> None:
        self._goal: np.ndarray | None = None
        parser = argparse.ArgumentParser()
        parser.add_argument("--host", default="127.0.0.1")
        parser.add_argument("--port", type=int, default=5020)
        options = parser.parse_args()
        self._client = ModbusTcpClient(options.host, port=options.port)
        if not self._client.connect():
            raise SystemExit(f"can't connect to a rig at {options.host}:{options.port}")
        self._delay, self._rate, self._held = delay, rate, 0.0
        self.q = self._read()
        self._speed = np.zeros(4)
        self._at = self._due = time.monotonic()

    def follow(self, reference: Reference, seconds: float) -> None:
        """Follow a reference for a time."""
        begin = time.monotonic()
        while (t := time.monotonic() - begin) < seconds:
            before, self.q = self.q, self._read()
            now = time.monotonic()
            self._speed += 0.5 * ((self.q - before) / max(now - self._at, 0.005) - self._speed)
            self._at = now
            # The torque acts half a step and the delay of the commands later; the position is old by as much.
            ahead = t + 0.01 + self._delay / 2
            early, q, late = (reference(ahead + step * DIFFERENCE) for step in (-1, 0, 1))
            v, a = (late - early) / (2 * DIFFERENCE), (late - 2 * q + early) / DIFFERENCE**2
            wanted, matrix = efforts(q, v, a, self._held)
            measured = t - 0.01 - self._delay / 2
            error = reference(measured) - self.q
            change = (reference(measured + DIFFERENCE) - reference(measured - DIFFERENCE)) / (2 * DIFFERENCE)
            rate = self._rate
            wanted += rate * (FRICTION * error + matrix @ (rate * error + 2 * (change - self._speed)))
            self._write(wanted)
            self._due = max(self._due + PERIOD, time.monotonic() - PERIOD)
            time.sleep(max(0.0, self._due - time.monotonic()))

    def move(self, goal: np.ndarray, seconds: float, rest: float = 0.6) -> None:
        """Move the joints to a position, and rest there."""
        start = self.q if self._goal is None else self._goal
        self._goal = goal
        self.follow(move(start, goal, seconds), seconds + rest)

    def line(self, start: Sequence[float], goal: Sequence[float], seconds: float, rest: float = 0.1) -> None:
        """Move the tool straight from one point to another one, mm."""
        x, y, z = goal
        self._goal = joints_for(x, y, z)
        self.follow(line(start, goal, seconds), seconds + rest)

    def magnet(self, on: bool, held: float = 0.0) -> None:
        """Switch the magnet, and wait; `held` is the mass that it holds then, kg."""
        self._client.write_coil(0, on)
        self._held = held
        self.move(self.q if self._goal is None else self._goal, 0.1, rest=0.2 + self._delay)

    def close(self) -> None:
        """Zero the torques and disconnect."""
        self._write(np.zeros(4))
        self._client.close()

    def _read(self) -> np.ndarray:
        answer = self._client.read_holding_registers(4, count=4)
        if answer.isError():
            raise SystemExit(f"reading failed: {answer}")
        return np.array([word - 65536 if word > 32767 else word for word in answer.registers]) / TO_REGISTER

    def _write(self, torques: np.ndarray) -> None:
        words = [round(1000 * max(-32.767, min(32.767, torque))) & 0xFFFF for torque in torques.tolist()]
        if (answer := self._client.write_registers(0, words)).isError():
            raise SystemExit(f"writing failed: {answer}")
