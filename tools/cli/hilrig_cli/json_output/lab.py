"""Outputs of the commands for a lab: its file, its services and rigs, certificates, registers."""

from typing import Literal

from pydantic import Field

from hilrig_cli.doctor import CheckResult
from hilrig_cli.json_output.model import JsonOutput, Values
from hilrig_runtime.config.bus import BusConfig
from hilrig_runtime.config.classroom import ClassroomConfig
from hilrig_runtime.config.impairment import ImpairmentConfig, LinkImpairments
from hilrig_runtime.config.lab import EdgeConfig, RecorderConfig, RigSettings, SimConfig
from hilrig_runtime.config.scene import SceneConfig
from hilrig_runtime.config.task import TaskConfig


class TopService(Values):
    """Status of a service."""

    service: str
    """sim, edge or recorder."""
    instance: str
    host: str
    software_version: str
    silent: bool
    """Whether its health reports are overdue."""
    uptime_s: float
    rigs: int
    """Number of its rigs."""
    cpu_percent: float
    memory_mib: float
    lateness_p50_ms: float
    """Lateness of its ticks, median; of the simulation and the edge."""
    lateness_p99_ms: float
    overruns: int
    """Ticks that began more than a step late."""
    missed_steps: int
    lost_transport: int
    """Messages lost in transport to the recorder."""
    lost_recorder: int
    """Messages lost in the recorder."""
    queue_depth: int
    """Batches that wait in the recorder."""
    connections: int
    """Modbus connections of the edge."""
    recordings: int
    """Sessions that are being recorded."""
    clock_offset_ms: float
    """Offset of its wall clock from that of `clock_peer`."""
    clock_uncertainty_ms: float
    clock_peer: str
    """Service that the clock is compared with; empty: none."""
    alert: str
    """Condition that needs attention; empty: none."""


class ExceptionCount(Values):
    """Modbus exceptions that the edge sent to one host."""

    host: str
    function: int
    """Function code of the request."""
    code: int
    """Exception code of the response."""
    count: int


class TopRig(Values):
    """Status of a rig."""

    rig: str
    state: str
    """Its most important state, a short text."""
    simulated: bool
    """Whether a simulation has the rig."""
    served: bool
    """Whether an edge has the rig."""
    student: str = ""
    """Id of the student who owns the rig; empty: none."""
    controller: str
    """Lease holder; empty: none."""
    session: str
    connections: int
    """Modbus connections to the rig."""
    recording: bool
    watchdog_tripped: bool
    safe: bool
    """Whether the effort is zero because there is no recent command."""
    loop_p50_ms: float | None
    """Loop latency, median of the last samples; null: no sample."""
    loop_p99_ms: float | None
    loop_samples: int
    age_p50_ms: float | None
    """Age of the acting torque's basis, median of the last steps; null: no age."""
    age_p99_ms: float | None
    lateness_p99_ms: float
    """Lateness of the simulation's ticks."""
    overruns: int
    exceptions: list[ExceptionCount]


class TopOutput(JsonOutput):
    """Status of a running lab."""

    schema_id: Literal["hilrig.top/1"] = Field(default="hilrig.top/1", alias="schema")
    lab: str
    services: list[TopService]
    rigs: list[TopRig]
    alerts: list[str]
    """Conditions that need attention, one sentence each."""


class RigListOutput(JsonOutput):
    """A rig of a running lab."""

    schema_id: Literal["hilrig.rig-list/1"] = Field(default="hilrig.rig-list/1", alias="schema")
    rig: str
    in_file: bool
    """Whether it is in lab.toml; else it was added at run time."""
    address: str
    """Modbus address, HOST:PORT; empty: no service has the rig."""
    sim: str
    """Its simulation, as "1 on host"; empty: none."""
    edge: str
    """Its edge, as "1 on host"; empty: none."""


class RigCodesOutput(JsonOutput):
    """Codes of a lab slot."""

    schema_id: Literal["hilrig.rig-codes/1"] = Field(default="hilrig.rig-codes/1", alias="schema")
    until: str
    """End of the lab slot, ISO 8601."""
    codes: dict[str, str]
    """Code of each student, by id."""


class LeaseOutput(JsonOutput):
    """Lease of a rig."""

    schema_id: Literal["hilrig.lease/1"] = Field(default="hilrig.lease/1", alias="schema")
    rig: str
    holder: str
    """Controller that holds the lease; empty: none."""
    released: str
    """Former holder whose lease this command revoked; empty: none."""
    silent_s: float
    """Time since the last request of the holder."""
    session: str
    connections: int
    watchdog_tripped: bool
    watchdog_timeout_ms: float
    """0: the watchdog is off."""
    client_of: str
    """Address of the controller whose client the edge is; empty: the edge is a server."""
    controller_fault: str
    """Reason why the edge can't exchange values with that controller; empty: none."""
    skipped_states: int
    """States that the edge did not write to that controller, because the previous cycle took longer than a step."""
    student: str = ""
    """Id of the student who owns the rig; empty: none."""
    claimed_from: str = ""
    """Host or certificate with which the student claimed the rig; empty: not claimed."""
    claim_ended: str = ""
    """Student whose claim this command ended; empty: none."""


