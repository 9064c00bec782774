"""The rules of the Modbus specifications that one request can show: the conformance table's data.

Clauses are of the MODBUS Application Protocol Specification V1.1b3 (AP). A rig that has just been taken by its
first controller is assumed: torques are zero, the magnet is off.
"""

from dataclasses import dataclass


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
    # Read Discrete Inputs
    Rule("AP 6.2", "02 pads the last byte with zeros", "02 00 05 00 03", "02 01 00"),
    Rule("AP 6.2", "02 with quantity 0 is an illegal value", "02 00 00 00 00", "82 03"),
    Rule("AP 6.2", "02 with quantity 2001 is an illegal value", "02 00 00 07 D1", "82 03"),
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
    Rule("AP 6.4", "04 across the map's end is an illegal address", "04 00 23 00 02", "84 02"),
    # Write Single Coil
    Rule("AP 6.5", "05 echoes the request", "05 00 00 FF 00", "05 00 00 FF 00"),
    Rule("AP 6.5", "05 switches off with 0000", "05 00 00 00 00", "05 00 00 00 00"),
    Rule("AP 6.5", "05 with any other value is illegal", "05 00 00 00 01", "85 03"),
    Rule("AP 6.5", "05 with FFFF is illegal", "05 00 00 FF FF", "85 03"),
    Rule("AP 6.5", "value is checked before address", "05 00 09 12 34", "85 03"),
    Rule("AP 6.5", "05 of a coil that is not there is an illegal address", "05 00 01 FF 00", "85 02"),
    Rule("AP 6.5", "an illegal value changes nothing", "01 00 00 00 01", "01 01 00", ("05 00 00 00 01",)),
    # Write Single Register
    Rule("AP 6.6", "06 echoes the request", "06 00 03 FF FF", "06 00 03 FF FF"),
    Rule("AP 6.6", "06 of a register that the rig owns is an illegal address", "06 00 04 00 01", "86 02"),
    Rule("AP 6.6", "06 of a register that is not there is an illegal address", "06 00 08 00 01", "86 02"),
    Rule("AP 6.6", "06 that is too long is an illegal value", "06 00 00 00 01 00", "86 03"),
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
    Rule("AP 6.19", "43 with another MEI type is an illegal function", "2B 0D 01 00", "AB 01"),
    # Function codes
    Rule("AP 4.1", "function 0 is not valid", "00", "80 01"),
    Rule("AP 7", "an unknown function is answered with its code and the high bit", "07", "87 01"),
    Rule("AP 7", "a function code that only an answer can have keeps it", "83 00 00 00 01", "83 01"),
    Rule("AP 6.8", "serial-line diagnostics are an illegal function on TCP", "08 00 00 12 34", "88 01"),
)
