"""Settings of a rig whose controller is a Modbus server: its address, its registers, and the requests of the edge.

An address of a register is a number, a text, or a number of the traditional notation: `4`, `"holding 4"` and `"40005"`
are the same holding register, whose address on the wire is 4.
"""

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Final, Literal

from pydantic import AfterValidator, Field, model_validator

from hilrig_runtime.config.types import Flag, Positive, Section

DEFAULT_PORT: Final = 502
"""Port of Modbus TCP."""
MAX_READ: Final = 125
"""Largest number of registers that one request reads (MODBUS Application Protocol V1.1b3, 6.3)."""

Table = Literal["coil", "discrete", "input", "holding"]
_DIGITS: Final[dict[Table, int]] = {"coil": 0, "discrete": 1, "input": 3, "holding": 4}
"""First digit of the traditional notation of each table."""
_NAMES: Final[dict[Table, str]] = {
    "coil": "coil",
    "discrete": "discrete input",
    "input": "input register",
    "holding": "holding register",
}
_TABLE_OF: Final[dict[str, Table]] = {str(digit): table for table, digit in _DIGITS.items()}
_NAMED: Final = re.compile(r"(coil|discrete|input|holding) (\d{1,5})(?:\.(\d{1,2}))?")
_TRADITIONAL: Final = re.compile(r"([0134])(\d{4,5})(?:\.(\d{1,2}))?")
_HOST: Final = re.compile(r"(?:\[([0-9A-Fa-f:.]+)\]|([^\s:/\[\]]+))(?::(\d{1,5}))?")


@dataclass(frozen=True, slots=True)
class RegisterBlock:
    """Consecutive registers or coils of a controller."""

    table: Table
    address: int
    """Address of the first one on the wire, from 0."""
    count: int = 1
    bit: int | None = None
    """Number of the bit in the only register, from 0, the least significant; None: not a bit of a register."""

    @property
    def end(self) -> int:
        """Address after the last one."""
        return self.address + self.count

    def __iter__(self) -> Iterator[int]:
        """The addresses."""
        return iter(range(self.address, self.end))

    def to(self, other: "RegisterBlock") -> "RegisterBlock":
        """Return the registers of both blocks of one table, and those between them."""
        first = min(self.address, other.address)
        return RegisterBlock(self.table, first, max(self.end, other.end) - first)

    def overlaps(self, other: "RegisterBlock") -> bool:
        """Return whether both have a register or coil in common; different bits of one register are distinct."""
        if self.table != other.table or self.end <= other.address or other.end <= self.address:
            return False
        return self.bit is None or other.bit is None or self.bit == other.bit

    def __str__(self) -> str:
        """Name as in documents of a controller: "holding registers 4–7 (40005–40008)"."""
        digit, last = _DIGITS[self.table], self.end - 1
        width = 5 if last >= 9999 else 4
        first_text = f"{digit}{self.address + 1:0{width}d}"
        bit = "" if self.bit is None else f" bit {self.bit}"
        if self.count == 1:
            return f"{_NAMES[self.table]} {self.address}{bit} ({first_text}{bit and f'.{self.bit}'})"
        return f"{_NAMES[self.table]}s {self.address}–{last} ({first_text}–{digit}{last + 1:0{width}d})"


def parse_register(value: int | str, default: Table) -> RegisterBlock:
    """Parse the address of a register or coil; a number is an address of the table `default`.

    Raises:
        ValueError: the address is invalid.
    """
    if isinstance(value, int):
        if 30_001 <= value <= 39_999 or 40_001 <= value <= 49_999:
            raise ValueError(
                f'{value} is ambiguous: write "{value}" for the traditional notation, or "{default} {value}" for the '
                "address on the wire"
            )
        return _checked(RegisterBlock(default, value))
    if match := _NAMED.fullmatch(value):
        table: Table = match[1]  # type: ignore[assignment]  # one of the alternatives of the expression
        return _checked(RegisterBlock(table, int(match[2]), bit=_bit(match[3])))
    if match := _TRADITIONAL.fullmatch(value):
        return _checked(RegisterBlock(_TABLE_OF[match[1]], int(match[2]) - 1, bit=_bit(match[3])))
    raise ValueError(
        f'{value!r} is no address; expected a number from 0, "holding 4", "input 4", "coil 0", "discrete 0", '
        '"holding 8.3" (bit 3), or the traditional notation "40005"'
    )


