"""The lab's configuration: the validated content of `lab.toml`; each error is reported with its place.

Units are SI unless the key's name states another one (`step_ms`, `timeout_ms`). Without a file the lab has one rig
with the defaults below.
"""

from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import BeforeValidator, Field, PrivateAttr, ValidationError, model_validator

from hilrig_runtime.addresses import WILDCARDS
from hilrig_runtime.config.bus import BusConfig
from hilrig_runtime.config.classroom import ClassroomConfig
from hilrig_runtime.config.controller import ClientConfig, ControllerAddress, RegistersConfig, parse_controller
from hilrig_runtime.config.edge_tls import TlsConfig
from hilrig_runtime.config.impairment import ImpairmentConfig
from hilrig_runtime.config.scene import SceneConfig
from hilrig_runtime.config.task import TaskConfig
from hilrig_runtime.config.types import (
    Flag,
    Name,
    Network,
    NotNegative,
    Number,
    Port,
    Positive,
    Section,
    TableForm,
    Vector4,
    check_distinct,
)
from hilrig_runtime.config.validation import format_validation_error, parse_toml, read_text, validate
from hilrig_runtime.errors import InputError, first_errors, list_names
from hilrig_schemas.topics import RESERVED_RIG_NAMES, SERVICES

MAX_RIGS = 10_000
"""More rigs than any machine steps in real time; a mistyped count is detected here."""
MAX_NAMES_IN_MESSAGE = 16
"""Number of rigs that an error message names before "and … more"."""


class ArmConfig(Section):
    """The arm's parameters (docs/model.md); defaults are from the paper, or chosen where it gives no value."""

    l1_m: Positive = 0.139
    """Height of the arm's plane above the base plane, m."""
    l2_m: Positive = 0.300
    """Length of link 1, m."""
    l3_m: Positive = 0.300
    """Length of link 2, m."""
    masses_kg: tuple[Positive, Positive, Positive] = (1.0, 1.0, 0.5)
    """m1, m2 at the distal ends of the links, m3 of the quill, kg."""
    j4_kgm2: Positive = 0.005
    """Inertia of joint 4 about its axis, kg·m²."""
    friction: tuple[NotNegative, NotNegative, NotNegative, NotNegative] = (2.0, 2.0, 5.0, 0.05)
    """Viscous friction b1…b4; N·m·s, N·m·s, N·s/m, N·m·s."""
    lower_limits: Vector4 = (-133.0, -153.0, 0.0, -360.0)
    """Lower stops; degrees, degrees, mm, degrees."""
    upper_limits: Vector4 = (133.0, 153.0, 200.0, 360.0)
    """Upper stops; degrees, degrees, mm, degrees."""
    start_position: Vector4 = (0.0, 0.0, 0.0, 0.0)
    """Position at the start of the simulation and after a reset; degrees, degrees, mm, degrees."""
    external_force_z_n: Number = 0.0
    """f_z, constant force of the environment on the tool, world z up, N."""
    external_torque_z_nm: Number = 0.0
    """n_z, constant torque of the environment on the tool about world z, N·m."""


class SimConfig(Section):
    """Simulation of the plant."""

    step_ms: Annotated[float, Field(strict=True, ge=0.5, le=1000)] = 20.0
    """Length of a step, ms."""
    substeps: Annotated[int, Field(strict=True, ge=1, le=100)] | Literal["auto"] = "auto"
    """Integration steps in one step of the loop; "auto" chooses them for each rig and step by their error estimate."""
    integrator: Literal["rkf45", "rk4", "euler"] = "rkf45"
    command_timeout_ms: NotNegative = 600.0
    """Time without a command after which the effort is set to zero; 0: never."""

    @property
    def step_ns(self) -> int:
        """Length of a step, ns."""
        return round(self.step_ms * 1e6)

    @property
    def command_timeout_ns(self) -> int:
        """`command_timeout_ms` in ns."""
        return round(self.command_timeout_ms * 1e6)


