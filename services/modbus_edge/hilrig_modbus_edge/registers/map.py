"""Register map as data: value, type, unit and access of each register.

Holding registers 1-8 and coil 1 are exactly the paper's map (Table II). The extended map uses input registers, discrete
inputs, and coils and holding registers from number 101 on. Number n is PDU address n - 1. The tables of
`docs/registers.md` and the CSV for PLC tools are generated from `MAP`.
"""

from dataclasses import dataclass
from enum import Enum, IntFlag
from typing import Final

MAP_VERSION: Final = 1
"""Version of the extended map; incremented when the meaning of a register changes."""

UNIT_IDS: Final = frozenset({0x00, 0x01, 0xFF})
"""Accepted unit identifiers: 0 and 255, which the TCP guide specifies for a device without a gateway, and 1, the
default of most clients. They do not select a rig: the TCP port does."""


class RegisterTable(Enum):
    """The four tables of the Modbus data model, with the first digit of their traditional numbering."""

    COIL = 0
    DISCRETE_INPUT = 1
    INPUT_REGISTER = 3
    HOLDING_REGISTER = 4


class ValueType(Enum):
    """Type of a value; big-endian, most significant register first."""

    BIT = "bit"
    INT16 = "int16"
    UINT16 = "uint16"
    UINT32 = "uint32"
    FLOAT32 = "float32"

    @property
    def words(self) -> int:
        """Number of registers (or bits) per value."""
        return 2 if self in (ValueType.UINT32, ValueType.FLOAT32) else 1


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

    @property
    def address(self) -> int:
        """Address in a request (PDU), from 0."""
        return self.number - 1

    @property
    def classic(self) -> str:
        """Traditional number, as in PLC tools: 40001 for holding register 1."""
        return f"{self.table.value}{self.number:04d}"


class Status(IntFlag):
    """Bits of the status register (input register 2); also the discrete inputs 1-16."""

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
    Status.SIMULATION_ALIVE: "the newest state is less than 1 s old",
    Status.SESSION_OPEN: "a session is open and is recorded",
    Status.LEASE_HELD: "a client holds the lease",
    Status.LEASE_IS_YOURS: "this connection holds the lease",
    Status.WATCHDOG_ON: "the watchdog timeout is not 0",
    Status.WATCHDOG_TRIPPED: "the watchdog has tripped and set the torques to zero; the next write clears it",
    Status.SIMULATION_SAFE: "the simulation applies no torque, because it receives no commands",
    Status.POSITION_SATURATED: "a position exceeds its int16 register; the float register has the exact value",
    Status.ON_STOP: "a joint is at a stop, or the tool touches an object below it",
    Status.MAGNET_ON: "the magnet is on in the simulation",
    Status.PART_HELD: "the magnet holds a part",
    Status.READ_ONLY: "this connection is read-only, by the role of its certificate",
}

TORQUE_ADDRESS: Final = 0
POSITION_ADDRESS: Final = 4
PAPER_END: Final = 8
ECHO_ADDRESS: Final = 100
WATCHDOG_ADDRESS: Final = 101
EXTENDED_END: Final = 102
MAGNET_COIL: Final = 0
RESET_COIL: Final = 100
INPUT_END: Final = 36
DISCRETE_END: Final = 16
"""PDU addresses; each `END` is one after the last address of a range."""

_TORQUES: Final = (("tau1", "N·m"), ("tau2", "N·m"), ("tau3", "N"), ("tau4", "N·m"))
_JOINTS: Final = (("theta1", "°"), ("theta2", "°"), ("d3", "mm"), ("theta4", "°"))
SEPARATE_WRITES: Final = len(_TORQUES) + 1
"""Requests of one control cycle of a controller that writes each torque and the magnet alone."""


