"""A lab's configuration: `lab.toml`, validated, every mistake named with its place.

This is the edge where people type, so it is pydantic, and units are those that people use where the name says so
(`step_ms`, `timeout_ms`); all else is SI. With no file there is one rig with the defaults below.
"""

import tomllib
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, PrivateAttr, ValidationError, model_validator

from hilrig_runtime.config.bus import BusConfig
from hilrig_runtime.config.impairment import ImpairmentConfig
from hilrig_runtime.config.scene import SceneConfig
from hilrig_runtime.config.task import TaskConfig
from hilrig_runtime.config.types import Flag, Name, Network, NotNegative, Number, Port, Positive, Section, Vector4
from hilrig_runtime.config.validation import format_validation_error
from hilrig_runtime.errors import InputError
from hilrig_schemas.topics import RESERVED_RIG_NAMES, SERVICES

MOST_RIGS = 10_000
"""More than any machine steps in real time; a mistyped count is found here."""
NAMED = 16
"""Rigs that a refusal names before it says "and … more"."""


class ArmConfig(Section):
    """The arm's parameters (docs/model.md); defaults are the paper's and the decisions made where it is silent."""

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
    """Where the arm is when the simulation starts or is reset; degrees, degrees, mm, degrees."""
    external_force_z_n: Number = 0.0
    """f_z, constant wrench of the environment on the tool, world z up, N."""
    external_torque_z_nm: Number = 0.0
    """n_z, the same about world z, N·m."""


class SimConfig(Section):
    """How the plant is stepped."""

    step_ms: Annotated[float, Field(strict=True, ge=0.5, le=1000)] = 20.0
    """Length of a step, ms."""
    substeps: Annotated[int, Field(strict=True, ge=1, le=100)] = 1
    """Integration steps in one step of the loop."""
    integrator: Literal["rkf45", "rk4", "euler"] = "rkf45"
    command_timeout_ms: NotNegative = 600.0
    """With no command for so long the effort goes to zero; 0: never."""

    @property
    def step_ns(self) -> int:
        """Length of a step, ns."""
        return round(self.step_ms * 1e6)

    @property
    def command_timeout_ns(self) -> int:
        """See `command_timeout_ms`, ns."""
        return round(self.command_timeout_ms * 1e6)


class TlsConfig(Section):
    """Modbus/TCP Security: each rig listens on a second port, with certificates on both sides (`hilrig certs`)."""

    certificate: Path
    """The edge's certificate with its chain, PEM."""
    key: Path
    """The certificate's private key, PEM."""
    authority: Path
    """Who signs the clients' certificates, PEM."""
    first_port: Port = 802
    """Port of the first rig; the others follow."""
    no_role: Literal["operator", "observer", "refuse"] = "observer"
    """What a client whose certificate names no role may do: write, read only, or nothing."""


class EdgeConfig(Section):
    """The Modbus side."""

    host: str = "127.0.0.1"
    """Address to listen on; 0.0.0.0 opens the rigs to the network."""
    first_port: Port = 5020
    """Port of the first rig; the others follow, unless a rig names its own."""
    watchdog_ms: Annotated[float, Field(strict=True, ge=0, le=65535)] = 1000.0
    """With the controller not writing for so long the torque goes to zero; 0: never."""
    watchdog_min_ms: Annotated[float, Field(strict=True, ge=1, le=65535)] = 100.0
    """The shortest time-out that a controller may set by register."""
    watchdog_max_ms: Annotated[float, Field(strict=True, ge=1, le=65535)] = 10_000.0
    """The longest."""
    lease_timeout_ms: Positive = 5000.0
    """A controller silent for so long loses the rig to whoever writes next."""
    session_grace_ms: NotNegative = 5000.0
    """A session goes on when its controller is back within so long."""
    repeat_ms: Positive = 200.0
    """How often the standing command is repeated to the simulation."""
    max_connections: Annotated[int, Field(strict=True, ge=1)] = 32
    """Connections that a rig takes."""
    max_connections_per_host: Annotated[int, Field(strict=True, ge=1)] = 16
    """Connections that a rig takes from one host."""
    idle_timeout_s: NotNegative = 60.0
    """A connection without a request for so long is closed; 0: never."""
    plain: Flag = True
    """Listen without TLS; false leaves the rigs to clients with a certificate."""
    tls: TlsConfig | None = None
    """Listen with TLS too."""

    @model_validator(mode="after")
    def _bounds_hold(self) -> "EdgeConfig":
        if self.watchdog_min_ms > self.watchdog_max_ms:
            raise ValueError(f"watchdog_min_ms {self.watchdog_min_ms:g} is above watchdog_max_ms")
        if not self.plain and self.tls is None:
            raise ValueError("plain is false and there is no [edge.tls]: nobody could connect")
        return self


