"""Generates docs/modbus-conformance.md: the rules of the Modbus specifications and their tests.

Clauses are of the MODBUS Application Protocol Specification V1.1b3 (AP). Initial state: no lease holder, zero torques,
magnet off.
"""

from dataclasses import dataclass
from itertools import groupby

from hilrig_modbus_edge.protocol.functions import FunctionCode
from hilrig_modbus_edge.registers.export import TABLE_NAMES
from hilrig_modbus_edge.registers.map import INPUT_END


@dataclass(frozen=True)
class Rule:
    """PDU of a request and of the required response, in hex."""

    clause: str
    text: str
    request: str
    answer: str
    before: tuple[str, ...] = ()

    @property
    def id(self) -> str:
        """Id of the test."""
        return f"{self.clause}: {self.text}".replace("/", "|")


def _times(byte: str, count: int) -> str:
    return " ".join([byte] * count)


RULES: tuple[Rule, ...] = (
    # Read Coils
    Rule("AP 6.1", "01 reads a coil, the first in the least significant bit", "01 00 00 00 01", "01 01 00"),
    Rule("AP 6.1", "01 reads back a written coil", "01 00 00 00 01", "01 01 01", ("05 00 00 FF 00",)),
    Rule("AP 6.1", "01 with quantity 0 is an illegal value", "01 00 00 00 00", "81 03"),
    Rule("AP 6.1", "01 with quantity 2001 is an illegal value", "01 00 00 07 D1", "81 03"),
    Rule("AP 6.1", "01 with quantity 2000 is legal; the address is illegal", "01 00 00 07 D0", "81 02"),
    Rule("AP 6.1", "01 of a nonexistent coil is an illegal address", "01 00 01 00 01", "81 02"),
    Rule("AP 6.1", "01 across the end is an illegal address", "01 00 00 00 02", "81 02"),
    Rule("AP 6.1", "quantity is checked before address", "01 FF FF 00 00", "81 03"),
    Rule("AP 6.1", "01 that is too short is an illegal value", "01 00 00 00", "81 03"),
    Rule("AP 6.1", "01 that is too long is an illegal value", "01 00 00 00 01 00", "81 03"),
    Rule("AP 6.1", "01 at address 65535 does not wrap", "01 FF FF 00 02", "81 02"),
    # Read Discrete Inputs
    Rule("AP 6.2", "02 pads the last byte with zeros", "02 00 05 00 03", "02 01 00"),
    Rule("AP 6.2", "02 with quantity 0 is an illegal value", "02 00 00 00 00", "82 03"),
    Rule("AP 6.2", "02 with quantity 2001 is an illegal value", "02 00 00 07 D1", "82 03"),
    Rule("AP 6.2", "02 with quantity 2000 is legal; the address is illegal", "02 00 00 07 D0", "82 02"),
    Rule("AP 6.2", "02 with the function code only is an illegal value", "02", "82 03"),
    Rule("AP 6.2", "02 across the end is an illegal address", "02 00 0F 00 02", "82 02"),
    Rule("AP 6.2", "02 at address 65535 is an illegal address", "02 FF FF 00 01", "82 02"),
    # Read Holding Registers
    Rule(
        "AP 6.3",
        "03 reads registers, big-endian",
        "03 00 00 00 02",
        "03 04 12 34 FF FE",
        ("10 00 00 00 02 04 12 34 FF FE",),
    ),
    Rule("AP 6.3", "03 with quantity 0 is an illegal value", "03 00 00 00 00", "83 03"),
    Rule("AP 6.3", "03 with quantity 126 is an illegal value", "03 00 00 00 7E", "83 03"),
    Rule("AP 6.3", "03 with quantity 125 is legal; the address is illegal", "03 00 00 00 7D", "83 02"),
    Rule("AP 6.3", "03 beyond the map is an illegal address", "03 00 08 00 01", "83 02"),
    Rule("AP 6.3", "03 across the map's end is an illegal address", "03 00 07 00 02", "83 02"),
    Rule("AP 6.3", "03 reads the mirror of the input registers", "03 00 C8 00 01", "03 02 00 01"),
    Rule("AP 6.3", "03 across the mirror's end is an illegal address", "03 00 EB 00 02", "83 02"),
    Rule("AP 6.3", "03 reads back the magnet", "03 01 2C 00 01", "03 02 00 01", ("05 00 00 FF 00",)),
    Rule("AP 6.3", "03 across a gap is an illegal address", "03 00 00 00 66", "83 02"),
    Rule("AP 6.3", "03 at address 65535 does not wrap", "03 FF FF 00 02", "83 02"),
    Rule("AP 6.3", "03 that is too short is an illegal value", "03 00 00 00", "83 03"),
    Rule("AP 6.3", "03 that is too long is an illegal value", "03 00 00 00 01 00", "83 03"),
    # Read Input Registers
    Rule("AP 6.4", "04 reads input registers", "04 00 00 00 01", "04 02 00 01"),
    Rule("AP 6.4", "04 with quantity 0 is an illegal value", "04 00 00 00 00", "84 03"),
    Rule("AP 6.4", "04 with quantity 126 is an illegal value", "04 00 00 00 7E", "84 03"),
    Rule("AP 6.4", "04 with quantity 125 is legal; the address is illegal", "04 00 00 00 7D", "84 02"),
    Rule("AP 6.4", "04 at address 65535 does not wrap", "04 FF FF 00 02", "84 02"),
    Rule(
        "AP 6.4",
        "04 across the map's end is an illegal address",
        f"04 {(INPUT_END - 1).to_bytes(2).hex(' ').upper()} 00 02",
        "84 02",
    ),
    # Write Single Coil
    Rule("AP 6.5", "05 echoes the request", "05 00 00 FF 00", "05 00 00 FF 00"),
    Rule("AP 6.5", "05 switches off with 0000", "05 00 00 00 00", "05 00 00 00 00"),
    Rule("AP 6.5", "05 with any other value is illegal", "05 00 00 00 01", "85 03"),
    Rule("AP 6.5", "05 with FFFF is illegal", "05 00 00 FF FF", "85 03"),
    Rule("AP 6.5", "value is checked before address", "05 00 09 12 34", "85 03"),
    Rule("AP 6.5", "05 of a nonexistent coil is an illegal address", "05 00 01 FF 00", "85 02"),
    Rule("AP 6.5", "05 at address 65535 is an illegal address", "05 FF FF FF 00", "85 02"),
    Rule("AP 6.5", "05 that is too long is an illegal value", "05 00 00 FF 00 00", "85 03"),
    Rule("AP 6.5", "an illegal value changes nothing", "01 00 00 00 01", "01 01 00", ("05 00 00 00 01",)),
    # Write Single Register
    Rule("AP 6.6", "06 echoes the request", "06 00 03 FF FF", "06 00 03 FF FF"),
    Rule("AP 6.6", "06 of a read-only register is an illegal address", "06 00 04 00 01", "86 02"),
    Rule("AP 6.6", "06 of a nonexistent register is an illegal address", "06 00 08 00 01", "86 02"),
    Rule("AP 6.6", "06 that is too long is an illegal value", "06 00 00 00 01 00", "86 03"),
    Rule("AP 6.6", "06 that is too short is an illegal value", "06 00 00 00", "86 03"),
    Rule("AP 6.6", "06 at address 65535 is an illegal address", "06 FF FF 00 01", "86 02"),
    # Write Multiple Coils
    Rule("AP 6.11", "15 returns address and quantity", "0F 00 00 00 01 01 01", "0F 00 00 00 01"),
    Rule("AP 6.11", "15 ignores the padding of its last byte", "01 00 00 00 01", "01 01 00", ("0F 00 00 00 01 01 FE",)),
    Rule("AP 6.11", "15 with quantity 0 is an illegal value", "0F 00 00 00 00 00", "8F 03"),
    Rule("AP 6.11", "15 with quantity 1969 is an illegal value", f"0F 00 00 07 B1 F7 {_times('00', 247)}", "8F 03"),
    Rule(
        "AP 6.11",
        "15 with quantity 1968 is legal; the address is illegal",
        f"0F 00 00 07 B0 F6 {_times('00', 246)}",
        "8F 02",
    ),
    Rule(
        "AP 6.11",
        "15 whose byte count does not match its quantity is an illegal value",
        "0F 00 00 00 01 02 01 00",
        "8F 03",
    ),
    Rule("AP 6.11", "15 with less data than its byte count is an illegal value", "0F 00 00 00 09 02 01", "8F 03"),
    Rule("AP 6.11", "15 with more data than its byte count is an illegal value", "0F 00 00 00 01 01 01 00", "8F 03"),
    Rule("AP 6.11", "15 at address 65535 is an illegal address", "0F FF FF 00 01 01 01", "8F 02"),
    Rule("AP 6.11", "15 across the end is an illegal address", "0F 00 00 00 02 01 03", "8F 02"),
    # Write Multiple Registers
    Rule("AP 6.12", "16 returns address and quantity", "10 00 00 00 02 04 00 0A 01 02", "10 00 00 00 02"),
    Rule("AP 6.12", "16 with quantity 0 is an illegal value", "10 00 00 00 00 00", "90 03"),
    Rule("AP 6.12", "16 with quantity 124 is an illegal value", f"10 00 00 00 7C F8 {_times('00', 246)}", "90 03"),
    Rule(
        "AP 6.12",
        "16 with quantity 123 is legal; the address is illegal",
        f"10 00 00 00 7B F6 {_times('00', 246)}",
        "90 02",
    ),
    Rule(
        "AP 6.12",
        "16 whose byte count is not twice its quantity is an illegal value",
        "10 00 00 00 02 03 00 0A 01",
        "90 03",
    ),
    Rule("AP 6.12", "16 with less data than its byte count is an illegal value", "10 00 00 00 02 04 00 0A 01", "90 03"),
    Rule(
        "AP 6.12", "16 with more data than its byte count is an illegal value", "10 00 00 00 01 02 00 0A 01 02", "90 03"
    ),
    Rule("AP 6.12", "16 at address 65535 does not wrap", "10 FF FF 00 02 04 00 0A 01 02", "90 02"),
    Rule("AP 6.12", "16 writes magnet and reset", "10 01 2C 00 02 04 00 01 00 00", "10 01 2C 00 02"),
    Rule("AP 6.12", "16 of the mirror is an illegal address", "10 00 C8 00 01 02 00 00", "90 02"),
    Rule("AP 6.12", "16 across a gap is an illegal address", "10 00 63 00 02 04 00 0A 01 02", "90 02"),
    Rule("AP 6.12", "quantity and byte count are checked before address", "10 FF FF 00 02 03 00 0A 01", "90 03"),
    Rule(
        "AP 6.12",
        "16 of a range with a read-only register is an illegal address",
        "10 00 03 00 02 04 00 0A 01 02",
        "90 02",
    ),
    Rule("AP 6.12", "16 without a byte count is an illegal value", "10 00 00 00 01", "90 03"),
    # Mask Write Register
    Rule("AP 6.16", "22 echoes the request", "16 00 00 00 F2 00 25", "16 00 00 00 F2 00 25"),
    Rule("AP 6.16", "22 of a read-only register is an illegal address", "16 00 04 00 F2 00 25", "96 02"),
    Rule("AP 6.16", "22 that is too short is an illegal value", "16 00 00 00 F2 00", "96 03"),
    Rule("AP 6.16", "22 that is too long is an illegal value", "16 00 00 00 F2 00 25 00", "96 03"),
    Rule("AP 6.16", "22 of a nonexistent register is an illegal address", "16 00 08 00 F2 00 25", "96 02"),
    Rule(
        "AP 6.16",
        "22 with an AND mask of ones does not change the register",
        "03 00 00 00 01",
        "03 02 12 34",
        ("06 00 00 12 34", "16 00 00 FF FF FF FF"),
    ),
    Rule(
        "AP 6.16",
        "22 with an AND mask of zeros writes the OR mask",
        "03 00 00 00 01",
        "03 02 AB CD",
        ("06 00 00 12 34", "16 00 00 00 00 AB CD"),
    ),
    # Read/Write Multiple Registers
    Rule("AP 6.17", "23 reads back the written registers", "17 00 00 00 01 00 00 00 01 02 00 2A", "17 02 00 2A"),
    Rule("AP 6.17", "23 reading 0 registers is an illegal value", "17 00 00 00 00 00 00 00 01 02 00 2A", "97 03"),
    Rule("AP 6.17", "23 reading 126 registers is an illegal value", "17 00 00 00 7E 00 00 00 01 02 00 2A", "97 03"),
    Rule(
        "AP 6.17",
        "23 reading 125 is legal; the address is illegal",
        "17 00 00 00 7D 00 00 00 01 02 00 2A",
        "97 02",
    ),
    Rule("AP 6.17", "23 writing 0 registers is an illegal value", "17 00 00 00 01 00 00 00 00 00", "97 03"),
    Rule("AP 6.17", "23 that is too short is an illegal value", "17 00 00 00 01 00 00 00 01", "97 03"),
    Rule(
        "AP 6.17",
        "23 with more data than its byte count is an illegal value",
        "17 00 00 00 01 00 00 00 01 02 00 2A 00",
        "97 03",
    ),
    Rule(
        "AP 6.17",
        "23 reading a nonexistent register is an illegal address",
        "17 00 08 00 01 00 00 00 01 02 00 2A",
        "97 02",
    ),
    Rule(
        "AP 6.17",
        "23 writing a nonexistent register is an illegal address",
        "17 00 00 00 01 00 08 00 01 02 00 2A",
        "97 02",
    ),
    Rule(
        "AP 6.17",
        "23 writing 122 registers is an illegal value",
        f"17 00 00 00 01 00 00 00 7A F4 {_times('00', 242)}",
        "97 03",
    ),
    Rule(
        "AP 6.17",
        "23 writing 121 is legal; the address is illegal",
        f"17 00 00 00 01 00 00 00 79 F2 {_times('00', 242)}",
        "97 02",
    ),
    Rule(
        "AP 6.17",
        "23 whose byte count does not match its quantity is an illegal value",
        "17 00 00 00 01 00 00 00 01 04 00 2A 00 00",
        "97 03",
    ),
    Rule(
        "AP 6.17",
        "23 with less data than its byte count is an illegal value",
        "17 00 00 00 01 00 00 00 02 04 00 2A",
        "97 03",
    ),
    Rule(
        "AP 6.17",
        "23 writing a read-only register is an illegal address",
        "17 00 00 00 01 00 04 00 01 02 00 2A",
        "97 02",
    ),
    # Read Device Identification
    Rule(
        "AP 6.21",
        "43/14 returns one object by its number",
        "2B 0E 04 00",
        "2B 0E 04 82 00 00 01 00 06 68 69 6C 72 69 67",
    ),
    Rule("AP 6.21", "43/14 of a nonexistent object is an illegal address", "2B 0E 04 63", "AB 02"),
    Rule("AP 6.21", "43/14 with another read code is an illegal value", "2B 0E 05 00", "AB 03"),
    Rule("AP 6.21", "43/14 with read code 0 is an illegal value", "2B 0E 00 00", "AB 03"),
    Rule("AP 6.21", "43/14 of an unsupported optional object is an illegal address", "2B 0E 04 03", "AB 02"),
    Rule(
        "AP 6.21",
        "43/14 streams from the requested object",
        "2B 0E 02 05",
        "2B 0E 02 82 00 00 01 05 05 53 43 41 52 41",
    ),
    Rule(
        "AP 6.21",
        "43/14 beyond its conformity level returns the existing objects",
        "2B 0E 03 05",
        "2B 0E 03 82 00 00 01 05 05 53 43 41 52 41",
    ),
    Rule("AP 6.21", "43/14 that is too short is an illegal value", "2B 0E 01", "AB 03"),
    Rule("AP 6.21", "43/14 that is too long is an illegal value", "2B 0E 01 00 00", "AB 03"),
    Rule("AP 6.19", "43 with another MEI type is an illegal function", "2B 0D 01 00", "AB 01"),
    # Function codes
    Rule("AP 4.1", "function 0 is not valid", "00", "80 01"),
    Rule("AP 7", "an unknown function is answered with its code plus 80 hex", "07", "87 01"),
    Rule("AP 7", "a function code of an exception response is an illegal function", "83 00 00 00 01", "83 01"),
    Rule("AP 6.8", "serial-line diagnostics are an illegal function on TCP", "08 00 00 12 34", "88 01"),
)

