"""The registry of topics: key on the bus, message type, kind of traffic, channel in a recording.

It is the only place of key strings. A key is `hil/<lab>/<rig>/<name>` for a topic of a rig, and
`hil/<lab>/<name>/<service>/<instance>` for a topic of a service. Names of service topics, as `log` and `health`, are
therefore reserved and not valid for a rig. The names of services are reserved too, because an event of a service has
its name in place of the rig.
"""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum
from typing import Any, Final, Generic, TypeVar

from google.protobuf.message import DecodeError, Message

from hilrig_schemas import (
    ControlReply,
    ControlRequest,
    Event,
    Health,
    ImpairmentRequest,
    ImpairmentStatus,
    JointState,
    LeaseRequest,
    LeaseStatus,
    LogBatch,
    ModbusTraffic,
    RigBatch,
    RigConfig,
    ServiceInfo,
    TorqueCommand,
)
from hilrig_schemas.bounds import check_bounds

MessageT = TypeVar("MessageT", bound=Message)

ROOT: Final = "hil"
NAME_PATTERN: Final = r"[A-Za-z0-9][A-Za-z0-9_-]{0,62}"
"""Valid names of labs, rigs and instances, which are parts of keys and of file names."""


class Traffic(Enum):
    """Kind of traffic of a topic: delivery guarantee and priority."""

    CONTROL = "control"
    """Low latency before completeness: the newest value wins, messages are dropped, not queued; highest priority."""
    RECORDING = "recording"
    """Completeness before low latency: cached by the publisher, recovered by the subscriber."""
    REPORT = "report"
    """Reports: lowest priority, dropped under load."""
    QUERY = "query"
    """Queried, not published."""


@dataclass(frozen=True, slots=True)
class Topic(Generic[MessageT]):
    """A topic; `MessageT` is the protobuf type of its messages."""

    name: str
    message: type[MessageT]
    traffic: Traffic
    channel: str | None = None
    """Channel in a recording; None: not recorded."""
    request: type[Message] | None = None
    """Type of the queries that `message` replies to; None: published, or queried without a payload."""

    def decode(self, payload: bytes) -> MessageT:
        """Decode one message.

        Raises:
            google.protobuf.message.DecodeError: the payload is not a valid message of this type, or a value is out of
                its bounds.
        """
        message = self.message.FromString(payload)
        check_bounds(message)
        return message


@dataclass(frozen=True, slots=True)
class RigTopic(Topic[MessageT]):
    """A topic with one key per rig."""

    def key(self, lab: str, rig: str) -> str:
        """Return the key of a rig; `rig` may be `*` for all rigs of the lab."""
        return f"{ROOT}/{lab}/{rig}/{self.name}"

    def decode_from(self, key: str, payload: bytes) -> MessageT:
        """Decode a message that was received on `key`, which identifies its rig.

        Raises:
            google.protobuf.message.DecodeError: as `decode`, or the message is of another rig than its key.
        """
        message: Any = self.decode(payload)
        rig = key.split("/")[2]
        # An event of a service has its name in place of the rig.
        if message.rig != ("" if rig in SERVICES else rig):
            raise DecodeError(f"message of rig {message.rig!r}")
        return message  # type: ignore[no-any-return]


@dataclass(frozen=True, slots=True)
class ServiceTopic(Topic[MessageT]):
    """A topic with one key per running service."""

    def key(self, lab: str, service: str, instance: str) -> str:
        """Return the key of a service; `service` and `instance` may be `*` for all."""
        return f"{ROOT}/{lab}/{self.name}/{service}/{instance}"

    def decode_from(self, key: str, payload: bytes) -> MessageT:
        """Decode a message that was received on `key`, which identifies its service.

        Raises:
            google.protobuf.message.DecodeError: as `decode`, or the message is of another service than its key.
        """
        message: Any = self.decode(payload)
        source = f"{message.service}/{message.instance}"
        if source != source_of_key(key):
            raise DecodeError(f"message of {source!r}")
        return message  # type: ignore[no-any-return]