class RecorderConfig(Section):
    """Where recordings go."""

    folder: Path = Path("recordings")
    """Recordings are `<folder>/<lab>/<rig>/<session>.mcap`."""
    preroll_s: NotNegative = 2.0
    """What a recording holds from before its session's start, s."""
    queue_entries: Annotated[int, Field(strict=True, ge=1)] = 500_000
    """Messages that may wait for the disk; more are dropped and counted. The default is 20 s of 500 rigs."""
    rotate_mib: Annotated[int, Field(strict=True, ge=0)] = 1024
    """A session goes on in a next file when its file is this large, MiB; 0: never."""
    rotate_min: NotNegative = 0.0
    """The same when it is this old, min; 0: never."""
    keep_days: NotNegative = 0.0
    """Recordings older than this are deleted, but never a rig's last, days; 0: none."""
    keep_gib: NotNegative = 0.0
    """The oldest are deleted when all are larger than this, but never a rig's last, GiB; 0: none."""
    min_free_mib: Annotated[int, Field(strict=True, ge=0)] = 64
    """With less space free on the disk recordings end, MiB."""


class RigSettings(Section):
    """One rig: what differs from the lab's defaults."""

    name: Name = "rig1"
    port: Port | None = None
    """Modbus TCP port; default: the next free one from `edge.first_port`."""
    allow: tuple[Network, ...] = ()
    """Networks whose hosts may connect, as "192.168.7.0/24"; none named: all."""
    arm: ArmConfig = ArmConfig()
    scene: SceneConfig | None = None
    """Its own scene; default: the lab's."""
    impairment: ImpairmentConfig | None = None
    """Its own impairment; default: the lab's."""

    @model_validator(mode="after")
    def _no_reserved_name(self) -> "RigSettings":
        if self.name in RESERVED_RIG_NAMES or self.name in SERVICES:
            raise ValueError(f"{self.name!r} is a reserved name: call the rig otherwise")
        return self


class RigsTable(Section):
    """A class of rigs that are alike, `[rigs]`, and single ones beside them, `[[rigs.single]]`."""

    count: Annotated[int, Field(strict=True, ge=1, le=MOST_RIGS)] = 1
    """How many there are; they are called <prefix>1, <prefix>2, …"""
    prefix: Name = "rig"
    allow: tuple[Network, ...] = ()
    """As of a single rig, for all of them."""
    arm: ArmConfig = ArmConfig()
    scene: SceneConfig | None = None
    single: tuple[RigSettings, ...] = ()
    """Rigs of their own; one that is called like one of the class takes its place."""

    def rigs(self) -> tuple[RigSettings, ...]:
        """All of them: the class in order, then those that are no part of it."""
        own = {rig.name: rig for rig in self.single}
        names = [f"{self.prefix}{number}" for number in range(1, self.count + 1)]
        alike = RigSettings(allow=self.allow, arm=self.arm, scene=self.scene)
        members = [own.get(name) or alike.model_copy(update={"name": name}) for name in names]
        return (*members, *(rig for rig in self.single if rig.name not in set(names)))

    @model_validator(mode="after")
    def _names_hold(self) -> "RigsTable":
        for name, times in Counter(rig.name for rig in self.single).items():
            if times > 1:
                raise ValueError(f"two rigs are called {name!r}: names must be distinct")
        return self


def _listed(rigs: Any) -> Any:
    return RigsTable.model_validate(rigs).rigs() if isinstance(rigs, dict) else rigs


