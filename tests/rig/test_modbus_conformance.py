"""Conformance tests of the Modbus specifications, with raw bytes on a real socket.

Each row of `RULES` is the PDU of a request and its response; `docs/modbus-conformance.md` is generated from them.
"""

import gc
import socket
import struct
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from generate_conformance import RULES, STREAM_RULES, Rule, as_markdown
from hilrig_modbus_edge.protocol.functions import FunctionCode
from hilrig_modbus_edge.server.connection import Connection
from support.edge_rig import EdgeRig, RawClient, counts, running_edge
from support.waiting import eventually

pytestmark = pytest.mark.rig


@pytest.fixture(scope="module")
def rig() -> Iterator[EdgeRig]:
    with running_edge(max_connections=100, max_connections_per_host=100, session_grace_ms=0) as rig:
        yield rig


@pytest.fixture
def client(rig: EdgeRig) -> Iterator[RawClient]:
    # Each rule is tested without a lease holder, with zero torque and the magnet off.
    eventually(rig.free)
    with rig.client() as cleaner:
        cleaner.write(0, 0, 0, 0, 0)
        cleaner.ask("05 00 00 00 00")
    eventually(rig.free)
    with rig.client() as client:
        yield client


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule.id)
def test_rule(client: RawClient, rule: Rule) -> None:
    for before in rule.before:
        client.ask(before)
    reply = client.ask(rule.request)
    assert reply.hex(" ") == bytes.fromhex(rule.answer).hex(" "), rule.text


def test_positions_are_served_by_function_3(client: RawClient) -> None:
    assert client.read(4, 4) == counts()


def test_identification_has_vendor_product_and_revision(client: RawClient) -> None:
    reply = client.ask("2B 0E 01 00")
    assert reply[:7] == bytes.fromhex("2B 0E 01 82 00 00 03")
    objects, rest = {}, reply[7:]
    while rest:
        number, size = rest[:2]
        objects[number] = rest[2 : 2 + size].decode()
        rest = rest[2 + size :]
    assert list(objects) == [0, 1, 2]
    assert objects[0] == "hilrig"


def test_identification_from_unknown_object_starts_at_first(client: RawClient) -> None:
    for code in (1, 2, 3):
        whole = client.ask(bytes((0x2B, 0x0E, code, 0x00)))
        assert client.ask(bytes((0x2B, 0x0E, code, 0x63))) == whole


def test_shortest_and_longest_requests_are_answered(client: RawClient) -> None:
    assert client.ask("64").hex() == "e401"
    assert client.ask(b"\x64" + bytes(252)).hex() == "e401"
    assert client.ask(b"\x10\x00\x00\x00\x7b\xf6" + bytes(246)).hex() == "9002"


@pytest.mark.parametrize("unit", [0, 1, 255])
def test_units_0_1_and_255_are_answered(client: RawClient, unit: int) -> None:
    assert client.ask("03 00 00 00 01", unit=unit) == bytes.fromhex("03 02 00 00")


@pytest.mark.parametrize("unit", [2, 17, 247, 254])
def test_other_units_get_0b(client: RawClient, unit: int) -> None:
    assert client.ask("03 00 00 00 01", unit=unit) == bytes.fromhex("83 0B")
    assert client.ask("06 00 00 00 01", unit=unit) == bytes.fromhex("86 0B")


def test_requests_of_one_segment_are_answered_in_order(client: RawClient) -> None:
    requests = [(7, b"\x03\x00\x00\x00\x01"), (3, b"\x06\x00\x00\x00\x05"), (9, b"\x03\x00\x00\x00\x01")]
    client.send(b"".join(client.frame(pdu, transaction=number) for number, pdu in requests))
    assert [client.receive() for _ in requests] == [
        (7, 1, b"\x03\x02\x00\x00"),
        (3, 1, b"\x06\x00\x00\x00\x05"),
        (9, 1, b"\x03\x02\x00\x05"),
    ]


def test_transaction_identifiers_are_echoed(client: RawClient) -> None:
    for transaction in (0, 65535, 1, 1, 40000):
        client.send(client.frame(b"\x03\x00\x00\x00\x01", transaction=transaction))
        assert client.receive()[0] == transaction


def test_hundreds_of_requests_are_answered_in_order(client: RawClient) -> None:
    count = 900
    client.send(b"".join(client.frame(b"\x03\x00\x00\x00\x08", transaction=n) for n in range(count)))
    assert [client.receive()[0] for _ in range(count)] == list(range(count))


def test_request_may_arrive_byte_by_byte(client: RawClient) -> None:
    for byte in client.frame(bytes.fromhex("10 00 00 00 02 04 00 0A 01 02"), transaction=5):
        client.send(bytes((byte,)))
    assert client.receive() == (5, 1, bytes.fromhex("10 00 00 00 02"))