STATE: Final = RigTopic("state", JointState, Traffic.CONTROL, channel="/state")
COMMAND: Final = RigTopic("command", TorqueCommand, Traffic.CONTROL, channel="/command")
EVENT: Final = RigTopic("event", Event, Traffic.REPORT, channel="/event")
TRAFFIC: Final = RigTopic("traffic", ModbusTraffic, Traffic.REPORT, channel="/traffic")
CONFIG: Final = RigTopic("config", RigConfig, Traffic.QUERY)
LEASE: Final = RigTopic("lease", LeaseStatus, Traffic.QUERY, request=LeaseRequest)
IMPAIRMENT: Final = RigTopic("impairment", ImpairmentStatus, Traffic.QUERY, request=ImpairmentRequest)
LOG: Final = ServiceTopic("log", LogBatch, Traffic.RECORDING)
HEALTH: Final = ServiceTopic("health", Health, Traffic.REPORT)
CONTROL: Final = ServiceTopic("control", ControlReply, Traffic.QUERY, request=ControlRequest)
"""Requests of an operator: manual sessions (recorder), adding and removing rigs (simulation and edge)."""
SERVICE_INFO: Final = ServiceTopic("service_info", ServiceInfo, Traffic.QUERY)
"""Identity, host and rigs of a running service."""
STATES: Final = ServiceTopic("states", RigBatch, Traffic.CONTROL)
"""The states of a tick in one batch for the edges; monitoring of one rig uses its `STATE`."""
COMMANDS: Final = ServiceTopic("commands", RigBatch, Traffic.CONTROL)
"""Commands of an edge in batches for the simulation; monitoring of one rig uses its `COMMAND`."""

RIG_TOPICS: Final[tuple[RigTopic[Message], ...]] = (STATE, COMMAND, EVENT, TRAFFIC, CONFIG, LEASE, IMPAIRMENT)  # type: ignore[assignment]
SERVICE_TOPICS: Final[tuple[ServiceTopic[Message], ...]] = (LOG, HEALTH, CONTROL, SERVICE_INFO, STATES, COMMANDS)  # type: ignore[assignment]
RECORDED: Final[dict[str, RigTopic[Message]]] = {topic.name: topic for topic in RIG_TOPICS if topic.channel}

ALIVE: Final = "alive"
RESERVED_RIG_NAMES: Final = frozenset({topic.name for topic in SERVICE_TOPICS} | {ALIVE})
"""Names in place of the rig in keys of services."""
SERVICES: Final = ("sim", "edge", "recorder")
"""The services of a lab in start order; keys of events have their names in place of the rig (`Service.emit`)."""


def alive_key(lab: str, service: str, instance: str) -> str:
    """Return the key of a service's liveliness token; `service` and `instance` may be `*`."""
    return f"{ROOT}/{lab}/{ALIVE}/{service}/{instance}"


def source_of_key(key: str) -> str:
    """Return the service of the key of a service topic or liveliness token, "<service>/<instance>"."""
    return "/".join(key.rsplit("/", 2)[1:])


def all_topics() -> Iterator[Topic[Message]]:
    """Yield every topic of the registry."""
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
    """Parse the key of a rig topic.

    Raises:
        ValueError: not a key of a rig topic.
    """
    parts = key.split("/")
    if len(parts) == 4 and parts[0] == ROOT and parts[3] in _RIG_TOPIC_BY_NAME and parts[2] not in RESERVED_RIG_NAMES:
        return RigKey(parts[1], parts[2], _RIG_TOPIC_BY_NAME[parts[3]])
    names = ", ".join(_RIG_TOPIC_BY_NAME)
    raise ValueError(f"invalid key of a rig topic: must be {ROOT}/<lab>/<rig>/<one of {names}>, got {key!r}")


def is_name(text: str) -> bool:
    """Return whether a text is a valid name of a lab, a rig or an instance."""
    return _NAME.fullmatch(text) is not None
