"""Example controller for hilrig that picks every part and places it in the tray.

It uses only the rig's Modbus registers (holding registers 1-4: torques, 5-8: positions, coil 1: magnet), the data
sheet of the arm, and the task: the positions of the parts and their places in the tray.

    python pick_and_place.py --host 127.0.0.1 --port 5020 --duration 20

Method:
- a plan of moves from pose to pose (inverse kinematics computes the joints);
- each move follows an S-curve (quintic polynomial) with continuous acceleration;
- torque = feedforward of the model (inertia, friction, gravity including the held part)
         + PD feedback of the error, which corrects the errors of the model;
- the magnet is switched when the measured position is at rest at its goal. The time on the curve is not sufficient: if
  the computer or the network is delayed, the arm is behind its curve.
"""

import argparse
import json
import math
import sys
import time
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pymodbus.client import ModbusTcpClient
from pymodbus.exceptions import ModbusException
from pymodbus.pdu import ModbusPDU

# Data sheet of the arm: meters, kilograms, newtons.
L1, L2, L3 = 0.139, 0.300, 0.300
M1, M2, M3, J4 = 1.0, 1.0, 0.5, 0.005
FRICTION = np.array([2.0, 2.0, 5.0, 0.05])
GRAVITY = 9.81
LOWER = np.array([math.radians(-133), math.radians(-153), 0.0, math.radians(-327)])
UPPER = np.array([math.radians(133), math.radians(153), 0.200, math.radians(327)])
LARGEST_EFFORT = 32.767  # range of the registers

# Limits of a move.
SPEED = np.array([4.5, 4.5, 0.70, 9.0])
ACCELERATION = np.array([20.0, 20.0, 9.0, 50.0])

# Feedback: with stiffness w(B + wM) and damping 2wM, an error decays at the rates w and w + friction/inertia. A larger
# latency requires a smaller w.
LARGEST_RATE = 6.0
RATE_TIMES_LATENCY = 0.22
ERROR_FILTER_S = 0.03
STALE_S = 0.025  # unchanged positions count as new ones after this time
LEAD_S = 0.02  # mean time from the write of a torque to its effect: to the rig's next step, and half of it
SHORT_CYCLE_S = 0.030  # with a longer control cycle, moves are slowed down
CYCLE_LEAD = 1.25  # additional lead per additional cycle time: three quarters in transit, half of one in effect
FAST = 0.5  # (rad/s)²: speed from which the lag of the arm can be measured
LAG_SHARE = 0.15  # weight of a new lag measurement in the moving average
LARGEST_LAG_S = 0.25
HELD_UP_S = 0.045  # positions that are delayed by more than two steps of the rig indicate an interruption

PERIOD_S = 0.010
RIG_STEP_S = 0.020
CLEARANCE_Z = 0.025  # height of the tip while moving, m: a carried part passes over all others
HOVER = 0.001  # distance between tip and part when picking and placing, m
# Tolerances for passing an intermediate pose, and for switching the magnet: position, and speed (per second).
PASSED = np.array([math.radians(4.0), math.radians(4.0), 0.006, math.radians(10.0)])
IN_PLACE = np.array([math.radians(0.05), math.radians(0.05), 0.0008, math.radians(1.0)])
AT_REST = np.array([math.radians(1.0), math.radians(1.0), 0.010, math.radians(10.0)])
REST_S = 0.04  # minimum time at rest before the magnet is switched: two steps of the rig
GRIP_S = 0.10

HOME = np.array([0.0, 0.0, L1 - CLEARANCE_Z, 0.0])


@dataclass(frozen=True)
class Part:
    """Part of the task: center of its footprint, m; yaw, rad; mass, kg."""

    name: str
    x: float
    y: float
    yaw: float
    height: float
    mass: float


@dataclass(frozen=True)
class Place:
    """Place of a part in a tray: m, rad."""

    x: float
    y: float
    z: float
    yaw: float


@dataclass(frozen=True)
class Task:
    """Parts and their places."""

    parts: tuple[Part, ...]
    places: tuple[Place, ...]
    table: float = -0.060