class LinkCounters(Values):
    """Messages of an emulated link."""

    count: int
    lost: int
    overtaken: int
    """Discarded, because a newer message arrived earlier."""


class ImpairOutput(JsonOutput):
    """Network impairment of a rig."""

    schema_id: Literal["hilrig.impair/1"] = Field(default="hilrig.impair/1", alias="schema")
    rig: str
    impairment: str
    """The impairment in words."""
    ways: LinkImpairments
    """Delay and loss of both links, as in `[impairment]` of lab.toml."""
    seed: int
    set_by: str
    """Origin of the setting: lab.toml, schedule or override."""
    states: LinkCounters
    commands: LinkCounters


class RecordOutput(JsonOutput):
    """Manual recording of a rig."""

    schema_id: Literal["hilrig.record/1"] = Field(default="hilrig.record/1", alias="schema")
    rig: str
    session: str
    """Id of the session, the name of its file."""


class DoctorOutput(JsonOutput):
    """Result of all checks."""

    schema_id: Literal["hilrig.doctor/1"] = Field(default="hilrig.doctor/1", alias="schema")
    lab: str
    well: bool
    """Whether no check has the level error."""
    findings: list[CheckResult]


class CheckOutput(JsonOutput):
    """Configuration of a lab with all defaults, keys as in lab.toml, and its ports."""

    schema_id: Literal["hilrig.check/1"] = Field(default="hilrig.check/1", alias="schema")
    name: str
    realtime: bool
    sim: SimConfig
    edge: EdgeConfig
    recorder: RecorderConfig
    bus: BusConfig
    scene: SceneConfig
    task: TaskConfig | None
    classroom: ClassroomConfig | None
    impairment: ImpairmentConfig
    rigs: tuple[RigSettings, ...]
    ports: dict[str, int]
    """Modbus TCP port of each rig."""
    tls_ports: dict[str, int]
    """Modbus/TCP Security port of each rig."""
    warnings: list[str]
    """Settings that make the simulation inaccurate, one sentence each."""


class EdgeTlsFiles(Values):
    """Table `[edge.tls]` of lab.toml."""

    certificate: str
    key: str
    authority: str


class BusTlsFolder(Values):
    """Table `[bus.tls]` of lab.toml."""

    folder: str


class CertsOutput(JsonOutput):
    """Certificates that were created."""

    schema_id: Literal["hilrig.certs/1"] = Field(default="hilrig.certs/1", alias="schema")
    written: list[str]
    """Paths of the files that were written."""
    edge_tls: EdgeTlsFiles = Field(alias="edge.tls")
    bus_tls: BusTlsFolder = Field(alias="bus.tls")


class RevokeOutput(JsonOutput):
    """Revocation of a certificate."""

    schema_id: Literal["hilrig.certs-revoke/1"] = Field(default="hilrig.certs-revoke/1", alias="schema")
    revoked: str
    """Name in the certificate."""
    edges: dict[str, str]
    """Reply of each edge."""


class ClaimOutput(JsonOutput):
    """Claim of a rig."""

    schema_id: Literal["hilrig.claim/1"] = Field(default="hilrig.claim/1", alias="schema")
    rig: str
    """Address of the rig."""
    claimed: bool
    reason: str
    """Reason why the code was refused; empty: it was not."""


class EventsOutput(JsonOutput):
    """An event."""

    schema_id: Literal["hilrig.events/1"] = Field(default="hilrig.events/1", alias="schema")
    time: float
    """Wall clock of its source, s since 1970-01-01 UTC."""
    rig: str
    """Empty: an event of the service."""
    source: str
    """Service that emitted it, as edge/1."""
    kind: str
    """Kind in lower case with hyphens, as watchdog-trip; the number of a kind of a later version."""
    severity: str
    """info, warning or error."""
    session: str
    step: int
    """Step of the simulation; 0: unknown."""
    text: str


class RegistersOutput(JsonOutput):
    """A register or coil of a rig."""

    schema_id: Literal["hilrig.registers/1"] = Field(default="hilrig.registers/1", alias="schema")
    table: str
    """holding register, coil, input register or discrete input."""
    number: int
    """Number in its table, from 1."""
    address: int
    """Address in a request, from 0."""
    classic: str
    """Number as PLC tools write it, as 40001."""
    name: str
    type: str
    words: int
    """Number of registers of the value."""
    unit: str
    scale: int
    """The register contains the value times the scale."""
    writable: bool
    """Whether the controller writes it; else the rig."""
    text: str
    """Description."""


class IkOutput(JsonOutput):
    """Solutions of the inverse kinematics."""

    schema_id: Literal["hilrig.ik/1"] = Field(default="hilrig.ik/1", alias="schema")
    joints_deg_deg_mm_deg: list[tuple[float, float, float, float]]
    """θ1, θ2, d3, θ4 of each solution; °, °, mm, °."""
    reason: str | None
    """Reason why there is no solution; null: there is one."""
