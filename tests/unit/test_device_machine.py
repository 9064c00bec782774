"""Stateful test of `Device`: random requests, connections and pauses, compared with a simple reference model.

The model has registers, lease and watchdog in the simplest form; requests are encoded as PDUs.
"""

import struct
from dataclasses import dataclass, field

from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from hilrig_modbus_edge.device.client import Client
from hilrig_modbus_edge.server.pdu import execute
from support.device_bench import MS, Bench

WATCHDOG_MS, LEASE_MS, GRACE_MS, HOST_CHANGE_MS = 1000, 5000, 5000, 1000
WORD = st.integers(0, 0xFFFF)


@dataclass
class Model:
    now_ms: int = 0
    torque: list[int] = field(default_factory=lambda: [0, 0, 0, 0])
    echo: int = 0
    timeout_ms: int = WATCHDOG_MS
    magnet: bool = False
    holder: str | None = None
    """Host that holds the lease."""
    writers: dict[int, tuple[Client, int]] = field(default_factory=dict)
    """By register or coil: the open connection that wrote it last since the lease was acquired, and when."""
    writing: set[Client] = field(default_factory=set)
    """Open connections that wrote since the lease was acquired."""
    fed_ms: int | None = None
    tripped: bool = False
    last_request_ms: dict[int, int] = field(default_factory=dict)
    session_host: str | None = None
    host_change_ms: int = 0
    released_ms: int = 0
    read_only: bool = False
    """Whether [edge.tls.clients] is present: no client of this test has a certificate."""

    @property
    def refusal(self) -> bytes:
        return b"\x01" if self.read_only else b"\x06"

    def pass_time(self) -> None:
        """Do everything that is due at this millisecond, in the order of the device."""
        if self.fed_ms is not None and self.now_ms - self.fed_ms >= self.timeout_ms:
            self.torque, self.tripped, self.fed_ms = [0, 0, 0, 0], True, None
        if self.holder is not None and all(
            self.now_ms - self.last_request_ms[id(client)] >= LEASE_MS for client in self.writing
        ):
            self.release()
        if self.session_host is not None and self.holder is None and self.now_ms - self.released_ms >= GRACE_MS:
            self.session_host = None

    def release(self) -> None:
        self.holder, self.released_ms = None, self.now_ms
        self.writers.clear()
        self.writing.clear()
        if not any(self.torque):
            self.fed_ms = None

    def disconnect(self, client: Client) -> None:
        self.writers = {item: entry for item, entry in self.writers.items() if entry[0] is not client}
        if client in self.writing:
            self.writing.remove(client)
            if not self.writing:
                self.release()

    def write(self, client: Client, *items: int) -> bool:
        """Return whether a valid write of these registers and coils by this client is accepted."""
        if self.read_only:
            return False
        is_other = self.holder not in (None, client.host)
        if is_other and not self.tripped:
            return False
        period_ms = self.timeout_ms or LEASE_MS
        for item in items:
            writer, written_ms = self.writers.get(item, (client, 0))
            if writer is not client and self.now_ms - written_ms < period_ms:
                return False
        if self.holder is None or is_other:
            if self.session_host not in (None, client.host):
                if self.now_ms < self.host_change_ms:
                    return False
                self.host_change_ms = self.now_ms + HOST_CHANGE_MS
            if is_other:
                self.release()
            self.holder = client.host
            if self.session_host != client.host:
                self.timeout_ms, self.echo = WATCHDOG_MS, 0
            self.session_host = client.host
        self.writing.add(client)
        self.writers |= dict.fromkeys(items, (client, self.now_ms))
        self.fed_ms, self.tripped = self.now_ms, False
        return True


