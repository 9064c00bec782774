"""Sends the commands of one rig: to the simulation, on the rig's own key, and into the recording.

The last command is held and repeated with its number, so that the simulation can tell a held torque from a lost edge.
"""

from hilrig_modbus_edge.command_scheduler import CommandScheduler
from hilrig_runtime.messaging.publisher import RigPublisher
from hilrig_runtime.timing.clock import Clock
from hilrig_schemas import TorqueCommand


class CommandSender:
    """Sends, records, holds and repeats the commands of one rig."""

    def __init__(
        self,
        rig: str,
        scheduler: CommandScheduler,
        publisher: RigPublisher[TorqueCommand],
        clock: Clock,
        repeat_ns: int,
    ) -> None:
        self._rig = rig
        self._scheduler = scheduler
        self._publisher = publisher
        self._monotonic_ns = clock.monotonic_ns
        self._wall_ns = clock.wall_ns
        self._repeat_ns = repeat_ns
        self._repeat_due_ns = clock.monotonic_ns()
        self._held = b""
        """The last command, encoded; empty: none."""

    def send(self, command: TorqueCommand) -> None:
        """Set the timestamps of a new command, send and record it; the message object may be reused afterwards."""
        command.wall_ns = wall_ns = self._wall_ns()
        command.sent_ns = now_ns = self._monotonic_ns()
        self._repeat_due_ns = now_ns + self._repeat_ns
        payload = self._held = command.SerializeToString()
        self._scheduler.send(self._rig, payload, now_ns)
        self._publisher.publish_encoded(payload, wall_ns)

    def repeat_if_due(self, now_ns: int) -> None:
        """Send the held command again if none was sent for the repetition period; ns, monotonic clock."""
        if now_ns >= self._repeat_due_ns and self._held:
            self._repeat_due_ns = now_ns + self._repeat_ns
            self._scheduler.send(self._rig, self._held, now_ns)
            self._publisher.republish_encoded(self._held)