def test_half_closed_connection_gets_its_responses(client: RawClient) -> None:
    client.send(b"".join(client.frame(b"\x03\x00\x00\x00\x08", transaction=n) for n in range(100)))
    client.socket.shutdown(1)
    assert [client.receive()[0] for _ in range(100)] == list(range(100))
    assert client.closed()


@pytest.mark.parametrize(
    "header",
    [
        pytest.param("00 01 00 01 00 06 01 03 00 00 00 01", id="another protocol"),
        pytest.param("00 01 00 01", id="another protocol, detected from four bytes"),
        pytest.param("00 01 00 00 00 00", id="length 0"),
        pytest.param("00 01 00 00 00 01 01", id="length 1: no function code"),
        pytest.param("00 01 00 00 00 FF", id="length 255: longer than any request"),
        pytest.param("47 45 54 20 2F 20 48 54 54 50", id="HTTP"),
        pytest.param("16 03 01 02 00 01 00 01 FC 03 03", id="TLS"),
    ],
)
def test_malformed_header_closes_the_connection(rig: EdgeRig, client: RawClient, header: str) -> None:
    before = rig.service.counters.malformed
    good = client.frame(b"\x03\x00\x00\x00\x01", transaction=4)
    client.send(good + bytes.fromhex(header))
    # The valid request before it is still answered.
    assert client.receive() == (4, 1, b"\x03\x02\x00\x00")
    assert client.closed()
    assert rig.service.counters.malformed == before + 1


def test_block_write_is_all_or_nothing(client: RawClient) -> None:
    client.write(0, 1, 2, 3, 4)
    assert client.write(2, 30, 40, 50).hex() == "9002"
    assert client.read(0, 4) == [1, 2, 3, 4]


def test_function_23_writes_before_it_reads(client: RawClient) -> None:
    request = struct.pack(">BHHHHB4H", 0x17, 0, 4, 0, 4, 8, 11, 12, 13, 14)
    assert client.ask(request) == struct.pack(">BB4H", 0x17, 8, 11, 12, 13, 14)


def test_function_23_writes_nothing_if_it_cannot_read(client: RawClient) -> None:
    client.write(0, 1, 2, 3, 4)
    assert client.ask(struct.pack(">BHHHHB1H", 0x17, 4, 5, 0, 1, 2, 99)).hex() == "9702"
    assert client.read(0, 4) == [1, 2, 3, 4]


def test_function_22_masks_one_register(client: RawClient) -> None:
    # The specification's example: 0x12 AND 0xF2 OR (0x25 AND NOT 0xF2) is 0x17.
    client.write(1, 0x12)
    assert client.ask("16 00 01 00 F2 00 25").hex(" ") == "16 00 01 00 f2 00 25"
    assert client.read(1, 1) == [0x17]


def test_unsupported_functions_get_01(client: RawClient) -> None:
    for function in set(range(256)) - set(FunctionCode):
        assert client.ask(bytes((function, 0, 0, 0, 1))) == bytes((function | 0x80, 1))


def test_responses_are_sent_without_delay(client: RawClient) -> None:
    """With Nagle's algorithm, the second response would wait for the delayed ACK of the client, about 40 ms."""
    client.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    client.read(0, 1)
    [connection] = [c for c in _sockets() if c.getpeername() == client.socket.getsockname()]
    assert connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
    assert connection.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
    if sys.platform == "linux":
        # Otherwise the response to a host that lost its power is retransmitted for a quarter of an hour.
        assert connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT) == 11_000
    begin = time.monotonic()
    for _ in range(50):
        client.send(client.frame(b"\x03\x00\x00\x00\x08"))
        client.send(client.frame(b"\x03\x00\x00\x00\x08"))
        client.receive()
        client.receive()
    assert time.monotonic() - begin < 1, "delayed responses take two seconds"


def _sockets() -> list[socket.socket]:
    """Return the sockets of the edge, which runs in this process."""
    found = []
    for entry in gc.get_objects():
        if isinstance(entry, Connection) and not entry._transport.is_closing():
            found.append(entry._transport.get_extra_info("socket"))
    return found


def test_conformance_page_equals_the_rules() -> None:
    page = Path(__file__).parents[2] / "docs/modbus-conformance.md"
    assert page.read_text() == as_markdown(), "run: python scripts/generate_conformance.py > docs/modbus-conformance.md"


def test_every_rule_of_the_page_has_a_test() -> None:
    for _, _, name in STREAM_RULES:
        assert callable(globals()[name])