def _map() -> tuple[Register, ...]:
    holding, inputs = RegisterTable.HOLDING_REGISTER, RegisterTable.INPUT_REGISTER
    rows = [
        Register(
            RegisterTable.COIL, MAGNET_COIL + 1, ValueType.BIT, "magnet", "magnet of the tool: 1 is on", writable=True
        ),
        Register(
            RegisterTable.COIL,
            RESET_COIL + 1,
            ValueType.BIT,
            "reset",
            "write 1: sets the torques to zero and moves the arm to its start pose; reads 0",
            writable=True,
        ),
    ]
    for bit, text in enumerate(_status_texts()):
        rows.append(Register(RegisterTable.DISCRETE_INPUT, bit + 1, ValueType.BIT, f"status_{bit}", text))
    rows += [
        Register(inputs, 1, ValueType.UINT16, "map_version", "version of the extended map"),
        Register(inputs, 2, ValueType.UINT16, "status", "status bits, same as discrete inputs 1-16 (bit 0 is input 1)"),
        Register(inputs, 3, ValueType.UINT32, "step", "step of the simulation, low 32 bits"),
        Register(inputs, 5, ValueType.UINT32, "loop_latency", "last measured loop latency", "µs"),
        Register(
            inputs, 7, ValueType.UINT16, "lease", "lease: 0 free, 1 this connection holds it, 2 another client holds it"
        ),
        Register(inputs, 8, ValueType.UINT16, "watchdog", "watchdog: 0 off, 1 waiting for a write, 2 armed, 3 tripped"),
        Register(inputs, 9, ValueType.UINT16, "watchdog_timeout", "active watchdog timeout", "ms"),
        Register(
            inputs,
            10,
            ValueType.UINT16,
            "session",
            "number of the open session, counted since the edge started; 0: none",
        ),
        Register(
            inputs,
            11,
            ValueType.UINT16,
            "stops",
            "bits 0-3: joint at its lower stop, 4-7: at its upper stop, 8: tool touches an object",
        ),
        Register(inputs, 12, ValueType.UINT16, "state_age", "age of the state that this read returns", "ms"),
    ]
    for group, start, units, text in (
        ("position", 13, {}, "position of joint"),
        ("velocity", 21, {"°": "°/s", "mm": "mm/s"}, "velocity of joint"),
    ):
        for joint, (name, unit) in enumerate(_JOINTS):
            number = start + 2 * joint
            rows.append(
                Register(
                    inputs, number, ValueType.FLOAT32, f"{group}_{name}", f"{text} {joint + 1}", units.get(unit, unit)
                )
            )
    for joint, (name, unit) in enumerate(_TORQUES):
        rows.append(
            Register(
                inputs,
                29 + 2 * joint,
                ValueType.FLOAT32,
                f"applied_{name}",
                f"effort applied to joint {joint + 1}",
                unit,
            )
        )
    for joint, (name, unit) in enumerate(_TORQUES):
        rows.append(
            Register(
                holding,
                TORQUE_ADDRESS + joint + 1,
                ValueType.INT16,
                name,
                f"commanded effort of joint {joint + 1}",
                unit,
                1000,
                writable=True,
            )
        )
    for joint, (name, unit) in enumerate(_JOINTS):
        rows.append(
            Register(
                holding,
                POSITION_ADDRESS + joint + 1,
                ValueType.INT16,
                name,
                f"position of joint {joint + 1}",
                unit,
                100,
            )
        )
    rows += [
        Register(
            holding,
            ECHO_ADDRESS + 1,
            ValueType.UINT16,
            "echo",
            "any value; the next recorded command carries it",
            writable=True,
        ),
        Register(
            holding,
            WATCHDOG_ADDRESS + 1,
            ValueType.UINT16,
            "watchdog_timeout_set",
            "watchdog timeout, within the bounds of the lab; each session starts with the default of the lab",
            "ms",
            writable=True,
        ),
    ]
    return tuple(rows)


def _status_texts() -> list[str]:
    bits = {flag.bit_length() - 1: text for flag, text in STATUS_TEXT.items()}
    return [bits.get(bit, "always 0") for bit in range(DISCRETE_END)]


MAP: Final = _map()
