"""Fake recording streams for tests of the recorder; sent messages are kept for comparison with the recording."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TypeVar

from google.protobuf.message import Message

from hilrig_runtime.messaging.recording_stream import put_entries
from hilrig_schemas import Event, JointState, LogBatch, OpenSession, TorqueCommand
from hilrig_schemas.topics import COMMAND, EVENT, STATE, RigTopic

MS = 1_000_000
SECOND = 1_000_000_000
LAB = "lab"
MessageT = TypeVar("MessageT", bound=Message)


@dataclass
class Sent:
    """One message of a stream."""

    key: str
    sequence: int
    publish_ns: int
    payload: bytes


@dataclass
class FakeSource:
    """Builds the batches of one incarnation of a service; nothing is published, `batch` returns the batch."""

    name: str = "sim/1"
    incarnation: int = 1
    lab: str = LAB
    sequence: int = 0
    sent: list[Sent] = field(default_factory=list)
    _pending: list[Sent] = field(default_factory=list)
    _sequences: dict[str, int] = field(default_factory=dict)

    def put(self, topic: RigTopic[MessageT], rig: str, message: MessageT, publish_ns: int) -> Sent:
        """Add a message to the next batch."""
        key = topic.key(self.lab, rig)
        number = self._sequences[key] = self._sequences.get(key, 0) + 1
        sent = Sent(key, number, publish_ns, message.SerializeToString())
        self._pending.append(sent)
        self.sent.append(sent)
        return sent

    def state(self, rig: str, publish_ns: int, session: str = "") -> Sent:
        """Add a state."""
        step = self._sequences.get(STATE.key(self.lab, rig), 0) + 1
        state = JointState(rig=rig, session=session, incarnation=self.incarnation, step=step, wall_ns=publish_ns)
        state.position.extend([0.1 * step, 0.2, 0.03, 0.4])
        return self.put(STATE, rig, state, publish_ns)

    def command(self, rig: str, publish_ns: int, session: str = "") -> Sent:
        """Add a command."""
        command = TorqueCommand(rig=rig, session=session, seq=len(self.sent), effort=[0.1, 0.2, 0.3, 0.4])
        return self.put(COMMAND, rig, command, publish_ns)

    def start(self, rig: str, session: str, publish_ns: int, controller: str = "192.0.2.7:40001") -> Sent:
        """Add the event that starts a session."""
        event = Event(rig=rig, session=session, kind=Event.SESSION_START, wall_ns=publish_ns, source=self.name)
        event.session_data.controller = controller
        return self.put(EVENT, rig, event, publish_ns)

    def end(
        self, rig: str, session: str, publish_ns: int, reason: str = "the controller closed the connection"
    ) -> Sent:
        """Add the event that ends a session."""
        event = Event(rig=rig, session=session, kind=Event.SESSION_END, wall_ns=publish_ns, source=self.name)
        event.session_data.reason = reason
        return self.put(EVENT, rig, event, publish_ns)

    def batch(self, sessions: Sequence[OpenSession] | None = None) -> LogBatch:
        """A batch of the messages added since the last one; `sessions`, if given, is a complete announcement."""
        self.sequence += 1
        batch = self._batch()
        if sessions is not None:
            batch.sessions.extend(sessions)
            batch.complete_sessions = True
        return batch

    def events(self) -> LogBatch:
        """A batch of the events added since the last batch."""
        batch = self._batch()
        batch.events = True
        return batch

    def _batch(self) -> LogBatch:
        batch = LogBatch(source=self.name, incarnation=self.incarnation, sequence=self.sequence)
        put_entries(batch, [(sent.key, sent.sequence, sent.publish_ns, sent.payload) for sent in self._pending])
        self._pending.clear()
        return batch