DEFAULT_SCENE = {
    "parts": [
        {"name": "red", "mass_kg": 0.20, "position_mm": [376, 137]},
        {"name": "blue", "mass_kg": 0.30, "position_mm": [328, 229], "yaw_deg": 35},
        {"name": "green", "mass_kg": 0.15, "position_mm": [257, 306]},
        {"name": "yellow", "mass_kg": 0.25, "position_mm": [169, 363], "yaw_deg": 65},
    ],
    "trays": [{"name": "tray", "position_mm": [320, -220], "yaw_deg": -35}],
}


def task_of(scene: dict[str, Any]) -> Task:
    """Read the task from the `[scene]` of a lab's file; missing keys have hilrig's defaults."""
    table = scene.get("table", {}).get("height_mm", -60.0) / 1000
    parts = []
    for part in scene.get("parts", DEFAULT_SCENE["parts"]):
        x, y = part["position_mm"]
        height = part.get("size_mm", [40, 40, 30])[2] / 1000
        yaw = math.radians(part.get("yaw_deg", 0.0))
        if part.get("ferromagnetic", True):
            parts.append(Part(part["name"], x / 1000, y / 1000, yaw, height, part.get("mass_kg", 0.2)))
    places = []
    for tray in scene.get("trays", DEFAULT_SCENE["trays"]):
        x, y = tray["position_mm"]
        yaw = math.radians(tray.get("yaw_deg", 0.0))
        rows, columns, pitch = tray.get("rows", 2), tray.get("columns", 2), tray.get("pitch_mm", 70.0)
        top = table + tray.get("size_mm", [150, 150, 8])[2] / 1000
        for row in range(rows):
            for column in range(columns):
                u, v = (row - (rows - 1) / 2) * pitch, (column - (columns - 1) / 2) * pitch
                across, along = math.cos(yaw) * u - math.sin(yaw) * v, math.sin(yaw) * u + math.cos(yaw) * v
                places.append(Place((x + across) / 1000, (y + along) / 1000, top, yaw))
    return Task(tuple(parts), tuple(places), table)


# --- The arm ---------------------------------------------------------------------------------------------------------


def joints_for(x: float, y: float, z: float, yaw: float, near: np.ndarray) -> np.ndarray:
    """Inverse kinematics of a tool pose: of the two solutions, the one that is nearer to the joints `near`."""
    cosine = (x * x + y * y - L2 * L2 - L3 * L3) / (2 * L2 * L3)
    if abs(cosine) > 1:
        raise ValueError(f"({x:.3f}, {y:.3f}) m is out of the arm's reach")
    best = None
    for theta2 in (math.acos(cosine), -math.acos(cosine)):
        theta1 = math.atan2(y, x) - math.atan2(L3 * math.sin(theta2), L2 + L3 * math.cos(theta2))
        theta1 = math.remainder(theta1, 2 * math.pi)
        theta4 = yaw - theta1 - theta2
        theta4 = near[3] + math.remainder(theta4 - near[3], 2 * math.pi)
        joints = np.array([theta1, theta2, L1 - z, theta4])
        if np.all((joints >= LOWER) & (joints <= UPPER)):
            distance = np.abs(joints - near)[:2].max()
            if best is None or distance < best[0]:
                best = (distance, joints)
    if best is None:
        raise ValueError(f"({x:.3f}, {y:.3f}, {z:.3f}) m is not within the joints' limits")
    return best[1]


def efforts_for(
    joints: np.ndarray, speed: np.ndarray, acceleration: np.ndarray, held_mass: float
) -> tuple[np.ndarray, np.ndarray]:
    """Inverse dynamics: torques for a motion, and the mass matrix, which scales the feedback."""
    mass = M2 + M3 + held_mass
    p, ps = mass * L2 * L3 * math.cos(joints[1]), mass * L2 * L3 * math.sin(joints[1])
    a22 = mass * L3 * L3
    matrix = np.diag([L2 * L2 * (M1 + mass) + 2 * p + a22, a22, M3 + held_mass, J4])
    matrix[0, 1] = matrix[1, 0] = p + a22
    coriolis = np.array([-ps * speed[1] * (2 * speed[0] + speed[1]), ps * speed[0] ** 2, 0.0, 0.0])
    gravity = np.array([0.0, 0.0, -GRAVITY * (M3 + held_mass), 0.0])
    return matrix @ acceleration + coriolis + FRICTION * speed + gravity, matrix


