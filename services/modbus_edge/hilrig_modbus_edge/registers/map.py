"""Register map as data: value, type, unit and access of each register.

Holding registers 1-8 and coil 1 are exactly the paper's map (Table II). The extended map uses input registers, discrete
inputs, and coils and holding registers from number 101 on. For clients without functions for input registers and coils,
holding registers from 201 on mirror the input registers, and those from 301 on the coils. Number n is PDU address
n - 1. Addresses, binary layouts, scales, `docs/registers.md` and the CSV for PLC tools derive from `MAP`, the only
place of the layout.
"""

import struct
from dataclasses import dataclass, replace
from enum import Enum, IntEnum, unique
from typing import Final

from hilrig_modbus_edge.protocol.functions import RegisterTable

MAP_VERSION: Final = 1
"""Version of the extended map; incremented when the meaning of a register changes."""

UNIT_IDS: Final = frozenset({0x00, 0x01, 0xFF})
"""Accepted unit identifiers: 0 and 255, which the TCP guide specifies for a device without a gateway, and 1, the
default of most clients. They do not select a rig: the TCP port does."""


class ValueType(Enum):
    """Type of a value, with its format character in `struct`; big-endian, most significant register first."""

    BIT = "?"
    INT16 = "h"
    UINT16 = "H"
    UINT32 = "I"
    FLOAT32 = "f"

    @property
    def words(self) -> int:
        """Number of registers (or bits) per value."""
        return max(1, struct.calcsize(f">{self.value}") // 2)


@dataclass(frozen=True, slots=True)
class Register:
    """One value of the map."""

    table: RegisterTable
    number: int
    """Number in its table, from 1."""
    type: ValueType
    name: str
    text: str
    """Human-readable description."""
    unit: str = ""
    scale: int = 1
    """Factor from the value to the register."""
    writable: bool = False
    """Whether a client may write it; the rig writes all others."""
    mirrors: str = ""
    """Name of the value in another table that this one repeats; empty: none."""

    @property
    def address(self) -> int:
        """Address in a request (PDU), from 0."""
        return self.number - 1

    @property
    def end(self) -> int:
        """Address after the value."""
        return self.address + self.type.words

    @property
    def classic(self) -> str:
        """Traditional number, as in PLC tools: 40001 for holding register 1."""
        return f"{self.table.value}{self.number:04d}"


@unique
class Status(IntEnum):
    """Bits of the status register (input register 2), which are also the discrete inputs 1-16, with their meaning."""

    text: str

    def __new__(cls, bit: int, text: str) -> "Status":
        """Create a bit of the register from its number and meaning."""
        flag = int.__new__(cls, 1 << bit)
        flag._value_, flag.text = 1 << bit, text
        return flag

    SIMULATION_ALIVE = 0, "the newest state is less than 1 s old"
    SESSION_OPEN = 1, "a session is open and is recorded"
    LEASE_HELD = 2, "a controller holds the lease"
    LEASE_IS_YOURS = 3, "the controller of this connection holds the lease"
    WATCHDOG_ON = 4, "the watchdog timeout is not 0"
    WATCHDOG_TRIPPED = 5, "the watchdog has tripped and set the torques to zero; the next write clears it"
    SIMULATION_SAFE = 6, "the simulation applies no torque, because it receives no commands"
    POSITION_SATURATED = 7, "a position exceeds its int16 register; the float register has the exact value"
    ON_STOP = 8, "a joint is at a stop, or the tool touches an object below it"
    MAGNET_ON = 9, "the magnet is on in the simulation"
    PART_HELD = 10, "the magnet holds a part"
    READ_ONLY = 11, "this connection is read-only, by the role of its certificate"


_STATUS_BITS: Final = 16
_STATUS_TEXTS: Final = {flag.bit_length(): flag.text for flag in Status}
_COIL, _DISCRETE, _INPUT, _HOLDING = RegisterTable
_MIRROR_OFFSET: Final = 200
"""Difference between the number of a mirror and that of its input register."""
_BIT, _INT16, _UINT16, _UINT32, _FLOAT32 = ValueType

_VALUES: Final = (
    Register(_HOLDING, 1, _INT16, "tau1", "commanded effort of joint 1", "N·m", 1000, writable=True),
    Register(_HOLDING, 2, _INT16, "tau2", "commanded effort of joint 2", "N·m", 1000, writable=True),
    Register(_HOLDING, 3, _INT16, "tau3", "commanded effort of joint 3", "N", 1000, writable=True),
    Register(_HOLDING, 4, _INT16, "tau4", "commanded effort of joint 4", "N·m", 1000, writable=True),
    Register(_HOLDING, 5, _INT16, "theta1", "position of joint 1", "°", 100),
    Register(_HOLDING, 6, _INT16, "theta2", "position of joint 2", "°", 100),
    Register(_HOLDING, 7, _INT16, "d3", "position of joint 3", "mm", 100),
    Register(_HOLDING, 8, _INT16, "theta4", "position of joint 4", "°", 100),
    Register(_HOLDING, 101, _UINT16, "echo", "any value; the next recorded command carries it", writable=True),
    Register(
        _HOLDING,
        102,
        _UINT16,
        "watchdog_timeout_set",
        "watchdog timeout, within the bounds of the lab; each session starts with the default of the lab",
        "ms",
        writable=True,
    ),
    Register(_COIL, 1, _BIT, "magnet", "magnet of the tool: 1 is on", writable=True),
    Register(
        _COIL,
        101,
        _BIT,
        "reset",
        "write 1: sets the torques to zero and moves the arm to its start pose; reads 0",
        writable=True,
    ),
    Register(_INPUT, 1, _UINT16, "map_version", "version of the extended map"),
    Register(_INPUT, 2, _UINT16, "status", "status bits, same as discrete inputs 1-16 (bit 0 is input 1)"),
    Register(_INPUT, 3, _UINT32, "step", "step of the simulation, low 32 bits"),
    Register(_INPUT, 5, _UINT32, "loop_latency", "last measured loop latency", "µs"),
    Register(_INPUT, 7, _UINT16, "lease", "lease: 0 free, 1 the controller of this connection holds it, 2 another one"),
    Register(_INPUT, 8, _UINT16, "watchdog", "watchdog: 0 off, 1 waiting for a write, 2 armed, 3 tripped"),
    Register(_INPUT, 9, _UINT16, "watchdog_timeout", "active watchdog timeout", "ms"),
    Register(_INPUT, 10, _UINT16, "session", "number of the open session, counted since the edge started; 0: none"),
    Register(
        _INPUT,
        11,
        _UINT16,
        "stops",
        "bits 0-3: joint at its lower stop, 4-7: at its upper stop, 8: tool touches an object",
    ),
    Register(_INPUT, 12, _UINT16, "state_age", "age of the state that this read returns", "ms"),
    Register(_INPUT, 13, _FLOAT32, "position_theta1", "position of joint 1", "°"),
    Register(_INPUT, 15, _FLOAT32, "position_theta2", "position of joint 2", "°"),
    Register(_INPUT, 17, _FLOAT32, "position_d3", "position of joint 3", "mm"),
    Register(_INPUT, 19, _FLOAT32, "position_theta4", "position of joint 4", "°"),
    Register(_INPUT, 21, _FLOAT32, "velocity_theta1", "velocity of joint 1", "°/s"),
    Register(_INPUT, 23, _FLOAT32, "velocity_theta2", "velocity of joint 2", "°/s"),
    Register(_INPUT, 25, _FLOAT32, "velocity_d3", "velocity of joint 3", "mm/s"),
    Register(_INPUT, 27, _FLOAT32, "velocity_theta4", "velocity of joint 4", "°/s"),
    Register(_INPUT, 29, _FLOAT32, "applied_tau1", "effort applied to joint 1", "N·m"),
    Register(_INPUT, 31, _FLOAT32, "applied_tau2", "effort applied to joint 2", "N·m"),
    Register(_INPUT, 33, _FLOAT32, "applied_tau3", "effort applied to joint 3", "N"),
    Register(_INPUT, 35, _FLOAT32, "applied_tau4", "effort applied to joint 4", "N·m"),
    *(
        Register(_DISCRETE, number, _BIT, f"status_{number - 1}", _STATUS_TEXTS.get(number, "always 0"))
        for number in range(1, _STATUS_BITS + 1)
    ),
)

MAP: Final = (
    *_VALUES,
    *(
        replace(
            row,
            table=_HOLDING,
            number=_MIRROR_OFFSET + row.number,
            name=f"mirror_{row.name}",
            text=f"as input register {row.number}: {row.text}",
            mirrors=row.name,
        )
        for row in _VALUES
        if row.table is _INPUT
    ),
    Register(
        _HOLDING,
        301,
        _UINT16,
        "magnet_register",
        "as coil 1: 0 switches the magnet off, any other value on",
        writable=True,
        mirrors="magnet",
    ),
    Register(
        _HOLDING,
        302,
        _UINT16,
        "reset_register",
        "as coil 101, when it changes from 0 to another value; a new lease begins with 0",
        writable=True,
        mirrors="reset",
    ),
)

REGISTERS: Final = {register.name: register for register in MAP}
"""The map by name."""


def rows_of(table: RegisterTable) -> list[Register]:
    """Return the rows of a table in the order of their numbers."""
    return sorted((row for row in MAP if row.table is table), key=lambda row: row.number)


def address_of(name: str) -> int:
    """Return the PDU address of a value."""
    return REGISTERS[name].address


def end_of(table: RegisterTable) -> int:
    """Return the address after the last value of a table."""
    return rows_of(table)[-1].end


def struct_of(table: RegisterTable, start: int = 0, end: int = 0x10000) -> struct.Struct:
    """Return the binary layout of the registers from PDU address `start` to `end` - 1, which have no gap."""
    return struct.Struct(">" + "".join(row.type.value for row in rows_of(table) if start <= row.address < end))


TORQUE_ADDRESS: Final = address_of("tau1")
POSITION_ADDRESS: Final = address_of("theta1")
PAPER_END: Final = REGISTERS["theta4"].end
ECHO_ADDRESS: Final = address_of("echo")
WATCHDOG_ADDRESS: Final = address_of("watchdog_timeout_set")
EXTENDED_END: Final = REGISTERS["watchdog_timeout_set"].end
MIRROR_ADDRESS: Final = address_of("mirror_map_version")
MIRROR_END: Final = REGISTERS["mirror_applied_tau4"].end
SWITCH_ADDRESS: Final = address_of("magnet_register")
SWITCH_END: Final = REGISTERS["reset_register"].end
MAGNET_COIL: Final = address_of("magnet")
RESET_COIL: Final = address_of("reset")
INPUT_END: Final = end_of(RegisterTable.INPUT_REGISTER)
DISCRETE_END: Final = end_of(RegisterTable.DISCRETE_INPUT)
"""PDU addresses; each `END` is one after the last address of a range."""

SEPARATE_WRITES: Final = POSITION_ADDRESS - TORQUE_ADDRESS + 1
"""Requests of one control cycle of a controller that writes each torque and the magnet alone."""
