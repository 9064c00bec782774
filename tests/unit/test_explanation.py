"""The explanation of an exception response names request, cause and fix; each example is a mistake of real clients."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hilrig_modbus_edge.protocol.functions import FunctionCode, RequestLayout
from hilrig_modbus_edge.server.explanation import explain
from hilrig_modbus_edge.server.pdu import MAX_QUANTITY, execute
from support.device_bench import Bench

CASES = {
    "block of 10": (
        "03 0000 000A",
        "read holding registers 1-10, only 1-8 exist (exception 02): reduce the count to 8, "
        'or set unmapped_reads = "zeros" in [edge] of lab.toml',
    ),
    "off by one": (
        "03 0005 0004",
        "read holding registers 6-9, only 1-8 exist (exception 02): begin one lower (register n has address n - 1) or "
        'reduce the count to 3, or set unmapped_reads = "zeros" in [edge] of lab.toml',
    ),
    "traditional number": ("03 9C45 0004", "40005 is the traditional number of holding register 5: use address 4"),
    "traditional input": ("04 7532 0001", "30002 is the traditional number of input register 2: use address 1"),
    "write of positions": (
        "10 0000 0008 10" + "00" * 16,
        "wrote holding registers 1-8, only 1-4 are writable (exception 02): reduce the count to 4",
    ),
    "single read-only register": ("06 0004 0000", "wrote holding register 5, only 1-4"),
    "eight coils": ("0F 0000 0008 01 01", "wrote coils 1-8, only 1 is writable (exception 02): reduce the count to 1"),
    "nonexistent register": ("03 01F3 0001", "choose one of them; number n has address n - 1"),
    "second half of function 23": ("17 0000 0009 0000 0001 02 0000", "only 1-8 exist (exception 02): reduce the count"),
    "write of function 23": (
        "17 0004 0004 0004 0001 02 0000",
        "wrote holding register 5 and read holding registers 5-8, only 1-4, 101-102, 301-302 are writable "
        "(exception 02): choose one of them; number n has address n - 1\n",
    ),
    "coil value": ("05 0000 0001", "wrote coil 1, the value is 0001 (exception 03): use FF00 for on and 0000 for off"),
    "quantity 0": ("03 0000 0000", "the quantity is 0 (exception 03): use 1 to 125"),
    "quantity 126": ("04 0000 007E", "the quantity is 126 (exception 03): use 1 to 125"),
    "length": ("10 0000 0002 04 0000", "its length of 8 bytes is wrong (exception 03)"),
    "short": ("03 00", "its length of 2 bytes is wrong (exception 03)"),
    "watchdog timeout": ("06 0065 0001", "the watchdog timeout is out of bounds (exception 04)"),
    "unsupported function": ("08 0000 A5A5", "sent function 8, the rig does not have this function (exception 01)"),
    "other MEI": ("2B 0D", "the rig has device identification only (exception 01): use MEI type 14"),
}


@pytest.mark.parametrize("name", CASES)
def test_each_mistake_is_explained(name: str) -> None:
    request, expected = CASES[name]
    bench = Bench()
    bench.state(1)
    pdu = bytes.fromhex(request)
    reply = execute(bench.device, bench.connect(), pdu, 0)
    assert reply[0] == pdu[0] | 0x80
    # A newline in an example is the end of the text.
    assert expected in f"{explain(1, 1, pdu, reply[1])}\n"


def test_unit_id_is_explained() -> None:
    text = explain(1, 16, bytes.fromhex("03 0004 0004"), 0x0B)
    assert text.endswith("unit id 16 does not exist (exception 0B): set unit id 1 (0 and 255 are accepted too)")


def test_rtu_frame_with_valid_header_is_named() -> None:
    """Two registers by RTU: 01 03 00 00 00 02 and its CRC are a valid header with unit id 0xC4 and function 0x0B."""
    frame = bytes.fromhex("01 03 00 00 00 02 C4 0B")
    assert "Modbus RTU" in explain(0x0103, frame[6], frame[7:], 0x0B)


def test_read_before_first_state_is_explained() -> None:
    bench = Bench()
    pdu = bytes.fromhex("03 0004 0004")
    reply = execute(bench.device, bench.connect(), pdu, 0)
    assert "the simulation has sent no state yet (exception 04)" in explain(1, 1, pdu, reply[1])


def test_observer_is_explained() -> None:
    bench = Bench()
    pdu = bytes.fromhex("06 0000 0001")
    reply = execute(bench.device, bench.connect(may_write=False), pdu, 0)
    assert "which its certificate does not permit (exception 01)" in explain(1, 1, pdu, reply[1])


@given(st.binary(min_size=1, max_size=20), st.sampled_from(sorted(FunctionCode)), st.integers(0, 255))
def test_any_refused_request_is_explained(data: bytes, function: int, unit: int) -> None:
    """An error in the explanation would close the connection of the client."""
    for pdu in (data, bytes((function,)) + data):
        for code in (*range(1, 8), 10, 11):
            text = explain(0, unit, pdu, code)
            assert f"(exception {code:02X}): " in text
            assert text.isprintable()


def test_every_function_with_a_quantity_has_its_limit() -> None:
    quantities = {function for function in FunctionCode if function.layout is RequestLayout.QUANTITY}
    assert set(MAX_QUANTITY) == quantities
