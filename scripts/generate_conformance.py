"""The rules of the Modbus specifications that one request can show: the conformance table's data.

Clauses are of the MODBUS Application Protocol Specification V1.1b3 (AP). A rig that has just been taken by its
first controller is assumed: torques are zero, the magnet is off.
"""

from dataclasses import dataclass
from itertools import groupby


@dataclass(frozen=True)
class Rule:
    """What a request's PDU must be answered with, both in hex."""

    clause: str
    text: str
    request: str
    answer: str
    before: tuple[str, ...] = ()

    @property
    def id(self) -> str:
        """The rule's name as a test's id."""
        return f"{self.clause}: {self.text}".replace("/", "|")


def _times(byte: str, count: int) -> str:
    return " ".join([byte] * count)


RULES: tuple[Rule, ...] = (
    # Read Coils
    Rule("AP 6.1", "01 reads a coil, the first in the least significant bit", "01 00 00 00 01", "01 01 00"),
    Rule("AP 6.1", "01 reads back what was written", "01 00 00 00 01", "01 01 01", ("05 00 00 FF 00",)),
    Rule("AP 6.1", "01 with quantity 0 is an illegal value", "01 00 00 00 00", "81 03"),
    Rule("AP 6.1", "01 with quantity 2001 is an illegal value", "01 00 00 07 D1", "81 03"),
    Rule("AP 6.1", "01 with quantity 2000 is legal: the address is what is wrong", "01 00 00 07 D0", "81 02"),
    Rule("AP 6.1", "01 of a coil that is not there is an illegal address", "01 00 01 00 01", "81 02"),
    Rule("AP 6.1", "01 across the end is an illegal address", "01 00 00 00 02", "81 02"),
    Rule("AP 6.1", "quantity is checked before address", "01 FF FF 00 00", "81 03"),
    Rule("AP 6.1", "01 that is too short is an illegal value", "01 00 00 00", "81 03"),
    Rule("AP 6.1", "01 that is too long is an illegal value", "01 00 00 00 01 00", "81 03"),
    Rule("AP 6.1", "01 at address 65535 does not wrap", "01 FF FF 00 02", "81 02"),
    # Read Discrete Inputs
    Rule("AP 6.2", "02 pads the last byte with zeros", "02 00 05 00 03", "02 01 00"),
    Rule("AP 6.2", "02 with quantity 0 is an illegal value", "02 00 00 00 00", "82 03"),
    Rule("AP 6.2", "02 with quantity 2001 is an illegal value", "02 00 00 07 D1", "82 03"),
    Rule("AP 6.2", "02 with quantity 2000 is legal: the address is what is wrong", "02 00 00 07 D0", "82 02"),
    Rule("AP 6.2", "02 that is nothing but its code is an illegal value", "02", "82 03"),
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
    Rule("AP 6.3", "03 with quantity 125 is legal: the address is what is wrong", "03 00 00 00 7D", "83 02"),
    Rule("AP 6.3", "03 beyond the map is an illegal address", "03 00 08 00 01", "83 02"),
    Rule("AP 6.3", "03 across the map's end is an illegal address", "03 00 07 00 02", "83 02"),
    Rule("AP 6.3", "03 across a gap is an illegal address", "03 00 00 00 66", "83 02"),
    Rule("AP 6.3", "03 at address 65535 does not wrap", "03 FF FF 00 02", "83 02"),
    Rule("AP 6.3", "03 that is too short is an illegal value", "03 00 00 00", "83 03"),
    Rule("AP 6.3", "03 that is too long is an illegal value", "03 00 00 00 01 00", "83 03"),
    # Read Input Registers
    Rule("AP 6.4", "04 reads input registers", "04 00 00 00 01", "04 02 00 01"),
    Rule("AP 6.4", "04 with quantity 0 is an illegal value", "04 00 00 00 00", "84 03"),
    Rule("AP 6.4", "04 with quantity 126 is an illegal value", "04 00 00 00 7E", "84 03"),
    Rule("AP 6.4", "04 with quantity 125 is legal: the address is what is wrong", "04 00 00 00 7D", "84 02"),
    Rule("AP 6.4", "04 at address 65535 does not wrap", "04 FF FF 00 02", "84 02"),
    Rule("AP 6.4", "04 across the map's end is an illegal address", "04 00 23 00 02", "84 02"),
    # Write Single Coil
    Rule("AP 6.5", "05 echoes the request", "05 00 00 FF 00", "05 00 00 FF 00"),
    Rule("AP 6.5", "05 switches off with 0000", "05 00 00 00 00", "05 00 00 00 00"),
    Rule("AP 6.5", "05 with any other value is illegal", "05 00 00 00 01", "85 03"),
    Rule("AP 6.5", "05 with FFFF is illegal", "05 00 00 FF FF", "85 03"),
    Rule("AP 6.5", "value is checked before address", "05 00 09 12 34", "85 03"),
    Rule("AP 6.5", "05 of a coil that is not there is an illegal address", "05 00 01 FF 00", "85 02"),
    Rule("AP 6.5", "05 at address 65535 is an illegal address", "05 FF FF FF 00", "85 02"),
    Rule("AP 6.5", "05 that is too long is an illegal value", "05 00 00 FF 00 00", "85 03"),
    Rule("AP 6.5", "an illegal value changes nothing", "01 00 00 00 01", "01 01 00", ("05 00 00 00 01",)),
    # Write Single Register
    Rule("AP 6.6", "06 echoes the request", "06 00 03 FF FF", "06 00 03 FF FF"),
    Rule("AP 6.6", "06 of a register that the rig owns is an illegal address", "06 00 04 00 01", "86 02"),
    Rule("AP 6.6", "06 of a register that is not there is an illegal address", "06 00 08 00 01", "86 02"),
    Rule("AP 6.6", "06 that is too long is an illegal value", "06 00 00 00 01 00", "86 03"),
    Rule("AP 6.6", "06 that is too short is an illegal value", "06 00 00 00", "86 03"),
    Rule("AP 6.6", "06 at address 65535 is an illegal address", "06 FF FF 00 01", "86 02"),
    # Write Multiple Coils
    Rule("AP 6.11", "15 answers address and quantity", "0F 00 00 00 01 01 01", "0F 00 00 00 01"),
    Rule("AP 6.11", "15 ignores the padding of its last byte", "01 00 00 00 01", "01 01 00", ("0F 00 00 00 01 01 FE",)),
    Rule("AP 6.11", "15 with quantity 0 is an illegal value", "0F 00 00 00 00 00", "8F 03"),
    Rule("AP 6.11", "15 with quantity 1969 is an illegal value", f"0F 00 00 07 B1 F7 {_times('00', 247)}", "8F 03"),
    Rule(
        "AP 6.11",
        "15 with quantity 1968 is legal: the address is what is wrong",
        f"0F 00 00 07 B0 F6 {_times('00', 246)}",
        "8F 02",
    ),
    Rule(
        "AP 6.11", "15 whose byte count is not its quantity's is an illegal value", "0F 00 00 00 01 02 01 00", "8F 03"
    ),
    Rule("AP 6.11", "15 with less data than it says is an illegal value", "0F 00 00 00 09 02 01", "8F 03"),
    Rule("AP 6.11", "15 with more data than it says is an illegal value", "0F 00 00 00 01 01 01 00", "8F 03"),
    Rule("AP 6.11", "15 at address 65535 is an illegal address", "0F FF FF 00 01 01 01", "8F 02"),
    Rule("AP 6.11", "15 across the end is an illegal address", "0F 00 00 00 02 01 03", "8F 02"),
    # Write Multiple Registers
    Rule("AP 6.12", "16 answers address and quantity", "10 00 00 00 02 04 00 0A 01 02", "10 00 00 00 02"),
    Rule("AP 6.12", "16 with quantity 0 is an illegal value", "10 00 00 00 00 00", "90 03"),
    Rule("AP 6.12", "16 with quantity 124 is an illegal value", f"10 00 00 00 7C F8 {_times('00', 246)}", "90 03"),
    Rule(
        "AP 6.12",
        "16 with quantity 123 is legal: the address is what is wrong",
        f"10 00 00 00 7B F6 {_times('00', 246)}",
        "90 02",
    ),
    Rule(
        "AP 6.12",
        "16 whose byte count is not twice its quantity is an illegal value",
        "10 00 00 00 02 03 00 0A 01",
        "90 03",
    ),
    Rule("AP 6.12", "16 with less data than it says is an illegal value", "10 00 00 00 02 04 00 0A 01", "90 03"),
    Rule("AP 6.12", "16 with more data than it says is an illegal value", "10 00 00 00 01 02 00 0A 01 02", "90 03"),
    Rule("AP 6.12", "16 at address 65535 does not wrap", "10 FF FF 00 02 04 00 0A 01 02", "90 02"),
    Rule("AP 6.12", "16 across a gap is an illegal address", "10 00 63 00 02 04 00 0A 01 02", "90 02"),
    Rule("AP 6.12", "quantity and byte count are checked before address", "10 FF FF 00 02 03 00 0A 01", "90 03"),
    Rule(
        "AP 6.12",
        "16 that touches a register of the rig is an illegal address",
        "10 00 03 00 02 04 00 0A 01 02",
        "90 02",
    ),
    Rule("AP 6.12", "16 without a byte count is an illegal value", "10 00 00 00 01", "90 03"),
    # Mask Write Register
    Rule("AP 6.16", "22 echoes the request", "16 00 00 00 F2 00 25", "16 00 00 00 F2 00 25"),
    Rule("AP 6.16", "22 of a register of the rig is an illegal address", "16 00 04 00 F2 00 25", "96 02"),
    Rule("AP 6.16", "22 that is too short is an illegal value", "16 00 00 00 F2 00", "96 03"),
    Rule("AP 6.16", "22 that is too long is an illegal value", "16 00 00 00 F2 00 25 00", "96 03"),
    Rule("AP 6.16", "22 of a register that is not there is an illegal address", "16 00 08 00 F2 00 25", "96 02"),
    Rule(
        "AP 6.16",
        "22 with an AND mask of ones leaves the register as it is",
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
    Rule("AP 6.17", "23 reads what it wrote", "17 00 00 00 01 00 00 00 01 02 00 2A", "17 02 00 2A"),
    Rule("AP 6.17", "23 reading 0 registers is an illegal value", "17 00 00 00 00 00 00 00 01 02 00 2A", "97 03"),
    Rule("AP 6.17", "23 reading 126 registers is an illegal value", "17 00 00 00 7E 00 00 00 01 02 00 2A", "97 03"),
    Rule(
        "AP 6.17",
        "23 reading 125 is legal: the address is what is wrong",
        "17 00 00 00 7D 00 00 00 01 02 00 2A",
        "97 02",
    ),
    Rule("AP 6.17", "23 writing 0 registers is an illegal value", "17 00 00 00 01 00 00 00 00 00", "97 03"),
    Rule("AP 6.17", "23 that is too short is an illegal value", "17 00 00 00 01 00 00 00 01", "97 03"),
    Rule(
        "AP 6.17",
        "23 with more data than it says is an illegal value",
        "17 00 00 00 01 00 00 00 01 02 00 2A 00",
        "97 03",
    ),
    Rule(
        "AP 6.17",
        "23 reading a register that is not there is an illegal address",
        "17 00 08 00 01 00 00 00 01 02 00 2A",
        "97 02",
    ),
    Rule(
        "AP 6.17",
        "23 writing a register that is not there is an illegal address",
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
        "23 writing 121 is legal: the address is what is wrong",
        f"17 00 00 00 01 00 00 00 79 F2 {_times('00', 242)}",
        "97 02",
    ),
    Rule(
        "AP 6.17",
        "23 whose byte count is not its quantity's is an illegal value",
        "17 00 00 00 01 00 00 00 01 04 00 2A 00 00",
        "97 03",
    ),
    Rule(
        "AP 6.17", "23 with less data than it says is an illegal value", "17 00 00 00 01 00 00 00 02 04 00 2A", "97 03"
    ),
    Rule(
        "AP 6.17",
        "23 writing a register of the rig is an illegal address",
        "17 00 00 00 01 00 04 00 01 02 00 2A",
        "97 02",
    ),
    # Read Device Identification
    Rule(
        "AP 6.21", "43/14 gives one object by its number", "2B 0E 04 00", "2B 0E 04 82 00 00 01 00 06 68 69 6C 72 69 67"
    ),
    Rule("AP 6.21", "43/14 of an object that is not there is an illegal address", "2B 0E 04 63", "AB 02"),
    Rule("AP 6.21", "43/14 with another read code is an illegal value", "2B 0E 05 00", "AB 03"),
    Rule("AP 6.21", "43/14 with read code 0 is an illegal value", "2B 0E 00 00", "AB 03"),
    Rule(
        "AP 6.21", "43/14 of an optional object that the device has not is an illegal address", "2B 0E 04 03", "AB 02"
    ),
    Rule(
        "AP 6.21",
        "43/14 streams from the object that it is asked for",
        "2B 0E 02 05",
        "2B 0E 02 82 00 00 01 05 05 53 43 41 52 41",
    ),
    Rule(
        "AP 6.21",
        "43/14 asked for more than its conformity level gives what there is",
        "2B 0E 03 05",
        "2B 0E 03 82 00 00 01 05 05 53 43 41 52 41",
    ),
    Rule("AP 6.21", "43/14 that is too short is an illegal value", "2B 0E 01", "AB 03"),
    Rule("AP 6.21", "43/14 that is too long is an illegal value", "2B 0E 01 00 00", "AB 03"),
    Rule("AP 6.19", "43 with another MEI type is an illegal function", "2B 0D 01 00", "AB 01"),
    # Function codes
    Rule("AP 4.1", "function 0 is not valid", "00", "80 01"),
    Rule("AP 7", "an unknown function is answered with its code and the high bit", "07", "87 01"),
    Rule("AP 7", "a function code that only an answer can have keeps it", "83 00 00 00 01", "83 01"),
    Rule("AP 6.8", "serial-line diagnostics are an illegal function on TCP", "08 00 00 12 34", "88 01"),
)

NAMED: tuple[tuple[str, str, str], ...] = (
    ("AP 6.3", "positions are served, big-endian", "test_positions_are_served_by_function_3"),
    ("AP 6.12", "a block write is all or nothing", "test_a_block_write_is_all_or_nothing"),
    ("AP 6.16", "the result is (current AND mask) OR (or-mask AND NOT mask)", "test_function_22_masks_one_register"),
    ("AP 6.17", "the write is done before the read", "test_function_23_writes_before_it_reads"),
    ("AP 6.17", "nothing is written if it can't be read", "test_function_23_writes_nothing_if_it_cannot_read"),
    (
        "AP 6.21",
        "the basic stream has vendor, product and revision",
        "test_identification_names_vendor_product_and_revision",
    ),
    (
        "AP 6.21",
        "a stream from an object that is not there begins with the first",
        "test_identification_from_an_object_that_is_not_there_begins_with_the_first",
    ),
    (
        "AP 7",
        "every other function code gets 01 with its own code",
        "test_every_function_that_is_not_there_says_so_with_its_own_code",
    ),
    (
        "TG 4.4.2.3",
        "units 0 and 255 reach a device without a gateway",
        "test_a_device_without_gateway_answers_units_0_1_and_255",
    ),
    ("AP 7", "another unit is a target that does not respond", "test_other_units_are_a_target_that_does_not_respond"),
    (
        "TG 4.2.2",
        "a transaction identifier comes back as it is",
        "test_transaction_identifiers_come_back_whatever_they_are",
    ),
    (
        "TG 4.4.1.2",
        "several requests in one segment are answered in order",
        "test_every_request_of_one_segment_is_answered_in_order",
    ),
    (
        "TG 4.4.1.2",
        "hundreds of them too",
        "test_hundreds_of_requests_at_once_are_answered_in_order",
    ),
    ("AP 4.1", "a PDU has 1 to 253 bytes", "test_the_shortest_and_the_longest_request_are_answered"),
    ("TG 4.3.2", "a request may come in many segments", "test_a_request_may_come_byte_by_byte"),
    (
        "TG 4.3.2",
        "a half-closed connection gets its answers",
        "test_a_half_closed_connection_still_gets_its_answers",
    ),
    (
        "TG 4.4.2.1",
        "a header that is no Modbus closes the connection",
        "test_malformed_framing_closes_the_connection_and_is_counted",
    ),
    ("TG 4.3.2", "Nagle's algorithm is off, keep-alive is on", "test_answers_are_not_held_back"),
)
"""Clause, rule, and the function in `tests/rig/test_modbus_conformance.py` that shows it."""

SECURED: tuple[tuple[str, str], ...] = (
    ("the whole message, MBAP header and PDU, is inside TLS", "test_an_operator_reads_and_writes"),
    ("TLS 1.2 or newer", "test_old_versions_of_tls_are_refused"),
    (
        "both sides show certificates: the client's is of the lab's authority, for clients, and valid now",
        "test_a_certificate_that_is_not_right_is_refused_and_the_operator_reads_why",
    ),
    (
        "the role is a UTF-8 string in the extension 1.3.6.1.4.1.50316.802.1; two are none",
        "test_a_role_that_cannot_be_told_is_none",
    ),
    ("what the role does not allow gets exception 01", "test_an_observer_and_who_has_no_role_read_only"),
    ("a certificate without a role: as configured", "test_what_no_role_means_is_configured"),
    ("a handshake ends within 5 s or is given up", "test_a_handshake_that_is_never_finished_is_given_up"),
    ("a client cannot begin a handshake anew", "test_a_client_cannot_begin_a_handshake_anew"),
)
"""Rule of Modbus/TCP Security, and the function in `tests/rig/test_modbus_tls.py` that shows it."""

HEADER = """# Conformance

Each row is a rule, the clause that it comes from, and a test with raw bytes on a real socket
(`tests/rig/test_modbus_conformance.py`). AP is the MODBUS Application Protocol Specification V1.1b3, TG the MODBUS
Messaging on TCP/IP Implementation Guide V1.0b. Generated by `python scripts/generate_conformance.py`.

The specifications leave three things open, and this is how they stand here:

- A request whose length is not what its function needs gets exception 03: "the implied length is incorrect".
- A value that is legal in Modbus, but which the rig can't take (a watchdog time-out outside the lab's bounds), gets
  exception 04: the specification reserves 03 for what is wrong with a request, not with a value's meaning.
- A write by a controller that does not hold the rig gets exception 06, and one by a client whose certificate lets it
  read only gets 01, as MODBUS/TCP Security has it.

## One request, one answer

Requests and answers are PDUs in hex; `*n` says that the byte before it stands there n times in a row.

| clause | rule | request | answer |
|---|---|---|---|
"""


def as_markdown() -> str:
    """The page `docs/modbus-conformance.md`."""
    lines = [HEADER]
    for rule in RULES:
        before = "".join(f"after `{_short(one)}`: " for one in rule.before)
        lines.append(f"| {rule.clause} | {rule.text} | {before}`{_short(rule.request)}` | `{rule.answer}` |\n")
    lines.append("\n## Streams, connections, whole maps\n\n| clause | rule | test |\n|---|---|---|\n")
    lines += [f"| {clause} | {text} | `{name}` |\n" for clause, text, name in NAMED]
    lines.append(
        "\n## Modbus/TCP Security\n\nTests in `tests/rig/test_modbus_tls.py`; the last two rules are our own.\n\n"
    )
    lines.append("| rule | test |\n|---|---|\n")
    lines += [f"| {text} | `{name}` |\n" for text, name in SECURED]
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
