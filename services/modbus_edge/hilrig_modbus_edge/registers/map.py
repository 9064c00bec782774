"""The register map as data: what each number holds, in which unit, and who writes it.

Holding registers 1-8 and coil 1 are the paper's map (Table II) exactly; the extended map lies in input registers
and discrete inputs, and from number 101 on, where it is never in the way. Number n is PDU address n - 1. The tables
of `docs/registers.md` and the CSV for PLC tools are made from `MAP`.
"""

from dataclasses import dataclass
from enum import Enum, IntFlag
from typing import Final

MAP_VERSION: Final = 1
"""Grows when a register of the extended map changes its meaning."""

UNIT_IDS: Final = frozenset({0x00, 0x01, 0xFF})
"""Unit identifiers answered: 0 and 255, which the TCP guide names for a device without a gateway, and 1, every
client's default. They do not tell rigs apart: a port does."""


class Table(Enum):
    """The four tables of the data model, with the first digit of their classic numbering."""

    COIL = 0
    DISCRETE_INPUT = 1
    INPUT_REGISTER = 3
    HOLDING_REGISTER = 4


class Kind(Enum):
    """How a value lies in its registers: big-endian, most significant word first."""

    BIT = "bit"
    INT16 = "int16"
    UINT16 = "uint16"
    UINT32 = "uint32"
    FLOAT32 = "float32"

    @property
    def words(self) -> int:
        """Registers (or bits) that one value takes."""
        return 2 if self in (Kind.UINT32, Kind.FLOAT32) else 1


@dataclass(frozen=True, slots=True)
class Register:
    """One value of the map."""

    table: Table
    number: int
    """Number in its table, from 1."""
    kind: Kind
    name: str
    text: str
    """What it is, for people."""
    unit: str = ""
    scale: int = 1
    """The register holds the value times this."""
    writable: bool = False
    """Whether a controller writes it; else the rig does."""

    @property
    def address(self) -> int:
        """Address in a request (PDU), from 0."""
        return self.number - 1

    @property
    def classic(self) -> str:
        """The number as PLC tools write it: 40001 for holding register 1."""
        return f"{self.table.value}{self.number:04d}"


class Status(IntFlag):
    """Bits of the status word (input register 2), which are the discrete inputs 1-16 too."""

    SIMULATION_ALIVE = 1 << 0
    SESSION_OPEN = 1 << 1
    LEASE_HELD = 1 << 2
    LEASE_IS_YOURS = 1 << 3
    WATCHDOG_ON = 1 << 4
    WATCHDOG_TRIPPED = 1 << 5
    SIMULATION_SAFE = 1 << 6
    POSITION_SATURATED = 1 << 7
    ON_STOP = 1 << 8
    MAGNET_ON = 1 << 9
    PART_HELD = 1 << 10
    READ_ONLY = 1 << 11


STATUS_TEXT: Final = {
    Status.SIMULATION_ALIVE: "the newest state is fresh",
    Status.SESSION_OPEN: "a session is going on and is recorded",
    Status.LEASE_HELD: "a controller holds the rig",
    Status.LEASE_IS_YOURS: "this connection holds the rig",
    Status.WATCHDOG_ON: "the watchdog's time-out is not 0",
    Status.WATCHDOG_TRIPPED: "the watchdog has set the torques to zero; the next write clears it",
    Status.SIMULATION_SAFE: "the simulation applies no torque, for it hears no command",
    Status.POSITION_SATURATED: "a position does not fit its int16 register; the float has the full value",
    Status.ON_STOP: "a joint is on a stop, or the tool on what lies below it",
    Status.MAGNET_ON: "the magnet is on in the simulation",
    Status.PART_HELD: "the magnet holds a part",
    Status.READ_ONLY: "this connection's certificate lets it read only",
}

TORQUE: Final = 0
POSITION: Final = 4
PAPER_END: Final = 8
ECHO: Final = 100
WATCHDOG: Final = 101
EXTENDED_END: Final = 102
MAGNET: Final = 0
RESET: Final = 100
INPUT_END: Final = 36
DISCRETE_END: Final = 16
"""PDU addresses of what the device serves; an end is the first address behind."""

