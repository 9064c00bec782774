"""The standing command of one rig: four torques, the magnet, and whose word they are.

Every accepted write goes out at once as one `TorqueCommand` with the next number. What stands is repeated with its
number, so that the simulation can tell a held torque from a lost edge. One message is used again and again: a write
sets what changed. On an impaired way each command is a copy that leaves in its time, and what stands is the last that
did; the edge's own word, the watchdog's zero before all, is never held up, and makes void what is still on its way.
"""

from typing import Final

from hilrig_modbus_edge.device.client import NO_BASIS, Client, Served
from hilrig_modbus_edge.device.settings import Outlet
from hilrig_modbus_edge.impairment.delay_line import Fates, Line
from hilrig_modbus_edge.registers import codec
from hilrig_runtime.timing.clock import Clock
from hilrig_schemas import TorqueCommand

_OF_A_WRITE: Final = (
    "controller",
    "basis_incarnation",
    "basis_step",
    "state_arrived_ns",
    "state_served_ns",
    "state_injected_ns",
    "write_arrived_ns",
)


class Commander:
    """See the module."""

    def __init__(self, rig: str, clock: Clock, outlet: Outlet, repeat_ns: int) -> None:
        self.torque = bytearray(8)
        """The four torque registers, big-endian; `write` or `say` send them."""
        self.echo = 0
        """The controller's echo word, 16 bit; his next write carries it."""
        self._monotonic_ns = clock.monotonic_ns
        self._wall_ns = clock.wall_ns
        self._outlet = outlet
        self._repeat_ns = repeat_ns
        self._repeat_due_ns = clock.monotonic_ns()
        self._message = TorqueCommand(rig=rig, effort=(0.0, 0.0, 0.0, 0.0), safe=True)
        self._effort = self._message.effort
        self._standing = self._message
        """What was last sent, to be repeated."""
        self._way: Line[tuple[TorqueCommand, bytes]] | None = None
        """Commands on an impaired way, each with its torque registers; None: every command leaves at once."""
        self._standing_torque = bytes(8)
        self._seq = 0
        self._session_is_told = True
        # Whose word it is and what it was based on: most writes change neither.
        self._writer: Client | None = None
        self._basis: Served = NO_BASIS
        self._echo_told = 0

    @property
    def moves(self) -> bool:
        """Whether a torque stands that is not zero."""
        return any(self.torque)

    @property
    def magnet(self) -> bool:
        """Whether the magnet is asked to be on."""
        return self._message.magnet

    @magnet.setter
    def magnet(self, on: bool) -> None:
        self._message.magnet = on

    @property
    def session(self) -> str:
        """Id of the session that commands belong to; empty: none."""
        return self._message.session

    @session.setter
    def session(self, session: str) -> None:
        if session != self._message.session:
            self._message.session = session
            self._session_is_told = False

    def zero(self) -> None:
        """No torque, from the next command on."""
        self.torque[:] = bytes(8)

    def reset(self) -> None:
        """No torque and the arm back at its start pose, from the next command on."""
        self.zero()
        self._message.resets += 1

    def write(self, client: Client, arrived_ns: int) -> bool:
        """Send what stands as the word of a controller whose write came at `arrived_ns`, monotonic clock.

        False: it is lost on an impaired way.
        """
        message = self._message
        if client is not self._writer:
            self._writer = client
            message.controller = client.address
            message.safe = False
        # To set a field takes as long as a dozen steps of the interpreter: what is as it was is left alone.
        if self.echo != self._echo_told:
            message.echo = self._echo_told = self.echo
        basis = client.basis or NO_BASIS
        before = self._basis
        if basis is not before:
            self._basis = basis
            state, message.state_served_ns = basis
            if state is not before[0]:
                (
                    message.basis_incarnation,
                    message.basis_step,
                    message.state_arrived_ns,
                    message.state_injected_ns,
                ) = state
        message.write_arrived_ns = arrived_ns
        if self._way is not None:
            return self._set_out(self._way)
        self._send()
        return True

    def say(self) -> None:
        """Send what stands as the edge's own word, which no controller's loop is measured by."""
        message = self._message
        if self._way is not None:
            self._recall(self._way)
        message.safe = not self.moves
        for field in _OF_A_WRITE:
            message.ClearField(field)
        self._writer, self._basis = None, NO_BASIS
        self._send()
        if self._way is not None:
            self._standing = _copy(message)

    def say_session(self) -> None:
        """Let the simulation know of a session that began with a write that moved nothing."""
        if not self._session_is_told:
            self.say()

    def repeat_if_due(self, now_ns: int) -> None:
        """Say again what stands, if nothing was said for the time between repetitions; ns, monotonic clock."""
        if now_ns >= self._repeat_due_ns:
            self._repeat_due_ns = now_ns + self._repeat_ns
            self._outlet.repeat_command(self._standing)

    # -- the impaired way

    @property
    def way(self) -> Line[tuple[TorqueCommand, bytes]] | None:
        """The way that commands take; None: they leave at once."""
        return self._way

    def impair(self, fates: Fates | None) -> None:
        """Have the fates decide when each command leaves; None: at once, as what is on its way does then."""
        if fates is None:
            if self._way is not None:
                newest = self._way.take_newest(self._monotonic_ns())
                self._way = None
                if newest is not None:
                    self._leave(*newest)
        elif self._way is None:
            self._way = Line(fates)
            # The message goes on to hold what is asked for; what stands is what was sent.
            self._standing = _copy(self._message)
            self._standing_torque = bytes(self.torque)
        else:
            self._way.follow(fates)

    def send_due(self, now_ns: int) -> None:
        """Send what has come to the end of its way; ns, monotonic clock."""
        way = self._way
        if way is None:
            return
        while (arrived := way.take(now_ns)) is not None:
            self._leave(*arrived)
        if way.next_ns is not None:
            self._outlet.send_at(way.next_ns)

    def _set_out(self, way: Line[tuple[TorqueCommand, bytes]]) -> bool:
        message = self._message
        self._fill()
        now_ns = self._monotonic_ns()
        if not way.put((_copy(message), bytes(self.torque)), now_ns):
            return False
        self.send_due(now_ns)
        return True

    def _leave(self, sent: tuple[TorqueCommand, bytes], injected_ns: int) -> None:
        command, self._standing_torque = sent
        command.command_injected_ns = injected_ns
        self._dispatch(command)

    def _recall(self, way: Line[tuple[TorqueCommand, bytes]]) -> None:
        """Make void what is on its way: what stands is what the simulation was told, or zero."""
        if way.void():
            # A reset that was asked for is not taken back: it does no harm, and the teacher's is the edge's own word.
            if self.moves:
                self.torque[:] = self._standing_torque
            self._message.magnet = self._standing.magnet
        self._standing_torque = bytes(self.torque)

    # -- sending

    def _fill(self) -> None:
        message = self._message
        self._effort[:] = codec.effort_of(self.torque)
        self._seq += 1
        message.seq = self._seq
        self._session_is_told = True

    def _send(self) -> None:
        self._fill()
        self._dispatch(self._message)

    def _dispatch(self, command: TorqueCommand) -> None:
        self._standing = command
        now_ns = self._monotonic_ns()
        command.wall_ns = self._wall_ns()
        command.sent_ns = now_ns
        self._repeat_due_ns = now_ns + self._repeat_ns
        self._outlet.send_command(command)


def _copy(message: TorqueCommand) -> TorqueCommand:
    copy = TorqueCommand()
    copy.CopyFrom(message)
    return copy