class EdgeConfig(Section):
    """The Modbus servers of the rigs."""

    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0 opens the rigs to the network, :: also with IPv6."""
    first_port: Port = 5020
    """Port of the first rig; the others follow, unless a rig sets its own port."""
    watchdog_ms: Annotated[float, Field(strict=True, ge=0, le=65535)] = 1000.0
    """Time without a write after which the watchdog sets the torque to zero; 0: never."""
    watchdog_min_ms: Annotated[float, Field(strict=True, ge=1, le=65535)] = 100.0
    """Shortest watchdog timeout that a controller may set by register."""
    watchdog_max_ms: Annotated[float, Field(strict=True, ge=1, le=65535)] = 10_000.0
    """Longest watchdog timeout that a controller may set by register."""
    lease_timeout_ms: Positive = 5000.0
    """Time without a request after which another controller that writes acquires the lease."""
    lease: Literal["controller", "connection"] = "controller"
    """Identity of a client without a certificate: its host ("controller"), or each connection ("connection")."""
    unmapped_reads: Literal["refuse", "zeros"] = "refuse"
    """Response to a block read with addresses that do not exist: exception 02 ("refuse"), or they read 0 ("zeros"). A
    block without any that exists is always refused."""
    session_grace_ms: NotNegative = 5000.0
    """Time within which a controller that reconnects continues its session."""
    repeat_ms: Positive = 200.0
    """Interval at which the held command is repeated to the simulation."""
    max_connections: Annotated[int, Field(strict=True, ge=1)] = 32
    """Largest number of connections of a rig."""
    max_connections_per_host: Annotated[int, Field(strict=True, ge=1)] = 16
    """Largest number of connections of a rig from one host."""
    idle_timeout_s: NotNegative = 60.0
    """Time without a valid request after which a new connection is closed; one that made requests is closed after it if
    its place is needed, the longest idle first; 0: never."""
    plain: Flag = True
    """Listen without TLS; false: only clients with a certificate can connect."""
    tls: TlsConfig | None = None
    """Also listen with TLS."""

    @model_validator(mode="after")
    def _check_bounds(self) -> "EdgeConfig":
        if self.watchdog_min_ms > self.watchdog_max_ms:
            raise ValueError(
                f"watchdog_min_ms must be ≤ watchdog_max_ms, got {self.watchdog_min_ms:g} and {self.watchdog_max_ms:g}"
            )
        if not self.plain and self.tls is None:
            raise ValueError("plain is false and there is no [edge.tls]: no client could connect")
        return self


class RecorderConfig(Section):
    """Recordings and their retention."""

    folder: Path = Path("recordings")
    """Recordings are `<folder>/<lab>/<rig>/<session>.mcap`."""
    preroll_s: NotNegative = 2.0
    """Pre-roll: time before the session's start that its recording contains, s."""
    queue_entries: Annotated[int, Field(strict=True, ge=1)] = 500_000
    """Capacity of the queue in front of the disk, messages; more are dropped and counted. The default holds 20 s of 500
    rigs."""
    rotate_mib: Annotated[int, Field(strict=True, ge=0)] = 1024
    """File size at which a session continues in a new file (segment), MiB; 0: never."""
    rotate_min: NotNegative = 0.0
    """File age at which a session continues in a new file, min; 0: never."""
    keep_days: NotNegative = 0.0
    """Recordings older than this are deleted, except the last one of each rig, days; 0: no limit."""
    keep_gib: NotNegative = 0.0
    """Total size above which the oldest recordings are deleted, except the last one of each rig, GiB; 0: no limit."""
    min_free_mib: Annotated[int, Field(strict=True, ge=0)] = 64
    """Free disk space below which recording stops, MiB."""


class RigSettings(Section):
    """One rig: settings that differ from the lab's defaults."""

    name: Name = "rig1"
    port: Port | None = None
    """Modbus TCP port; default: the next free one from `edge.first_port`."""
    host: str | None = None
    """Address to listen on; default: `edge.host`. Several rigs can have port 502, each on its own address."""
    allow: tuple[Network, ...] = ()
    """Networks whose hosts may connect, as "192.168.7.0/24"; empty: all."""
    controller: ControllerAddress | None = None
    """Address of a controller that is a Modbus server, "HOST" or "HOST:PORT" (default port 502): the edge is its
    client, and the rig's own server is read-only."""
    unit: Annotated[int, Field(strict=True, ge=0, le=255)] = 1
    """Unit identifier of that controller."""
    registers: RegistersConfig = RegistersConfig()
    client: ClientConfig = ClientConfig()
    arm: ArmConfig = ArmConfig()
    scene: SceneConfig | None = None
    """Scene of this rig; default: the lab's."""
    impairment: ImpairmentConfig | None = None
    """Impairment of this rig; default: the lab's."""

    @model_validator(mode="after")
    def _name_is_not_reserved(self) -> "RigSettings":
        if self.name in RESERVED_RIG_NAMES or self.name in SERVICES:
            raise ValueError(f"{self.name!r} is a reserved name; choose another rig name")
        return self

    @model_validator(mode="after")
    def _controller_settings_are_used(self) -> "RigSettings":
        defaults = (1, RegistersConfig(), ClientConfig())
        if self.controller is None and (self.unit, self.registers, self.client) != defaults:
            raise ValueError("unit, registers and client have no effect without controller; add it, or remove them")
        if self.client.combined_request and self.registers.torque_block.table != "holding":
            raise ValueError(
                "client.combined_request: function 23 reads holding registers, and the torques are "
                f"{self.registers.torque_block}"
            )
        return self

    def describe_controller(self) -> str:
        """Return the address of its controller, and which registers the edge writes and reads there."""
        return f"client of {self.controller}, unit {self.unit}: {self.registers.describe()}"