def _bit(text: str | None) -> int | None:
    return None if text is None else int(text)


def _checked(block: RegisterBlock) -> RegisterBlock:
    if not 0 <= block.address <= 0xFFFF:
        raise ValueError(f"address {block.address} on the wire is outside 0 to 65535")
    if block.bit is not None and (block.table not in ("input", "holding") or block.bit > 15):
        raise ValueError("only an input or holding register has bits, numbered 0 to 15")
    return block


def parse_controller(address: str, default_port: int = DEFAULT_PORT) -> tuple[str, int]:
    """Return host and port of "HOST", "HOST:PORT" or "[IPv6]:PORT".

    Raises:
        ValueError: it is no address.
    """
    match = _HOST.fullmatch(address)
    port = default_port if match is None or match[3] is None else int(match[3])
    if match is None or not 1 <= port <= 0xFFFF:
        raise ValueError(f'{address!r} is no address of a controller; expected "HOST", "HOST:PORT" or "[IPv6]:PORT"')
    return match[1] or match[2], port


def _check_controller(address: str) -> str:
    parse_controller(address)
    return address


def _address_in(default: Table) -> Callable[[int | str], int | str]:
    def check(value: int | str) -> int | str:
        parse_register(value, default)
        return value

    return check


ControllerAddress = Annotated[str, AfterValidator(_check_controller)]
_Number = Annotated[int, Field(strict=True)]
_Register = Annotated[_Number | str, AfterValidator(_address_in("holding"))]