class Move:
    """S-curve between two joint positions: all joints start and arrive together, at rest; `slowed` is a time factor."""

    def __init__(self, start: np.ndarray, goal: np.ndarray, slowed: float = 1.0) -> None:
        self.start, self.goal = start, goal
        distance = np.abs(goal - start)
        # Maxima of the quintic: speed 15/8 of the mean, acceleration 10/sqrt(3) times distance / time².
        fastest = float(max((1.875 * distance / SPEED).max(), np.sqrt(5.774 * distance / ACCELERATION).max()))
        self.duration = slowed * max(0.1, fastest)

    def at(self, time_s: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions, speeds and accelerations of the joints at a time."""
        distance, duration = self.goal - self.start, self.duration
        s = min(max(time_s / duration, 0.0), 1.0)
        position = s**3 * (10 - 15 * s + 6 * s * s)
        speed = 30 * s * s * (1 - s) ** 2 / duration
        acceleration = 60 * s * (1 - s) * (1 - 2 * s) / duration**2
        return self.start + distance * position, distance * speed, distance * acceleration


# --- The plan --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Stage:
    """Move to a goal; if `switches` is set, the magnet is switched once the arm is at rest there."""

    text: str
    goal: np.ndarray
    switches: bool = False
    magnet: bool = False
    held_mass: float = 0.0
    placed: int = 0


def plan(task: Task, start: np.ndarray) -> Iterator[Stage]:
    """Generate the stages of the task from the joints `start`, part by part."""
    here = np.array([start[0], start[1], HOME[2], start[3]])
    yield Stage("up", here)
    for number, (part, place) in enumerate(zip(task.parts, task.places, strict=False), start=1):
        top = task.table + part.height
        above = joints_for(part.x, part.y, CLEARANCE_Z, part.yaw, here)
        at = joints_for(part.x, part.y, top + HOVER, part.yaw, above)
        yield Stage(f"over {part.name}", above)
        yield Stage(f"pick {part.name}", at, switches=True, magnet=True, held_mass=part.mass)
        yield Stage(f"lift {part.name}", above, magnet=True, held_mass=part.mass)
        above_place = joints_for(place.x, place.y, CLEARANCE_Z, place.yaw, above)
        at_place = joints_for(place.x, place.y, place.z + part.height + HOVER, place.yaw, above_place)
        yield Stage(f"carry {part.name}", above_place, magnet=True, held_mass=part.mass)
        yield Stage(f"place {part.name}", at_place, switches=True, placed=number)
        yield Stage("up", above_place, placed=number)
        here = above_place
    yield Stage("home", HOME, placed=min(len(task.parts), len(task.places)))


class Controller:
    """Computes torques from positions according to the plan; independent of the communication."""

    def __init__(self, task: Task, log: Callable[[str], None] = lambda _: None) -> None:
        self._task = task
        self._stages: Iterator[Stage] = iter(())
        self._log = log
        self._move: Move | None = None
        self._began_s = 0.0
        self._switched_s: float | None = None
        self._on_its_curve = True
        self._resting_s = 0.0
        self._held_mass = 0.0
        self._seen: np.ndarray | None = None
        self._seen_s = 0.0
        self._error = np.zeros(4)
        self._error_rate = np.zeros(4)
        self._speed = np.zeros(4)
        self._last_s = self._cycle_s = 0.0
        self.usual_cycle_s = PERIOD_S
        """Moving average of the time between updates."""
        self.magnet = False
        self.placed = 0
        self.doing = ""
        """Current stage; empty: the task is finished, or has not started."""
        self.done = False
        self.largest_error = np.zeros(4)
        self.lag_s = LEAD_S
        """Measured lag of the arm behind its curve: the loop latency, estimated while it moves."""

    @property
    def missing(self) -> list[str]:
        """Names of the parts that are not placed yet."""
        return [part.name for part in self._task.parts[self.placed :]]

    def update(self, now_s: float, joints: np.ndarray) -> np.ndarray:
        """Compute torques (N·m, N·m, N, N·m) for positions (rad, rad, m, rad) that were read at `now_s`."""
        self._cycle_s = min(max(0.0, now_s - self._last_s), 0.1)
        self._last_s = now_s
        # On a slow network both the cycle and the transmission of a torque take longer.
        self.usual_cycle_s += 0.1 * (self._cycle_s - self.usual_cycle_s)
        lead_s = LEAD_S + CYCLE_LEAD * max(0.0, self.usual_cycle_s - PERIOD_S)
        if self._move is None:
            self._stages = plan(self._task, joints)
            self._stage = next(self._stages)
            self._begin(now_s, joints)
        self._compare(now_s, joints)
        self._advance(now_s, joints)
        assert self._move is not None
        # The torques take effect after the lead time.
        position, speed, acceleration = self._move.at(now_s - self._began_s + lead_s)
        feedforward, matrix = efforts_for(position, speed, acceleration, self._held_mass)
        rate = min(LARGEST_RATE, RATE_TIMES_LATENCY / max(lead_s, self.lag_s))
        feedback = rate * (FRICTION * self._error + matrix @ (rate * self._error + 2 * self._error_rate))
        return np.clip(feedforward + feedback, -LARGEST_EFFORT, LARGEST_EFFORT)

    def _compare(self, now_s: float, joints: np.ndarray) -> None:
        """Update the error and its rate whenever the rig has made a step.

        Between steps the rig returns the same positions: comparing them with the advancing reference would give false
        errors. The positions are also compared with the reference of an earlier time, because of the lag.
        """
        assert self._move is not None
        since_s = now_s - self._seen_s
        then, speed, _ = self._move.at(now_s - self._began_s - self.lag_s)
        fast = float(speed[:2] @ speed[:2])
        same = self._seen is not None and np.array_equal(joints, self._seen)
        if same and (since_s < STALE_S or fast > FAST):
            return
        error = then - joints
        # An error in the direction of the motion is a lag: the arm is on its curve, but late.
        late_s = float(error[:2] @ speed[:2]) / fast if fast > FAST else 0.0
        if since_s > max(HELD_UP_S, 2 * self.usual_cycle_s):
            # The rig or this program was interrupted: shift the curve in time, so that it waits for the arm.
            self._began_s += min(max(0.0, late_s), since_s)
            error = self._move.at(now_s - self._began_s - self.lag_s)[0] - joints
            self._on_its_curve = False
        elif self._on_its_curve:
            self.lag_s = min(max(self.lag_s + LAG_SHARE * late_s, 0.0), LARGEST_LAG_S)
        # Filtered difference quotients: exact on a ramp for any period of the positions.
        share = (1.0 - math.exp(-since_s / ERROR_FILTER_S)) / max(since_s, 1e-3)
        if self._seen is not None:
            self._speed += share * (joints - self._seen - self._speed * since_s)
            self._error_rate += share * (error - self._error - self._error_rate * since_s)
        self._seen, self._seen_s, self._error = joints, now_s, error
        self.largest_error = np.maximum(self.largest_error, np.abs(error))

    def _begin(self, now_s: float, start: np.ndarray) -> None:
        # A torque is held for a cycle: the longer the cycle, the slower the motion must be.
        self._move = Move(start, self._stage.goal, max(1.0, self.usual_cycle_s / SHORT_CYCLE_S))
        self._began_s = now_s
        self._switched_s = None
        self._on_its_curve = True
        self.doing = self._stage.text
        self._log(self.doing)

    def _advance(self, now_s: float, joints: np.ndarray) -> None:
        """Start the next stage when the measured position has reached the goal of this one."""
        stage, move = self._stage, self._move
        assert move is not None
        if self.done or now_s - self._began_s < move.duration:
            return
        distance = np.abs(joints - stage.goal)
        if not stage.switches:
            if np.all(distance < PASSED):
                self._start_next_stage(now_s)
        elif self._switched_s is None:
            resting = np.all(distance < IN_PLACE) and np.all(np.abs(self._speed) < AT_REST)
            # A long cycle is still only one measurement.
            self._resting_s = self._resting_s + min(self._cycle_s, self.usual_cycle_s) if resting else 0.0
            if self._resting_s >= max(REST_S, 1.5 * self.usual_cycle_s):
                self._switched_s = now_s
                self.magnet, self._held_mass = stage.magnet, stage.held_mass
        elif now_s - self._switched_s >= GRIP_S:
            self._start_next_stage(now_s)

    def _start_next_stage(self, now_s: float) -> None:
        self.placed = max(self.placed, self._stage.placed)
        following = next(self._stages, None)
        if following is None:
            self.done, self.doing = True, ""
        else:
            goal, self._stage = self._stage.goal, following
            self._begin(now_s, goal)


# --- The registers ---------------------------------------------------------------------------------------------------


class Rig:
    """Modbus client of a rig: the registers of the paper."""

    def __init__(self, host: str, port: int) -> None:
        self._client = ModbusTcpClient(host, port=port, timeout=3.0, retries=0)
        if not self._client.connect():
            raise ConnectionError(f"can't connect to a rig at {host}:{port}")

    def read(self) -> np.ndarray:
        """Read joint positions: rad, rad, m, rad (registers: degrees and millimeters times 100)."""
        return joints_of(self._client.read_holding_registers(4, count=4))

    def write(self, efforts: np.ndarray) -> None:
        """Write torques: N·m, N·m, N, N·m (registers: thousandths)."""
        answer = self._client.write_registers(0, registers_of(efforts))
        if answer.isError():
            raise ConnectionError(f"the rig rejected the torques: {answer}")

    def exchange(self, efforts: np.ndarray) -> np.ndarray:
        """Write torques and read positions in one request (function 23), that is, in one round trip."""
        return joints_of(
            self._client.readwrite_registers(
                read_address=4, read_count=4, write_address=0, values=registers_of(efforts)
            )
        )

    def switch(self, magnet: bool) -> None:
        """Switch the magnet on or off."""
        answer = self._client.write_coil(0, magnet)
        if answer.isError():
            raise ConnectionError(f"the rig rejected the magnet command: {answer}")

    def close(self) -> None:
        """Zero the torques and disconnect."""
        try:
            self.write(np.zeros(4))
        except (ConnectionError, ModbusException):
            pass
        finally:
            self._client.close()


def joints_of(answer: ModbusPDU) -> np.ndarray:
    """Convert a response to joint positions."""
    if answer.isError():
        raise ConnectionError(f"the rig rejected the request: {answer}")
    values = np.array(answer.registers, dtype=np.uint16).astype(np.int16) / 100
    return np.array([math.radians(values[0]), math.radians(values[1]), values[2] / 1000, math.radians(values[3])])


def registers_of(efforts: np.ndarray) -> list[int]:
    """Convert torques to register values."""
    return [int(value) for value in np.rint(efforts * 1000).astype(np.int16).view(np.uint16)]


def control(
    rig: Rig, controller: Controller, duration_s: float, overtime_s: float = 0.0, *, once: bool = False
) -> dict[str, Any]:
    """Close the loop every `PERIOD_S`, or as often as the network allows, for `duration_s`; return the result.

    If the task is not finished by then, it may take `overtime_s` more. With `once`, return as soon as it is finished.
    """
    began_s = time.monotonic()
    joints, request_s = rig.read(), time.monotonic() - began_s
    for _ in range(2):
        asked_s = time.monotonic()
        joints = rig.read()
        request_s = min(request_s, time.monotonic() - asked_s)
    # A read followed by a write uses the newest positions, but needs two requests. If these take longer than a period,
    # one combined request halves the cycle, and the positions are not older.
    slow = 2 * request_s > PERIOD_S
    # The period of the rig's steps gives positions of constant age; a slower network determines the period itself.
    period_s = RIG_STEP_S if slow else PERIOD_S
    controller.usual_cycle_s = max(period_s, request_s)
    deadline_s, cycles, magnet, done_s = time.monotonic(), 0, False, None
    while (now_s := time.monotonic()) - began_s < duration_s + (0.0 if controller.done else overtime_s):
        if not slow:
            joints = rig.read()
        efforts = controller.update(now_s, joints)
        if controller.magnet != magnet:
            # Before the torques that include the part's weight: without a part on the magnet they would lift the quill.
            magnet = controller.magnet
            rig.switch(magnet)
        if slow:
            joints = rig.exchange(efforts)
        else:
            rig.write(efforts)
        cycles += 1
        if controller.done and done_s is None:
            done_s = now_s - began_s
            if once:
                break
        deadline_s = max(deadline_s + period_s, time.monotonic() - period_s)
        time.sleep(max(0.0, deadline_s - time.monotonic()))
    return {
        "placed": controller.placed,
        "missing": controller.missing,
        "doing": controller.doing,
        "done_s": done_s,
        "duration_s": time.monotonic() - began_s,
        "cycles": cycles,
        "cycles_per_s": cycles / (time.monotonic() - began_s),
        "largest_error_deg_mm": [
            float(value)
            for value in controller.largest_error * [math.degrees(1), math.degrees(1), 1e3, math.degrees(1)]
        ],
    }


def sentence(result: dict[str, Any]) -> str:
    """Describe the result in one line."""
    text = f"{result['placed']} of {result['parts']} parts placed"
    if result["done_s"] is not None:
        text += f" in {result['done_s']:.1f} s"
    elif result["missing"]:
        text += f", missing {', '.join(result['missing'])}: the time ended during {result['doing']!r}"
    return f"{text}; {result['cycles_per_s']:.0f} cycles per second"


def main() -> int:
    """Run the controller; exit code 0: all parts placed, 1: parts missing, 2: invalid task, 3: no connection."""
    parser = argparse.ArgumentParser(description="Pick every part and place it in the tray.")
    parser.add_argument("--host", default="127.0.0.1", help="address of the rig")
    parser.add_argument("--port", type=int, default=5020, help="Modbus TCP port of the rig")
    parser.add_argument("--duration", type=float, default=20.0, help="duration, s")
    parser.add_argument("--overtime", type=float, default=0.0, help="extra time if the task is not finished, s")
    parser.add_argument("--once", action="store_true", help="stop when the task is finished")
    parser.add_argument(
        "--scene", type=Path, help="lab.toml whose [scene] is the task; default: hilrig's default scene"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object at the end on standard output")
    options = parser.parse_args()
    try:
        scene = tomllib.loads(options.scene.read_text(encoding="utf-8")).get("scene", {}) if options.scene else {}
        task = task_of(scene)
        list(plan(task, HOME))
    except (OSError, ValueError, KeyError) as error:
        print(f"invalid task: {error}", file=sys.stderr)
        return 2
    goal = min(len(task.parts), len(task.places))
    out = sys.stderr if options.json else sys.stdout
    began_s = time.monotonic()
    controller = Controller(
        task, lambda text: print(f"{time.monotonic() - began_s:6.2f} s  {text}", file=out, flush=True)
    )
    try:
        rig = Rig(options.host, options.port)
        try:
            result = control(rig, controller, options.duration, options.overtime, once=options.once)
        finally:
            rig.close()
    except (ConnectionError, ModbusException) as error:
        print(f"connection to the rig failed: {error}", file=sys.stderr)
        return 3
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return 1
    result = {"parts": goal, **result}
    if options.json:
        print(json.dumps(result))
    else:
        print(sentence(result))
    return 0 if result["placed"] == goal else 1


if __name__ == "__main__":
    sys.exit(main())
