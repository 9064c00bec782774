"""The one registry of topics: key on the bus, message type, kind of traffic, channel in a recording.

No key string stands anywhere else. A key is `hil/<lab>/<rig>/<name>` for what concerns a rig and
`hil/<lab>/<name>/<service>/<instance>` for what concerns a service; their names, as `log` and
`health`, are therefore no names for a rig. Nor are the services' own: an event that concerns one of
them as a whole stands in the rig's place.
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
"""What a lab, a rig and an instance may be called: it is a part of a key and of a file name."""


class Traffic(Enum):
    """How a topic travels: what may be lost, and what must not wait."""

    CONTROL = "control"
    """Early rather than complete: newest value wins, dropped rather than queued, highest priority."""
    RECORDING = "recording"
    """Complete rather than early: cached by its publisher, recovered by its subscriber."""
    REPORT = "report"
    """For people: lowest priority, dropped under load."""
    QUERY = "query"
    """Asked for, not published."""


@dataclass(frozen=True, slots=True)
class Topic(Generic[MessageT]):
    """What is known of one topic; `MessageT` is the protobuf type of its messages."""

    name: str
    message: type[MessageT]
    traffic: Traffic
    channel: str | None = None
    """Channel of a recording that holds it; None: not recorded."""

    def decode(self, payload: bytes) -> MessageT:
        """Decode one message.

        Raises:
            google.protobuf.message.DecodeError: the bytes are no such message.
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
"""What a person asks of a service: sessions by hand of the recorder, rigs more or fewer of simulation and edge."""
SERVICE_INFO: Final = ServiceTopic("service_info", ServiceInfo, Traffic.QUERY)
"""Who runs, where, and for which rigs."""
STATES: Final = ServiceTopic("states", RigBatch, Traffic.CONTROL)
"""The states of a tick together, for the edges; a watcher of one rig takes that rig's `STATE`."""
COMMANDS: Final = ServiceTopic("commands", RigBatch, Traffic.CONTROL)
"""Commands as they leave an edge, for the simulation; a watcher of one rig takes that rig's `COMMAND`."""

RIG_TOPICS: Final[tuple[RigTopic[Message], ...]] = (STATE, COMMAND, EVENT, TRAFFIC, CONFIG, LEASE, IMPAIRMENT)  # type: ignore[assignment]
SERVICE_TOPICS: Final[tuple[ServiceTopic[Message], ...]] = (LOG, HEALTH, CONTROL, SERVICE_INFO, STATES, COMMANDS)  # type: ignore[assignment]
RECORDED: Final[dict[str, RigTopic[Message]]] = {topic.name: topic for topic in RIG_TOPICS if topic.channel}

ALIVE: Final = "alive"
RESERVED_RIG_NAMES: Final = frozenset({topic.name for topic in SERVICE_TOPICS} | {ALIVE})
"""What stands in a rig's place in the keys of services."""
SERVICES: Final = ("sim", "edge", "recorder")
"""What a lab is made of; see `Service.emit` for the keys that have one in a rig's place."""


def alive_key(lab: str, service: str, instance: str) -> str:
    """Key of a service's liveliness token; `service` and `instance` may be `*`."""
    return f"{ROOT}/{lab}/{ALIVE}/{service}/{instance}"


def source_of_alive_key(key: str) -> str:
    """Whose liveliness token it is, "<service>/<instance>"."""
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
    """Take a rig topic's key apart.

    Raises:
        ValueError: it is no key of a rig topic.
    """
    parts = key.split("/")
    if len(parts) == 4 and parts[0] == ROOT and parts[3] in _RIG_TOPIC_BY_NAME and parts[2] not in RESERVED_RIG_NAMES:
        return RigKey(parts[1], parts[2], _RIG_TOPIC_BY_NAME[parts[3]])
    names = ", ".join(_RIG_TOPIC_BY_NAME)
    raise ValueError(f"{key!r} is no key of a rig: expected {ROOT}/<lab>/<rig>/<one of {names}>")


def is_name(text: str) -> bool:
    """Whether a lab, a rig or an instance may be called so."""
    return _NAME.fullmatch(text) is not None