class RegistersConfig(Section):
    """Registers of a controller that is a Modbus server; the defaults are those of the rig's own server.

    An address is a number on the wire from 0, a text such as "input 4" or "holding 8.3" (bit 3), or the traditional
    notation in quotes, "40005". A block is four values of `format`.
    """

    torques: _Register = 0
    """First register of the four torques, which the edge reads; "input 0": with function 4 instead of 3."""
    positions: _Register = 4
    """First holding register of the four positions, which the edge writes."""
    magnet: Literal["none"] | _Number | str = "coil 0"
    """Coil, discrete input or bit of a register that switches the magnet, which the edge reads; "none": not read. A bit
    beside the torques, the echo or the positions is read with the torques, in one request."""
    echo: _Register | None = None
    """Register into which the program copies the step number that the edge writes directly after the positions; the
    watchdog then monitors the program, and the latency is exact. It is read in one request with the torques."""
    format: Literal["int16", "int32", "float32"] = "int16"
    """Number format: int16 and int32 count 0.001 N·m (N) and 0.01° (mm); float32 has N·m (N) and ° (mm)."""
    word_order: Literal["high-first", "low-first"] = "high-first"
    """Which register of a 32-bit number comes first."""

    @property
    def _size(self) -> int:
        return 4 if self.format == "int16" else 8

    @property
    def torque_block(self) -> RegisterBlock:
        """The torques."""
        return replace(parse_register(self.torques, "holding"), count=self._size)

    @property
    def position_block(self) -> RegisterBlock:
        """The positions."""
        return replace(parse_register(self.positions, "holding"), count=self._size)

    @property
    def magnet_block(self) -> RegisterBlock | None:
        """The switch of the magnet; None: not read."""
        return None if self.magnet == "none" else parse_register(self.magnet, "coil")

    @property
    def echo_block(self) -> RegisterBlock | None:
        """The copy of the step number; None: no echo register."""
        return None if self.echo is None else parse_register(self.echo, "holding")

    @property
    def written_block(self) -> RegisterBlock:
        """The positions, with the step number after them if there is an echo register."""
        block = self.position_block
        return block if self.echo is None else replace(block, count=block.count + 1)

    @property
    def _torques_and_echo(self) -> RegisterBlock:
        return self.torque_block if self.echo_block is None else self.torque_block.to(self.echo_block)

    @property
    def read_block(self) -> RegisterBlock:
        """The registers of one request that reads the torques, the echo if it has one, and the magnet if possible."""
        block, magnet = self._torques_and_echo, self.magnet_block
        if magnet is None or magnet.table != block.table:
            return block
        wider = block.to(magnet)
        # A register in between that does not exist would make the request fail.
        existing = {address for _, known in self._named_blocks() if known.table == block.table for address in known}
        existing.update(block)
        return wider if wider.count <= MAX_READ and existing.issuperset(wider) else block

    @property
    def separate_magnet_block(self) -> RegisterBlock | None:
        """The switch of the magnet if it has a request of its own; None: it is read with the torques, or not at all."""
        magnet, block = self.magnet_block, self.read_block
        return None if magnet is None or (magnet.table == block.table and magnet.address in block) else magnet

    def _named_blocks(self) -> Iterator[tuple[str, RegisterBlock]]:
        yield "torques", self.torque_block
        yield "positions" if self.echo is None else "positions and step number", self.written_block
        if self.echo_block is not None:
            yield "echo", self.echo_block
        if self.magnet_block is not None:
            yield "magnet", self.magnet_block

    @model_validator(mode="after")
    def _check_blocks(self) -> "RegistersConfig":
        torques, echo, magnet = self.torque_block, self.echo_block, self.magnet_block
        if torques.table not in ("holding", "input") or torques.bit is not None:
            raise ValueError(f"torques: expected a holding or input register, got {torques}")
        if self.position_block.table != "holding" or self.position_block.bit is not None:
            raise ValueError(f"positions: expected a holding register, got {self.position_block}")
        if magnet is not None and magnet.table in ("holding", "input") and magnet.bit is None:
            raise ValueError(f'magnet: expected a coil, a discrete input, or a bit as in "holding 8.3", got {magnet}')
        if echo is not None and (echo.table != torques.table or echo.bit is not None):
            raise ValueError(f"echo: expected a register of the table of the torques ({torques}), got {echo}")
        if self._torques_and_echo.count > MAX_READ:
            raise ValueError(
                f"echo: {echo} is too far from the torques ({torques}): one request reads at most {MAX_READ} registers"
            )
        blocks = list(self._named_blocks())
        for number, (name, block) in enumerate(blocks):
            if block.end > 0x10000:
                raise ValueError(f"{name}: {block} ends after address 65535")
            for other_name, other in blocks[:number]:
                if block.overlaps(other):
                    raise ValueError(f"{name} ({block}) overlaps {other_name} ({other})")
        return self

    def describe(self) -> str:
        """Return which registers the edge writes and reads, human-readable."""
        written = "positions" if self.echo is None else "positions and step number"
        parts = [f"writes {self.written_block} ({written})", f"reads {self.torque_block} (torques)"]
        if self.echo_block is not None:
            parts.append(f"{self.echo_block} (echo)")
        if self.magnet_block is not None:
            parts.append(f"{self.magnet_block} (magnet)")
        return ", ".join(parts)


class ClientTlsConfig(Section):
    """Modbus/TCP Security of the connection to a controller."""

    authority: Path
    """Certificate of the authority that signs the controller's certificate, PEM; the host must be named in that."""
    certificate: Path
    """The rig's certificate with its chain, PEM."""
    key: Path
    """The certificate's private key, PEM."""


class ClientConfig(Section):
    """Requests of the edge to a controller that is a Modbus server."""

    timeout_ms: Annotated[float, Field(strict=True, ge=10, le=60_000)] = 500.0
    """Time without a response after which a request has failed; two in a row: the connection is closed."""
    connect_timeout_ms: Annotated[float, Field(strict=True, ge=10, le=60_000)] = 2000.0
    """Time in which a connection must be established."""
    read_lead_ms: Positive | None = None
    """Time before the tick of the simulation at which the torques should have been read; default: a quarter of the
    step."""
    combined_request: Flag = False
    """Write the positions and read the torques with one request (function 23): half the network time, but the torques
    are those of earlier positions."""
    tls: ClientTlsConfig | None = None
    """Connect with TLS."""