class RigsTable(Section):
    """A group of identical rigs, `[rigs]`, and additional single rigs, `[[rigs.single]]`."""

    count: Annotated[int, Field(strict=True, ge=1, le=MAX_RIGS)] = 1
    """Number of rigs of the group, named <prefix>1, <prefix>2, …"""
    prefix: Name = "rig"
    allow: tuple[Network, ...] = ()
    """As for a single rig, for all rigs of the group."""
    arm: ArmConfig = ArmConfig()
    scene: SceneConfig | None = None
    single: tuple[RigSettings, ...] = ()
    """Single rigs; one with the name of a rig of the group replaces it."""

    def rigs(self) -> tuple[RigSettings, ...]:
        """Return all rigs: the group in order, then the single rigs outside the group."""
        single = {rig.name: rig for rig in self.single}
        names = [f"{self.prefix}{number}" for number in range(1, self.count + 1)]
        template = RigSettings(allow=self.allow, arm=self.arm, scene=self.scene)
        members = [single.get(name) or template.model_copy(update={"name": name}) for name in names]
        return (*members, *(rig for rig in self.single if rig.name not in set(names)))

    @model_validator(mode="after")
    def _names_are_distinct(self) -> "RigsTable":
        check_distinct("rig name", (rig.name for rig in self.single))
        return self


def _expand_group(rigs: Any) -> Any:
    return RigsTable.model_validate(rigs).rigs() if isinstance(rigs, dict) else rigs


_LOOPBACK: Final = ("localhost", "127.0.0.1", "::1")
"""Names of this host, which are one controller."""


