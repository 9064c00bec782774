"""A study's controller on a real rig, over Modbus TCP: the same object that runs in virtual time, one run of it.

The controller polls at absolute times, so that its phase to the simulation's ticks is the study's. Where the ticks are
is heard from a rig of the same simulation that nothing is injected into: rigs of one simulation tick together.
"""

import time
from collections.abc import Callable
from typing import Any, Final, cast

import numpy as np
from pymodbus.client import ModbusTcpClient
from pymodbus.exceptions import ModbusException
from pymodbus.pdu import ModbusPDU

from hilrig_modbus_edge.registers import codec
from hilrig_modbus_edge.registers.map import POSITION_ADDRESS, TORQUE_ADDRESS
from hilrig_runtime.errors import OperationError
from hilrig_study.controllers.controllers import Controller, Measured
from hilrig_study.simulation.simulated_loop import Scenario

LISTEN_S: Final = 0.5
"""How long the ticks are listened to."""
_STEP_ADDRESS: Final = 2
_LATENCY_ADDRESS: Final = 4
_SPIN_NS: Final = 300_000


class RigClient:
    """A connection to one rig."""

    def __init__(self, host: str, port: int) -> None:
        """Connect.

        Raises:
            OperationError: no rig answers there.
        """
        self._where = f"{host}:{port}"
        # pymodbus leaves some of its methods without types.
        self._client = cast(Any, ModbusTcpClient(host, port=port, timeout=3))
        if not self._client.connect():
            raise OperationError(f"no rig answers at {self._where}")

    def step(self) -> int:
        """Step counter of the newest state, low 32 bits."""
        high, low = self._read(lambda: self._client.read_input_registers(_STEP_ADDRESS, count=2))
        return high << 16 | low

    def latency_s(self) -> float:
        """Last loop latency that the rig saw, s."""
        high, low = self._read(lambda: self._client.read_input_registers(_LATENCY_ADDRESS, count=2))
        return (high << 16 | low) * 1e-6

    def position(self) -> tuple[float, float, float, float]:
        """Joint positions as registers 5-8 say them; rad, rad, m, rad."""
        words = self._read(lambda: self._client.read_holding_registers(POSITION_ADDRESS, count=4))
        return codec.position_of(b"".join(word.to_bytes(2, "big") for word in words))

    def write(self, effort: list[float]) -> None:
        """Write registers 1-4; N·m, N·m, N, N·m."""
        data, _ = codec.words_of_effort(effort)
        words = [int.from_bytes(data[at : at + 2], "big") for at in range(0, 8, 2)]
        self._read(lambda: self._client.write_registers(TORQUE_ADDRESS, words))

    def close(self) -> None:
        """End the connection."""
        self._client.close()

    def _read(self, request: Callable[[], ModbusPDU]) -> list[int]:
        try:
            answer = request()
        except ModbusException as error:
            raise OperationError(f"the rig at {self._where} does not answer any more: {error}") from error
        if answer.isError():
            raise OperationError(f"the rig at {self._where} refused a request: {answer}")
        return list(answer.registers)


def listen_for_ticks(clock_rig: RigClient, step_ns: int) -> int:
    """A time of the monotonic clock, ns, at which a state of the simulation got to the edge, as early as was seen.

    Raises:
        OperationError: the step counter stood still.
    """
    begin_ns = time.monotonic_ns()
    before, phases = clock_rig.step(), []
    while time.monotonic_ns() - begin_ns < LISTEN_S * 1e9:
        step = clock_rig.step()
        if step != before:
            # Not when it was asked: a request that is held up would show a change before it was.
            phases.append(time.monotonic_ns())
            before = step
        time.sleep(2e-4)
    if len(phases) < 3:
        raise OperationError("the simulation does not step: its counter stood still")
    # A change is seen late by a request and the time between two, or more, never early: the earliest is the nearest.
    later = (np.array(phases) - phases[0] + step_ns // 2) % step_ns - step_ns // 2
    return int(phases[0] + later.min())


def drive(
    rig: RigClient,
    controller: Controller,
    scenario: Scenario,
    first_read_ns: int,
    period_ns: int,
    duration_s: float,
) -> None:
    """Run a controller of one run on a rig for `duration_s`, reading first at `first_read_ns`, monotonic clock.

    Raises:
        InputError: the controller raised or gave no numbers.
        OperationError: the rig stopped answering.
    """
    controller.begin(1)
    latency_s, due_ns = 0.0, first_read_ns
    while due_ns - first_read_ns < duration_s * 1e9:
        _wait_until(due_ns)
        position = np.array(rig.position())[:, np.newaxis]
        now = np.array([(due_ns - first_read_ns) * 1e-9])
        effort = controller.update(Measured(now, position, scenario.goal(now), np.array([latency_s])), None)
        rig.write(effort[:, 0].tolist())
        # Asked for after the write, so that it delays nothing.
        latency_s = rig.latency_s()
        due_ns += period_ns


def _wait_until(due_ns: int) -> None:
    remaining_ns = due_ns - time.monotonic_ns()
    if remaining_ns > _SPIN_NS:
        time.sleep((remaining_ns - _SPIN_NS) * 1e-9)
    while time.monotonic_ns() < due_ns:
        pass
