"""The impaired command link of one rig: sends each command of a client after its delay, or drops it."""

from hilrig_modbus_edge.device.command_sender import CommandSender
from hilrig_modbus_edge.device.ports import DeviceOutput
from hilrig_modbus_edge.impairment.delay_line import DelayLine, ImpairmentSamples
from hilrig_runtime.timing.clock import Clock
from hilrig_schemas import TorqueCommand


class DelayedCommands:
    """Commands in flight; exists only while the command link is impaired.

    `sent_torque` and `sent_magnet` are the registers of the last command sent: the written registers are ahead of it.
    """

    def __init__(
        self,
        samples: ImpairmentSamples,
        clock: Clock,
        output: DeviceOutput,
        sender: CommandSender,
        sent_torque: bytes,
        sent_magnet: bool,
    ) -> None:
        self.line: DelayLine[tuple[TorqueCommand, bytes]] = DelayLine(samples)
        self.sent_torque = sent_torque
        self.sent_magnet = sent_magnet
        self._monotonic_ns = clock.monotonic_ns
        self._output = output
        self._sender = sender
        self._timer_ns: int | None = None
        """Time of the next scheduled call, ns, monotonic clock; None: none is scheduled."""

    def put(self, command: TorqueCommand, torque: bytes) -> bool:
        """Put a copy of a command into the link, with its torque registers; return False if it is dropped."""
        copy = TorqueCommand()
        copy.CopyFrom(command)
        accepted = self.line.put((copy, torque), self._monotonic_ns())
        if accepted:
            self._send_due()
        return accepted

    def send_newest(self) -> None:
        """Send the newest command in flight now, and drop the others, because the link is no longer impaired."""
        newest = self.line.release_newest(self._monotonic_ns())
        if newest is not None:
            self._send(*newest)

    def _send_due(self) -> None:
        line = self.line
        while (delivered := line.pop_due(self._monotonic_ns())) is not None:
            self._send(*delivered)
        if line.next_ns is not None and (self._timer_ns is None or line.next_ns < self._timer_ns):
            self._timer_ns = line.next_ns
            self._output.call_at(line.next_ns, self._on_timer)

    def _on_timer(self) -> None:
        self._timer_ns = None
        self._send_due()

    def _send(self, in_flight: tuple[TorqueCommand, bytes], injected_ns: int) -> None:
        command, self.sent_torque = in_flight
        self.sent_magnet = command.magnet
        command.command_injected_ns = injected_ns
        self._sender.send(command)