STREAM_RULES: tuple[tuple[str, str, str], ...] = (
    ("AP 6.3", "positions are readable, big-endian", "test_positions_are_served_by_function_3"),
    ("AP 6.12", "a block write is all or nothing", "test_block_write_is_all_or_nothing"),
    ("AP 6.16", "the result is (current AND mask) OR (or-mask AND NOT mask)", "test_function_22_masks_one_register"),
    ("AP 6.17", "the write is done before the read", "test_function_23_writes_before_it_reads"),
    ("AP 6.17", "nothing is written if the read is illegal", "test_function_23_writes_nothing_if_it_cannot_read"),
    (
        "AP 6.21",
        "the basic stream has vendor, product and revision",
        "test_identification_has_vendor_product_and_revision",
    ),
    (
        "AP 6.21",
        "a stream from a nonexistent object starts at the first object",
        "test_identification_from_unknown_object_starts_at_first",
    ),
    (
        "AP 7",
        "every other function code gets exception 01",
        "test_unsupported_functions_get_01",
    ),
    (
        "TG 4.4.2.3",
        "units 0 and 255 address a device without a gateway",
        "test_units_0_1_and_255_are_answered",
    ),
    ("AP 7", "another unit gets exception 0B: target device failed to respond", "test_other_units_get_0b"),
    (
        "TG 4.2.2",
        "the transaction identifier is echoed",
        "test_transaction_identifiers_are_echoed",
    ),
    (
        "TG 4.4.1.2",
        "several requests in one segment are answered in order",
        "test_requests_of_one_segment_are_answered_in_order",
    ),
    (
        "TG 4.4.1.2",
        "hundreds of requests are answered in order",
        "test_hundreds_of_requests_are_answered_in_order",
    ),
    ("AP 4.1", "a PDU has 1 to 253 bytes", "test_shortest_and_longest_requests_are_answered"),
    ("TG 4.3.2", "a request may arrive in many segments", "test_request_may_arrive_byte_by_byte"),
    (
        "TG 4.3.2",
        "a half-closed connection gets its responses",
        "test_half_closed_connection_gets_its_responses",
    ),
    (
        "TG 4.4.2.1",
        "a malformed header closes the connection",
        "test_malformed_header_closes_the_connection",
    ),
    ("TG 4.3.2", "Nagle's algorithm is off, keep-alive is on", "test_responses_are_sent_without_delay"),
)
"""Clause, rule, and its test function in `tests/rig/test_modbus_conformance.py`."""

