"""The one registry of topics: key on the bus, message type, kind of traffic, channel in a recording.

No other module contains key strings. A key is `hil/<lab>/<rig>/<name>` for the topics of a rig and
`hil/<lab>/<name>/<service>/<instance>` for those of a service. So names of service topics, such as `log` and `health`,
are not valid rig names, nor are the names of services: an event of a whole service has its name in place of a rig's.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from typing import Final, Generic, TypeVar

from google.protobuf.message import Message

from hilrig_schemas import (
    Event,
    Health,
    ImpairmentStatus,
    JointState,
    LeaseStatus,
    LogBatch,
    ModbusTraffic,
    RigBatch,
    RigConfig,
    ServiceInfo,
    TorqueCommand,
)

MessageT = TypeVar("MessageT", bound=Message)

ROOT: Final = "hil"
NAME_PATTERN: Final = r"[A-Za-z0-9][A-Za-z0-9_-]{0,62}"
"""Pattern of the names of labs, rigs and instances, which are parts of keys and file names."""


class Traffic(Enum):
    """Kind of traffic of a topic: its reliability and priority."""

    CONTROL = "control"
    """Early rather than complete: the newest value wins, dropped rather than queued, highest priority."""
    RECORDING = "recording"
    """Complete rather than early: cached by its publisher, recovered by its subscriber."""
    REPORT = "report"
    """Monitoring: lowest priority, dropped under load."""
    QUERY = "query"
    """Replies to queries, not published."""


@dataclass(frozen=True, slots=True)
class Topic(Generic[MessageT]):
    """One topic; `MessageT` is the protobuf type of its messages."""

    name: str
    message: type[MessageT]
    traffic: Traffic
    channel: str | None = None
    """Channel of a recording that holds it; None: not recorded."""

    def decode(self, payload: bytes) -> MessageT:
        """Decode one message.

        Raises:
            google.protobuf.message.DecodeError: the bytes are not a message of this type.
        """
        return self.message.FromString(payload)


@dataclass(frozen=True, slots=True)
class RigTopic(Topic[MessageT]):
    """A topic with one key a rig."""

    def key(self, lab: str, rig: str) -> str:
        """Key of one rig's topic; `rig` may be `*` to subscribe to every rig of the lab."""
        return f"{ROOT}/{lab}/{rig}/{self.name}"


@dataclass(frozen=True, slots=True)
class ServiceTopic(Topic[MessageT]):
    """A topic with one key a running service."""

    def key(self, lab: str, service: str, instance: str) -> str:
        """Key of one service's topic; `service` and `instance` may be `*` to subscribe to all."""
        return f"{ROOT}/{lab}/{self.name}/{service}/{instance}"


STATE: Final = RigTopic("state", JointState, Traffic.CONTROL, channel="/state")
COMMAND: Final = RigTopic("command", TorqueCommand, Traffic.CONTROL, channel="/command")
EVENT: Final = RigTopic("event", Event, Traffic.REPORT, channel="/event")
TRAFFIC: Final = RigTopic("traffic", ModbusTraffic, Traffic.REPORT, channel="/traffic")
CONFIG: Final = RigTopic("config", RigConfig, Traffic.QUERY)
LEASE: Final = RigTopic("lease", LeaseStatus, Traffic.QUERY)
IMPAIRMENT: Final = RigTopic("impairment", ImpairmentStatus, Traffic.QUERY)
LOG: Final = ServiceTopic("log", LogBatch, Traffic.RECORDING)
HEALTH: Final = ServiceTopic("health", Health, Traffic.REPORT)
CONTROL: Final = ServiceTopic("control", Event, Traffic.QUERY)
"""Requests to a service: manual sessions (recorder), adding and removing rigs (simulation and edge)."""
SERVICE_INFO: Final = ServiceTopic("service_info", ServiceInfo, Traffic.QUERY)
"""Identity, host and rigs of a running service."""
STATES: Final = ServiceTopic("states", RigBatch, Traffic.CONTROL)
"""The states of a tick in one batch, for the edges; observers of one rig subscribe to its `STATE`."""
COMMANDS: Final = ServiceTopic("commands", RigBatch, Traffic.CONTROL)
"""Commands of an edge in batches, for the simulation; observers of one rig subscribe to its `COMMAND`."""

RIG_TOPICS: Final[tuple[RigTopic[Message], ...]] = (STATE, COMMAND, EVENT, TRAFFIC, CONFIG, LEASE, IMPAIRMENT)  # type: ignore[assignment]
SERVICE_TOPICS: Final[tuple[ServiceTopic[Message], ...]] = (LOG, HEALTH, CONTROL, SERVICE_INFO, STATES, COMMANDS)  # type: ignore[assignment]
RECORDED: Final[dict[str, RigTopic[Message]]] = {topic.name: topic for topic in RIG_TOPICS if topic.channel}

ALIVE: Final = "alive"
RESERVED_RIG_NAMES: Final = frozenset({topic.name for topic in SERVICE_TOPICS} | {ALIVE})
"""Names in place of a rig's name in the keys of services."""
SERVICES: Final = ("sim", "edge", "recorder")
"""The services of a lab; see `Service.emit` for keys with a service in place of a rig."""


def alive_key(lab: str, service: str, instance: str) -> str:
    """Key of a service's liveliness token; `service` and `instance` may be `*`."""
    return f"{ROOT}/{lab}/{ALIVE}/{service}/{instance}"


def source_of_alive_key(key: str) -> str:
    """Source of a liveliness token, "<service>/<instance>"."""
    return "/".join(key.split("/")[-2:])


def all_topics() -> Iterator[Topic[Message]]:
    """Every topic of the registry."""
    yield from RIG_TOPICS
    yield from SERVICE_TOPICS


@dataclass(frozen=True, slots=True)
class RigKey:
    """The parts of a rig topic's key."""

    lab: str
    rig: str
    topic: RigTopic[Message]


_RIG_TOPIC_BY_NAME: Final = {topic.name: topic for topic in RIG_TOPICS}
_NAME: Final = re.compile(NAME_PATTERN)


def parse_rig_key(key: str) -> RigKey:
    """Split a rig topic's key into its parts.

    Raises:
        ValueError: the key is not a rig topic's.
    """
    parts = key.split("/")
    if len(parts) == 4 and parts[0] == ROOT and parts[3] in _RIG_TOPIC_BY_NAME and parts[2] not in RESERVED_RIG_NAMES:
        return RigKey(parts[1], parts[2], _RIG_TOPIC_BY_NAME[parts[3]])
    names = ", ".join(_RIG_TOPIC_BY_NAME)
    raise ValueError(f"{key!r} is not a rig key: expected {ROOT}/<lab>/<rig>/<one of {names}>")


def is_name(text: str) -> bool:
    """Whether `text` is a valid name of a lab, rig or instance."""
    return _NAME.fullmatch(text) is not None
