"""Live control loop: runs a controller of a study on a real rig over Modbus TCP.

The controller polls at absolute times, so that its phase relative to the ticks of the simulation is the phase in the
study. The tick times are measured on a rig of the same simulation without impairment, because all rigs of a simulation
share their ticks.
"""

import struct
import time
from collections.abc import Callable
from typing import Any, Final, cast

import numpy as np
from pymodbus.client import ModbusTcpClient
from pymodbus.exceptions import ModbusException
from pymodbus.pdu import ModbusPDU

from hilrig_modbus_edge.registers import codec
from hilrig_modbus_edge.registers.map import POSITION_ADDRESS, REGISTERS, TORQUE_ADDRESS
from hilrig_runtime.addresses import format_address
from hilrig_runtime.errors import OperationError
from hilrig_study.controllers.control_laws import Controller, Measurement
from hilrig_study.simulation.simulated_loop import Scenario

TICK_OBSERVATION_S: Final = 0.5
"""Duration of the tick phase measurement, s."""
MIN_TICKS: Final = 3
"""Fewest observed ticks of a valid measurement."""
_BUSY_WAIT_NS: Final = 300_000


class RigClient:
    """Modbus TCP connection to one rig."""

    def __init__(self, host: str, port: int) -> None:
        """Connect to the rig.

        Raises:
            OperationError: no rig accepts the connection.
        """
        self._address = format_address(host, port)
        # Some methods of pymodbus have no type annotations.
        self._client = cast(Any, ModbusTcpClient(host, port=port, timeout=3))
        if not self._client.connect():
            raise OperationError(f"no rig answers at {self._address}")

    def step(self) -> int:
        """Read the step counter of the newest state, low 32 bits."""
        return self._input("step")

    def latency_s(self) -> float:
        """Read the latest loop latency of the rig, s."""
        return self._input("loop_latency") * 1e-6

    def position(self) -> tuple[float, float, float, float]:
        """Read the joint positions, registers 5-8; rad, rad, m, rad."""
        values = self._request(lambda: self._client.read_holding_registers(POSITION_ADDRESS, count=4))
        return codec.position_of(b"".join(value.to_bytes(2, "big") for value in values))

    def write(self, effort: list[float]) -> None:
        """Write the efforts, registers 1-4; N·m, N·m, N, N·m."""
        data, _ = codec.words_of_effort(effort)
        values = [int.from_bytes(data[at : at + 2], "big") for at in range(0, 8, 2)]
        self._request(lambda: self._client.write_registers(TORQUE_ADDRESS, values))

    def close(self) -> None:
        """Close the connection."""
        self._client.close()

    def _input(self, name: str) -> int:
        """Read an input register, or the two of a 32-bit value, of the register map."""
        register = REGISTERS[name]
        words = self._request(lambda: self._client.read_input_registers(register.address, count=register.type.words))
        return int.from_bytes(struct.pack(f">{len(words)}H", *words))

    def _request(self, send: Callable[[], ModbusPDU]) -> list[int]:
        try:
            answer = send()
        except ModbusException as error:
            raise OperationError(f"the rig at {self._address} stopped responding: {error}") from error
        if answer.isError():
            raise OperationError(f"the rig at {self._address} rejected a request: {answer}")
        return list(answer.registers)


def measure_tick_phase(clock_rig: RigClient, step_ns: int) -> int:
    """Measure a time, ns, monotonic clock, at which a state of the simulation arrived at the edge.

    The estimate is the earliest observed phase, since an observation can only be late.

    Raises:
        OperationError: the step counter does not change.
    """
    start_ns = time.monotonic_ns()
    before, phases = clock_rig.step(), []
    while time.monotonic_ns() - start_ns < TICK_OBSERVATION_S * 1e9:
        step = clock_rig.step()
        if step != before:
            # The time after the reply: with the time of the request, a delayed request would show a change too early.
            phases.append(time.monotonic_ns())
            before = step
        time.sleep(2e-4)
    if len(phases) < MIN_TICKS:
        raise OperationError(
            "the simulation does not step: its step counter changed less than "
            f"{MIN_TICKS} times in {TICK_OBSERVATION_S:g} s"
        )
    # A change is observed late, by the duration and the spacing of the requests, and never early: use the earliest.
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
    """Run a controller on a rig for `duration_s`; the first read is at `first_read_ns`, monotonic clock.

    Raises:
        InputError: the controller raised an exception or returned invalid efforts.
        OperationError: the rig stopped answering.
    """
    controller.reset(1)
    latency_s, due_ns = 0.0, first_read_ns
    while due_ns - first_read_ns < duration_s * 1e9:
        _wait_until(due_ns)
        position = np.array(rig.position())[:, np.newaxis]
        now = np.array([(due_ns - first_read_ns) * 1e-9])
        effort = controller.update(Measurement(now, position, scenario.goal(now), np.array([latency_s])), None)
        rig.write(effort[:, 0].tolist())
        # Read after the write, so that the read does not delay the command.
        latency_s = rig.latency_s()
        due_ns += period_ns


def _wait_until(due_ns: int) -> None:
    remaining_ns = due_ns - time.monotonic_ns()
    if remaining_ns > _BUSY_WAIT_NS:
        time.sleep((remaining_ns - _BUSY_WAIT_NS) * 1e-9)
    while time.monotonic_ns() < due_ns:
        pass