@settings(max_examples=40, stateful_step_count=50, deadline=None, suppress_health_check=[HealthCheck.too_slow])
class DeviceMachine(RuleBasedStateMachine):
    @initialize()
    def start(self) -> None:
        self.bench = Bench()
        self.bench.state(1)
        self.model = Model()
        self.clients: list[Client] = []
        self.port = 0

    def ask(self, client: Client, pdu: bytes) -> bytes:
        now_ns = self.bench.clock.monotonic_ns()
        client.record_request(now_ns)
        self.model.last_request_ms[id(client)] = self.model.now_ms
        return execute(self.bench.device, client, pdu, now_ns)

    @rule(host=st.sampled_from(["10.0.0.1", "10.0.0.2"]))
    @precondition(lambda self: len(self.clients) < 4)
    def connect(self, host: str) -> None:
        self.port += 1
        client = self.bench.connect(host, self.port)
        self.clients.append(client)
        self.model.last_request_ms[id(client)] = self.model.now_ms

    @rule(data=st.data())
    @precondition(lambda self: self.clients)
    def disconnect(self, data: st.DataObject) -> None:
        client = self.clients.pop(data.draw(st.integers(0, len(self.clients) - 1)))
        self.bench.device.disconnect(client, "connection closed by the client")
        self.model.disconnect(client)

    @rule(data=st.data(), address=st.integers(0, 9), words=st.lists(WORD, min_size=1, max_size=5))
    @precondition(lambda self: self.clients)
    def write(self, data: st.DataObject, address: int, words: list[int]) -> None:
        client = data.draw(st.sampled_from(self.clients))
        count = len(words)
        pdu = struct.pack(f">BHHB{count}H", 16, address, count, 2 * count, *words)
        reply = self.ask(client, pdu)
        if address + count > 4:
            assert reply == b"\x90\x02"
        elif self.model.write(client, *range(address, address + count)):
            self.model.torque[address : address + count] = words
            assert reply == pdu[:5]
            assert list(self.bench.commands[-1].effort) == [_signed(word) / 1000 for word in self.model.torque]
        else:
            assert reply == b"\x90" + self.model.refusal

    @rule(data=st.data(), echo=WORD, timeout=st.sampled_from([0, 50, 100, 300, 10_000, 10_001]))
    @precondition(lambda self: self.clients)
    def write_extended(self, data: st.DataObject, echo: int, timeout: int) -> None:
        client = data.draw(st.sampled_from(self.clients))
        reply = self.ask(client, struct.pack(">BHHBHH", 16, 100, 2, 4, echo, timeout))
        if not 100 <= timeout <= 10_000:
            assert reply == b"\x90\x04"
        elif self.model.write(client, 100, 101):
            self.model.echo, self.model.timeout_ms = echo, timeout
            assert reply[0] == 16
        else:
            assert reply == b"\x90" + self.model.refusal

    @rule(data=st.data(), on=st.booleans())
    @precondition(lambda self: self.clients)
    def switch(self, data: st.DataObject, on: bool) -> None:
        client = data.draw(st.sampled_from(self.clients))
        pdu = struct.pack(">BHH", 5, 0, 0xFF00 if on else 0)
        reply = self.ask(client, pdu)
        if self.model.write(client, -1):
            self.model.magnet = on
            assert reply == pdu
        else:
            assert reply == b"\x85" + self.model.refusal

    @rule(data=st.data(), register=st.integers(0, 3), mask=WORD, more=WORD)
    @precondition(lambda self: self.clients)
    def mask_write(self, data: st.DataObject, register: int, mask: int, more: int) -> None:
        client = data.draw(st.sampled_from(self.clients))
        pdu = struct.pack(">BHHH", 22, register, mask, more)
        reply = self.ask(client, pdu)
        if self.model.write(client, register):
            self.model.torque[register] = (self.model.torque[register] & mask) | (more & ~mask & 0xFFFF)
            assert reply == pdu
        else:
            assert reply == b"\x96" + self.model.refusal

    @rule(read_only=st.booleans())
    def permit(self, read_only: bool) -> None:
        self.bench.device.permit({"alice"} if read_only else None)
        self.model.read_only = read_only
        if read_only and self.model.holder is not None:
            self.model.release()

    @rule(data=st.data(), pdu=st.binary(min_size=1, max_size=20))
    @precondition(lambda self: self.clients)
    def read_or_send_random_bytes(self, data: st.DataObject, pdu: bytes) -> None:
        """Every request gets a response; functions that write are tested by the rules above."""
        client = data.draw(st.sampled_from(self.clients))
        if pdu[0] in (5, 6, 15, 16, 22, 23):
            pdu = b"\x03" + pdu[1:]
        reply = self.ask(client, pdu)
        assert reply[0] & 0x7F == pdu[0] & 0x7F

    @rule(ms=st.integers(1, 3000))
    def wait(self, ms: int) -> None:
        for _ in range(ms):
            self.model.now_ms += 1
            self.model.pass_time()
        for part in (ms // 2, ms - ms // 2):
            # The device is checked at its deadlines, as the edge does.
            end_ns = self.bench.clock.monotonic_ns() + part * MS
            while (deadline_ns := self.bench.device.watchdog.deadline_ns) is not None and deadline_ns < end_ns:
                self.bench.wait((deadline_ns - self.bench.clock.monotonic_ns()) / MS)
            for _ in range((end_ns - self.bench.clock.monotonic_ns()) // MS):
                self.bench.wait(1)

    @invariant()
    def device_equals_model(self) -> None:
        model, device = self.model, self.bench.device
        assert (device.lease.holder.name if device.lease.holder else None) == model.holder
        assert device.watchdog.tripped == model.tripped
        assert (device.session is None) == (model.session_host is None)
        reader = self.bench.device.connect("10.0.0.9", 9)
        try:
            assert self.bench.read(reader, 0, 4) == model.torque
            assert self.bench.read(reader, 100, 2) == [model.echo, model.timeout_ms]
        finally:
            device.disconnect(reader, "done")

    @invariant()
    def last_command_equals_model(self) -> None:
        if self.bench.commands:
            command = self.bench.commands[-1]
            assert list(command.effort) == [_signed(word) / 1000 for word in self.model.torque]
            assert command.magnet == self.model.magnet
            assert command.session == ("" if self.bench.device.session is None else self.bench.device.session.id)
            assert command.write_arrived_ns == 0 or command.state_served_ns <= command.write_arrived_ns
        numbers = [command.seq for command in self.bench.commands]
        assert numbers == list(range(1, len(numbers) + 1))


def _signed(word: int) -> int:
    return word - 65536 if word > 32767 else word


TestDevice = DeviceMachine.TestCase