SECURITY_RULES: tuple[tuple[str, str], ...] = (
    ("the whole message, MBAP header and PDU, is inside TLS", "test_operator_reads_and_writes"),
    ("TLS 1.2 or newer", "test_old_tls_versions_are_refused"),
    (
        "mutual authentication: the client certificate is issued by the lab's authority, for clients, and valid now",
        "test_invalid_certificate_is_refused_with_reason",
    ),
    (
        "the role is a UTF-8 string in the extension 1.3.6.1.4.1.50316.802.1; two roles count as no role",
        "test_ambiguous_or_malformed_role_counts_as_no_role",
    ),
    ("a request that the role does not permit gets exception 01", "test_observer_and_unknown_roles_are_read_only"),
    ("the permission without a role is configurable", "test_permission_without_role_is_configurable"),
    ("a handshake that is incomplete after 5 s is aborted", "test_incomplete_handshake_times_out"),
    (
        "incomplete handshakes take no place of a connection; beyond its limits the oldest one is aborted",
        "test_unfinished_handshakes_take_no_place",
    ),
    ("a client cannot renegotiate", "test_client_cannot_renegotiate"),
    ("a connection is closed when the client's certificate expires", "test_connection_ends_with_its_certificate"),
)
"""Rule of Modbus/TCP Security, and its test function in `tests/rig/test_modbus_tls.py`."""