class LabConfig(Section):
    """The configuration of a lab."""

    name: Name = "lab"
    realtime: Flag = True
    """Run simulation and edge with a real-time scheduling policy, if the system grants it (docs/operations.md)."""
    sim: SimConfig = SimConfig()
    edge: EdgeConfig = EdgeConfig()
    recorder: RecorderConfig = RecorderConfig()
    bus: BusConfig = BusConfig()
    scene: SceneConfig = SceneConfig()
    task: TaskConfig | None = None
    """Task by which runs are graded."""
    classroom: ClassroomConfig | None = None
    """Owners of the rigs."""
    impairment: ImpairmentConfig = ImpairmentConfig()
    rigs: Annotated[
        tuple[RigSettings, ...], BeforeValidator(_expand_group), TableForm(RigsTable), Field(min_length=1)
    ] = (RigSettings(),)
    _source: str = PrivateAttr("")
    _path: Path | None = PrivateAttr(None)

    @property
    def source(self) -> str:
        """Text of the file; empty: the defaults, or a configuration made by a program."""
        return self._source

    @property
    def path(self) -> Path | None:
        """The file; None: the defaults, or a configuration made by a program."""
        return self._path

    def read_again(self) -> "LabConfig":
        """Return the present content of the file.

        Raises:
            InputError: as `load_lab`, or the configuration is not from a file.
        """
        if self._path is None:
            raise InputError("this lab has no lab.toml that could be read again")
        return load_lab(self._path)

    @model_validator(mode="after")
    def _rigs_are_distinct(self) -> "LabConfig":
        check_distinct("rig name", (rig.name for rig in self.rigs))
        hosts = {rig.name: self.host_of(rig) for rig in self.rigs}
        all_ports = [*self.ports.items(), *self.tls_ports.items()]
        addresses = Counter((hosts[rig], port) for rig, port in all_ports)
        ports = Counter(port for _, port in all_ports)
        everywhere = {port for rig, port in all_ports if hosts[rig] in WILDCARDS}
        for rig, port in all_ports:
            if addresses[hosts[rig], port] > 1 or (port in everywhere and ports[port] > 1):
                raise ValueError(f"rig {rig!r}: port {port} is already used by another rig at the same address")
            if port > 65535:
                raise ValueError(f"rig {rig!r}: no port available from {self.edge.first_port} to 65535")
        return self

    @model_validator(mode="after")
    def _controllers_are_distinct(self) -> "LabConfig":
        served = {*self.ports.values(), *self.tls_ports.values()}
        rig_of: dict[tuple[str, int], str] = {}
        for rig in self.rigs:
            if rig.controller is None:
                continue
            host, port = parse_controller(rig.controller)
            name = "localhost" if host in _LOOPBACK else host.lower()
            other = rig_of.setdefault((name, port), rig.name)
            if other != rig.name:
                raise ValueError(
                    f"rigs {other!r} and {rig.name!r}: both are clients of the controller {rig.controller}; a "
                    "controller has one rig"
                )
            if port in served and host in {*_LOOPBACK, *map(self.host_of, self.rigs)}:
                raise ValueError(
                    f"rig {rig.name!r}: its controller {rig.controller} is the address of a rig of this lab"
                )
            lead_ms = rig.client.read_lead_ms
            if lead_ms is not None and lead_ms >= self.sim.step_ms:
                raise ValueError(
                    f"rig {rig.name!r}: client.read_lead_ms must be < sim.step_ms ({self.sim.step_ms:g}), got "
                    f"{lead_ms:g}"
                )
        return self

    @model_validator(mode="after")
    def _edges_and_clients_have_rigs(self) -> "LabConfig":
        edges = {} if self.bus.tls is None else self.bus.tls.edges
        names = {rig.name for rig in self.rigs}
        mistakes = [
            f"bus.tls.edges.{edge}: {self.no_such_rig(rig)}"
            for edge, rigs in edges.items()
            for rig in rigs
            if rig not in names
        ]
        if self.edge.tls is not None:
            mistakes += self.edge.tls.mistakes_in_clients(names)
        if mistakes:
            raise ValueError("\n".join(first_errors(mistakes)))
        return self

    @property
    def ports(self) -> dict[str, int]:
        """Modbus port of each rig: its own, or the next port from `edge.first_port` on that no rig names."""
        named = {rig.port for rig in self.rigs if rig.port is not None}
        ports: dict[str, int] = {}
        candidate = self.edge.first_port
        for rig in self.rigs:
            if rig.port is not None:
                ports[rig.name] = rig.port
                continue
            while candidate in named:
                candidate += 1
            ports[rig.name] = candidate
            candidate += 1
        return ports

    @property
    def tls_ports(self) -> dict[str, int]:
        """Modbus/TCP Security port of each rig, from `edge.tls.first_port` on; empty without TLS."""
        tls = self.edge.tls
        return {} if tls is None else {rig.name: tls.first_port + index for index, rig in enumerate(self.rigs)}

    def host_of(self, rig: RigSettings) -> str:
        """Return the address on which a rig listens: its own, or the edge's."""
        return self.edge.host if rig.host is None else rig.host

    def addresses(self) -> dict[str, dict[str, tuple[str, int]]]:
        """Return the addresses of each rig on which `edge` listens: kind of connection → host, port."""
        kinds = {"Modbus TCP": self.ports if self.edge.plain else {}, "Modbus TCP with TLS": self.tls_ports}
        return {
            rig.name: {kind: (self.host_of(rig), ports[rig.name]) for kind, ports in kinds.items() if ports}
            for rig in self.rigs
        }

    def scene_of(self, rig: RigSettings) -> SceneConfig:
        """Return the scene of a rig: its own, or the lab's."""
        return self.scene if rig.scene is None else rig.scene

    def impairment_of(self, rig: RigSettings) -> ImpairmentConfig:
        """Return the impairment of a rig's loop: its own, or the lab's."""
        return self.impairment if rig.impairment is None else rig.impairment

    def rig(self, name: str) -> RigSettings:
        """Return the rig of that name.

        Raises:
            InputError: the lab has no such rig.
        """
        for rig in self.rigs:
            if rig.name == name:
                return rig
        raise self.no_such_rig(name)

    def no_such_rig(self, name: str, added: Iterable[str] = ()) -> InputError:
        """Return the error for an unknown rig; `added` are running rigs that are not in the file."""
        names = list(dict.fromkeys([*(rig.name for rig in self.rigs), *added]))
        hint = " (hilrig rig list)" if len(names) > MAX_NAMES_IN_MESSAGE else ""
        return InputError(f"unknown rig {name!r}; this lab has {list_names(names, MAX_NAMES_IN_MESSAGE)}{hint}")


def read_rig(settings_json: str) -> RigSettings:
    """Parse one rig's settings, JSON, as exchanged between services.

    Raises:
        InputError: the settings are invalid; names every error.
    """
    try:
        return RigSettings.model_validate_json(settings_json)
    except ValidationError as error:
        raise InputError("; ".join(format_validation_error(error))) from error


def load_lab(path: Path | None) -> LabConfig:
    """Load a lab's file; without a path, return the defaults.

    Raises:
        InputError: the file can't be read, or is not a valid lab configuration; names every error.
    """
    if path is None:
        return LabConfig()
    lab = parse_lab(read_text(path), str(path))
    lab._path = path
    return lab


def parse_lab(text: str, where: str = "lab.toml") -> LabConfig:
    """Parse the text of a lab's file; `where` is its name in messages.

    Raises:
        InputError: as `load_lab`.
    """
    lab = validate(LabConfig, parse_toml(text, where), where)
    lab._source = text
    return lab