_TORQUES: Final = (("tau1", "N·m"), ("tau2", "N·m"), ("tau3", "N"), ("tau4", "N·m"))
_JOINTS: Final = (("theta1", "°"), ("theta2", "°"), ("d3", "mm"), ("theta4", "°"))
SEPARATE_WRITES: Final = len(_TORQUES) + 1
"""Requests of one control cycle of a controller that writes each torque and the magnet alone."""


def _map() -> tuple[Register, ...]:
    holding, inputs = Table.HOLDING_REGISTER, Table.INPUT_REGISTER
    rows = [
        Register(Table.COIL, MAGNET + 1, Kind.BIT, "magnet", "magnet of the tool: 1 on", writable=True),
        Register(
            Table.COIL,
            RESET + 1,
            Kind.BIT,
            "reset",
            "write 1: torques to zero and the arm back to its start pose; reads 0",
            writable=True,
        ),
    ]
    for bit, text in enumerate(_status_texts()):
        rows.append(Register(Table.DISCRETE_INPUT, bit + 1, Kind.BIT, f"status_{bit}", text))
    rows += [
        Register(inputs, 1, Kind.UINT16, "map_version", "version of the extended map"),
        Register(inputs, 2, Kind.UINT16, "status", "status bits, as discrete inputs 1-16 (bit 0 is input 1)"),
        Register(inputs, 3, Kind.UINT32, "step", "step of the simulation, low 32 bits"),
        Register(inputs, 5, Kind.UINT32, "loop_latency", "last loop latency that was seen", "µs"),
        Register(inputs, 7, Kind.UINT16, "lease", "lease: 0 free, 1 yours, 2 another controller's"),
        Register(inputs, 8, Kind.UINT16, "watchdog", "watchdog: 0 off, 1 waiting for a write, 2 watching, 3 tripped"),
        Register(inputs, 9, Kind.UINT16, "watchdog_timeout", "time-out of the watchdog in force", "ms"),
        Register(inputs, 10, Kind.UINT16, "session", "number of the session since the edge started; 0: none is open"),
        Register(
            inputs, 11, Kind.UINT16, "stops", "bits 0-3: joint on its lower stop, 4-7: upper stop, 8: tool on something"
        ),
        Register(inputs, 12, Kind.UINT16, "state_age", "age of the state that this read gives", "ms"),
    ]
    for group, start, units, text in (
        ("position", 13, {}, "position of joint"),
        ("velocity", 21, {"°": "°/s", "mm": "mm/s"}, "velocity of joint"),
    ):
        for joint, (name, unit) in enumerate(_JOINTS):
            number = start + 2 * joint
            rows.append(
                Register(inputs, number, Kind.FLOAT32, f"{group}_{name}", f"{text} {joint + 1}", units.get(unit, unit))
            )
    for joint, (name, unit) in enumerate(_TORQUES):
        rows.append(
            Register(
                inputs, 29 + 2 * joint, Kind.FLOAT32, f"applied_{name}", f"effort applied to joint {joint + 1}", unit
            )
        )
    for joint, (name, unit) in enumerate(_TORQUES):
        rows.append(
            Register(
                holding,
                TORQUE + joint + 1,
                Kind.INT16,
                name,
                f"effort asked of joint {joint + 1}",
                unit,
                1000,
                writable=True,
            )
        )
    for joint, (name, unit) in enumerate(_JOINTS):
        rows.append(
            Register(holding, POSITION + joint + 1, Kind.INT16, name, f"position of joint {joint + 1}", unit, 100)
        )
    rows += [
        Register(
            holding, ECHO + 1, Kind.UINT16, "echo", "any word; the next command's record carries it", writable=True
        ),
        Register(
            holding,
            WATCHDOG + 1,
            Kind.UINT16,
            "watchdog_timeout_set",
            "time-out of the watchdog, within the lab's bounds; the lab's own again in each session",
            "ms",
            writable=True,
        ),
    ]
    return tuple(rows)


def _status_texts() -> list[str]:
    bits = {flag.bit_length() - 1: text for flag, text in STATUS_TEXT.items()}
    return [bits.get(bit, "always 0") for bit in range(DISCRETE_END)]


MAP: Final = _map()