HEADER = """# Conformance

Each row has a rule, its clause, and a test with raw bytes on a real socket
(`tests/rig/test_modbus_conformance.py`). AP is the MODBUS Application Protocol Specification V1.1b3, TG the MODBUS
Messaging on TCP/IP Implementation Guide V1.0b. Generated by `python scripts/generate_conformance.py`.

The specifications leave three points open. hilrig implements them as follows:

- A request of wrong length gets exception 03: "the implied length is incorrect".
- A value that is legal in Modbus but not for the rig (a watchdog timeout outside the bounds of the lab) gets exception
  04: in the specification, 03 is for a malformed request, not for the meaning of a value.
- A write by a client whose controller does not hold the lease, or of a register that another open connection of the
  controller writes, gets exception 06. A write by a client with a read-only role gets
  exception 01, as specified by MODBUS/TCP Security.

## Functions

A request counts as a read, a write, or, if it is answered with an exception response, an error. Function 23 writes
torques and counts as a write.

| code | function | accesses | counts as |
|---:|---|---|---|
"""

SINGLE_REQUESTS = """
## Single requests

Requests and responses are PDUs in hex; `*n` means that the preceding byte is repeated n times.

| clause | rule | request | response |
|---|---|---|---|
"""


def as_markdown() -> str:
    """Return the page `docs/modbus-conformance.md`."""
    lines = [HEADER]
    for function in FunctionCode:
        name, kind = function.name.lower().replace("_", " "), "write" if function.is_write else "read"
        table = "" if function.table is None else f"{TABLE_NAMES[function.table]}s"
        lines.append(f"| {function} | {name} | {table} | {kind} |\n")
    lines.append(SINGLE_REQUESTS)
    for rule in RULES:
        before = "".join(f"after `{_short(one)}`: " for one in rule.before)
        lines.append(f"| {rule.clause} | {rule.text} | {before}`{_short(rule.request)}` | `{rule.answer}` |\n")
    lines.append("\n## Streams and connections\n\n| clause | rule | test |\n|---|---|---|\n")
    lines += [f"| {clause} | {text} | `{name}` |\n" for clause, text, name in STREAM_RULES]
    lines.append(
        "\n## Modbus/TCP Security\n\nTests in `tests/rig/test_modbus_tls.py`; the last two rules are hilrig's own.\n\n"
    )
    lines.append("| rule | test |\n|---|---|\n")
    lines += [f"| {text} | `{name}` |\n" for text, name in SECURITY_RULES]
    return "".join(lines)


def _short(hexes: str) -> str:
    parts = hexes.split()
    shortened: list[str] = []
    for byte, group in groupby(parts):
        count = len(list(group))
        shortened += [f"{byte}*{count}"] if count > 8 else [byte] * count
    return " ".join(shortened)


if __name__ == "__main__":
    print(as_markdown(), end="")