class LabConfig(Section):
    """A whole lab, as `lab.toml` describes it."""

    name: Name = "lab"
    realtime: Flag = True
    """Let simulation and edge go before all ordinary programs, where the system grants it (docs/operations.md)."""
    sim: SimConfig = SimConfig()
    edge: EdgeConfig = EdgeConfig()
    recorder: RecorderConfig = RecorderConfig()
    bus: BusConfig = BusConfig()
    scene: SceneConfig = SceneConfig()
    task: TaskConfig | None = None
    """What its runs are graded by."""
    impairment: ImpairmentConfig = ImpairmentConfig()
    rigs: Annotated[tuple[RigSettings, ...], BeforeValidator(_listed), Field(min_length=1)] = (RigSettings(),)
    _source: str = PrivateAttr("")

    @property
    def source(self) -> str:
        """The text that it was read from; empty: these are defaults, or it was made by a program."""
        return self._source

    @model_validator(mode="after")
    def _rigs_are_distinct(self) -> "LabConfig":
        for name, times in Counter(rig.name for rig in self.rigs).items():
            if times > 1:
                raise ValueError(f"two rigs are called {name!r}: names must be distinct")
        all_ports = [*self.ports.items(), *self.tls_ports.items()]
        ports = Counter(port for _, port in all_ports)
        for rig, port in all_ports:
            if ports[port] > 1:
                raise ValueError(f"rig {rig!r}: port {port} is taken by another rig: ports must be distinct")
            if port > 65535:
                raise ValueError(f"rig {rig!r}: no port is left for it above {self.edge.first_port}")
        return self

    @model_validator(mode="after")
    def _edges_command_rigs(self) -> "LabConfig":
        edges = {} if self.bus.tls is None else self.bus.tls.edges
        names = {rig.name for rig in self.rigs}
        for edge, rigs in edges.items():
            for rig in rigs:
                if rig not in names:
                    raise ValueError(f"bus.tls.edges.{edge}: {self.no_such_rig(rig)}")
        return self

    @property
    def ports(self) -> dict[str, int]:
        """Modbus port of each rig: its own, or the next that nobody names from `edge.first_port` on."""
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
        """Modbus/TCP Security port of each rig, from `edge.tls.first_port` on; none without TLS."""
        tls = self.edge.tls
        return {} if tls is None else {rig.name: tls.first_port + index for index, rig in enumerate(self.rigs)}

    def addresses(self) -> dict[str, dict[str, str]]:
        """Where each rig's controllers connect: kind of connection to "host:port", those that `edge` listens on."""
        kinds = {"Modbus TCP": self.ports if self.edge.plain else {}, "Modbus TCP with TLS": self.tls_ports}
        return {
            rig.name: {kind: f"{self.edge.host}:{ports[rig.name]}" for kind, ports in kinds.items() if ports}
            for rig in self.rigs
        }

    def scene_of(self, rig: RigSettings) -> SceneConfig:
        """The scene around a rig: its own, or the lab's."""
        return self.scene if rig.scene is None else rig.scene

    def impairment_of(self, rig: RigSettings) -> ImpairmentConfig:
        """What is done to a rig's loop on purpose: its own, or the lab's."""
        return self.impairment if rig.impairment is None else rig.impairment

    def rig(self, name: str) -> RigSettings:
        """The rig of that name.

        Raises:
            InputError: there is none.
        """
        for rig in self.rigs:
            if rig.name == name:
                return rig
        raise self.no_such_rig(name)

    def no_such_rig(self, name: str, added: Iterable[str] = ()) -> InputError:
        """What to say where no rig has that name; `added` are rigs beside those of the file."""
        names = list(dict.fromkeys([*(rig.name for rig in self.rigs), *added]))
        more = f" and {len(names) - NAMED} more (hilrig rig list)" if len(names) > NAMED else ""
        return InputError(f"no rig is called {name!r}; this lab has {', '.join(names[:NAMED])}{more}")


def read_rig(settings_json: str) -> RigSettings:
    """One rig's settings as they travel between services, JSON.

    Raises:
        InputError: they say something that is no rig; every mistake is named.
    """
    try:
        return RigSettings.model_validate_json(settings_json)
    except ValidationError as error:
        raise InputError("; ".join(format_validation_error(error))) from error


def load_lab(path: Path | None) -> LabConfig:
    """Read a lab's file, or give the defaults where there is none.

    Raises:
        InputError: the file can't be read, is no TOML, or says something that is no lab; every mistake is named.
    """
    return LabConfig() if path is None else parse_lab(read_lab_text(path), str(path))


def read_lab_text(path: Path) -> str:
    """The text of a lab's file.

    Raises:
        InputError: it can't be read.
    """
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise InputError(f"{path}: can't be read: {reason}") from error


def parse_lab(text: str, where: str = "lab.toml") -> LabConfig:
    """Understand the text of a lab's file; `where` names it in messages.

    Raises:
        InputError: as `load_lab`.
    """
    try:
        lab = LabConfig.model_validate(tomllib.loads(text))
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{where}: no valid TOML: {error}") from error
    except ValidationError as error:
        raise InputError("\n".join(f"{where}: {mistake}" for mistake in format_validation_error(error))) from error
    lab._source = text
    return lab
