"""The client of a live rig, and the measurement of its tick phase from its step counter."""

import pytest
from pymodbus.pdu import ModbusPDU
from pymodbus.pdu.register_message import (
    ReadHoldingRegistersResponse,
    ReadInputRegistersResponse,
    WriteMultipleRegistersResponse,
)

from hilrig_modbus_edge.protocol.functions import RegisterTable
from hilrig_runtime.errors import OperationError
from hilrig_study.live import live_loop
from hilrig_study.live.live_loop import RigClient, measure_tick_phase
from support.device_bench import Bench

STEP_NS = 20_000_000


class Counter:
    """Step counter behind a simulated network that delays a request before each tick; it has the clock of the test."""

    def __init__(self, *, stopped: bool = False) -> None:
        self.now_ns = 7 * STEP_NS + STEP_NS // 3
        self._stopped = stopped
        self._delayed = 0

    def monotonic_ns(self) -> int:
        return self.now_ns

    def sleep(self, duration_s: float) -> None:
        self.now_ns += round(duration_s * 1e9)

    def step(self) -> int:
        self.now_ns += 100_000
        to_tick_ns = STEP_NS - self.now_ns % STEP_NS
        if 6_000_000 < to_tick_ns < 9_000_000 and self._delayed < 10:
            self._delayed += 1
            # The request is sent long before a tick and answered after it.
            self.now_ns += to_tick_ns + 100_000
        return 0 if self._stopped else self.now_ns // STEP_NS


def test_delayed_request_does_not_shift_tick_phase(monkeypatch: pytest.MonkeyPatch) -> None:
    counter = Counter()
    monkeypatch.setattr(live_loop, "time", counter)
    tick_ns = measure_tick_phase(counter, STEP_NS)  # type: ignore[arg-type]
    assert counter._delayed == 10
    # Never early; late at most by the spacing of the requests.
    assert tick_ns % STEP_NS < 400_000


class DeviceClient:
    """A pymodbus client whose requests are executed on a device."""

    def __init__(self, bench: Bench) -> None:
        self._bench = bench
        self._client = bench.connect()

    def connect(self) -> bool:
        return True

    def read_input_registers(self, address: int, count: int) -> ModbusPDU:
        return ReadInputRegistersResponse(
            registers=self._bench.read(self._client, address, count, RegisterTable.INPUT_REGISTER)
        )

    def read_holding_registers(self, address: int, count: int) -> ModbusPDU:
        return ReadHoldingRegistersResponse(registers=self._bench.read(self._client, address, count))

    def write_registers(self, address: int, values: list[int]) -> ModbusPDU:
        self._bench.write(self._client, address, *values)
        return WriteMultipleRegistersResponse(address=address, count=len(values))


def test_rig_client_uses_the_register_map(monkeypatch: pytest.MonkeyPatch) -> None:
    bench = Bench()
    bench.state(70_000, position=(0.5, -0.5, 0.125, 1.0), loop_latency_ns=20_000_000)
    monkeypatch.setattr(live_loop, "ModbusTcpClient", lambda *_, **__: DeviceClient(bench))
    rig = RigClient("127.0.0.1", 502)
    assert (rig.step(), rig.latency_s()) == (70_000, pytest.approx(0.02))
    assert rig.position() == pytest.approx((0.5, -0.5, 0.125, 1.0), abs=1e-4)
    rig.write([1.0, -2.0, 3.0, 0.5])
    assert list(bench.commands[-1].effort) == [1.0, -2.0, 3.0, 0.5]


def test_rejects_stopped_step_counter(monkeypatch: pytest.MonkeyPatch) -> None:
    counter = Counter(stopped=True)
    monkeypatch.setattr(live_loop, "time", counter)
    with pytest.raises(OperationError, match="does not step"):
        measure_tick_phase(counter, STEP_NS)  # type: ignore[arg-type]
