"""A study's controller on a real rig, over Modbus TCP: the same object that runs in virtual time, one run of it.

The controller polls at absolute times, so that its phase to the simulation's ticks is the study's. Where the ticks are
is heard from a rig of the same simulation that nothing is injected into: rigs of one simulation tick together.
"""

import time
from typing import Final

import numpy as np
from pymodbus.client import ModbusTcpClient
from pymodbus.exceptions import ModbusException
from pymodbus.pdu import ModbusPDU

from hilrig_modbus_edge import codec, registers
from hilrig_runtime.errors import OperationError
from hilrig_study.controllers import Controller, Measured
from hilrig_study.virtual_loop import Scenario

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
        self._client = ModbusTcpClient(host, port=port, timeout=3)
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
        words = self._read(lambda: self._client.read_holding_registers(registers.POSITION, count=4))
        return codec.position_of(b"".join(word.to_bytes(2, "big") for word in words))

    def write(self, effort: list[float]) -> None:
        """Write registers 1-4; N·m, N·m, N, N·m."""
        data, _ = codec.words_of_effort(effort)
        words = [int.from_bytes(data[at : at + 2], "big") for at in range(0, 8, 2)]
        self._read(lambda: self._client.write_registers(registers.TORQUE, words))

    def close(self) -> None:
        """End the connection."""
        self._client.close()

    def _read(self, request: "_Request") -> list[int]:
        try:
            answer = request()
        except ModbusException as error:
            raise OperationError(f"the rig at {self._where} does not answer any more: {error}") from error
        if answer.isError():
            raise OperationError(f"the rig at {self._where} refused a request: {answer}")
        return list(answer.registers)
