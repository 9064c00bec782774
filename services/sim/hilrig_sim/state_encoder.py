"""A rig's state as bytes, put together of parts that are known at different times.

A step begins with what the plant computed long before the tick. Who commands is known when the command came. Only the
tick's own stamps are not known before it, and the latency of the loops that it closes. An encoded protobuf message may
be given in pieces, one behind the other; so what is known is encoded before the tick, and the tick adds a few bytes.
"""

import struct
from typing import Final

import numpy as np

from hilrig_runtime.messaging.endpoints import Arrival
from hilrig_schemas import JointState, PartState, RigReport
from hilrig_sim.arm.model import RigParameters
from hilrig_sim.commands import CommandFollower, StepTimes
from hilrig_sim.plant.plant import Plant
from hilrig_sim.plant.world import NO_PART

ALL_PARTS_PERIOD_NS: Final = 1_000_000_000
"""All parts are stated at least so often, ns."""
_JOINTS: Final = 4
_VECTOR_BYTES: Final = 8 * _JOINTS


def _vector_head(field: str) -> bytes:
    """What stands before the numbers of a vector: the field's number, "length given" (2), and the length in bytes.

    Source: protobuf's encoding of packed repeated fields.
    """
    head = bytes([JointState.DESCRIPTOR.fields_by_name[field].number << 3 | 2, _VECTOR_BYTES])
    assert head[0] < 0x80, "numbers of one byte only"
    return head


_VECTORS: Final = ("position", "velocity", "integration_error")
_MOTION: Final = np.dtype([item for name in _VECTORS for item in ((f"{name} head", "V2"), (name, "<f8", _JOINTS))])
_EFFORT: Final = struct.Struct(f"<2s{_JOINTS}d")
_EFFORT_HEAD: Final = _vector_head("effort")


def motion_bytes(plant: Plant) -> list[bytes]:
    """Positions, velocities and integration errors of each rig of a plant, as they stand in an encoded `JointState`."""
    rows = np.empty(plant.count, _MOTION)
    for name, values in zip(_VECTORS, (plant.position, plant.velocity, plant.error), strict=True):
        rows[f"{name} head"] = np.void(_vector_head(name))
        rows[name] = values.T
    encoded, size = rows.tobytes(), _MOTION.itemsize
    return [encoded[start : start + size] for start in range(0, len(encoded), size)]


def loop_bytes(latency_ns: int) -> bytes:
    """The end of the state of a rig whose loop was closed with this latency."""
    return JointState(loop_latency_ns=latency_ns).SerializeToString()


class RigState:
    """What one rig sends at each step."""

    def __init__(
        self,
        index: int,
        name: str,
        parameters: RigParameters,
        incarnation: int,
        command_timeout_ns: int,
        plant: Plant,
    ) -> None:
        self.name = name
        self.follower = CommandFollower(incarnation, command_timeout_ns)
        self.encoded = b""
        """The state but for what the tick adds: its stamps, and the latency of the loop; empty: not known yet."""
        self.arrival: Arrival | None = None
        """The command with which it was encoded."""
        self.basis_step = 0
        """Step to which the command answers that takes effect; 0: none does, or its step is not known."""
        self._incarnation = incarnation
        self._external = (parameters.arm.external_force_z, parameters.arm.external_torque_z)
        self._follows = False
        """The follower has begun the coming step."""
        self._motion = b""
        self._limit_flags = 0
        self._held_part = ""
        self._said: tuple[object, ...] = ()
        """What `_seldom` holds."""
        self._seldom = b""
        self._of_command = JointState()
        self._loops_us: list[int] = []
        self._parts_due_ns = 0
        self._parts_stated_ns = 0
        """When the tick is whose state, as it is encoded, has the parts; 0: it has not."""
        self.move_to(index, plant)

    def move_to(self, index: int, plant: Plant) -> None:
        """Be the rig `index` of a plant."""
        self.index = index
        self._world = plant.world
        self._part_names = plant.world.part_names[index]

    def begin(self, motion: bytes, limit_flags: int) -> None:
        """What the coming step begins with: see `motion_bytes`, `Plant.limit_flags`."""
        self._motion, self._limit_flags = motion, limit_flags
        self.encoded = b""

    def follow(self, arrival: Arrival | None, now_ns: int) -> None:
        """Take the newest command, for the coming tick; again, if a newer one comes before it."""
        self.arrival = arrival
        self.encoded = b""
        if self._follows:
            self.follower.overtake(arrival, now_ns)
        else:
            self.follower.latch(arrival, now_ns)
            self._follows = True

    def encode(self, times: StepTimes, now_ns: int) -> None:
        """Encode what is known, for a tick at `now_ns`, monotonic clock."""
        follower, world, index = self.follower, self._world, self.index
        parts, self._parts_stated_ns = b"", 0
        if self._part_names and (world.moving[index] or now_ns >= self._parts_due_ns):
            parts, self._parts_stated_ns = self._encoded_parts(), now_ns
        said = (follower.session, follower.magnet, follower.safe, self._held_part, self._limit_flags)
        if said != self._said:
            self._said = said
            self._seldom = self._encoded_seldom()
        # The message is used again: it holds numbers alone, which take no memory when they are set anew.
        of_command = self._of_command
        of_command.command_seq = follower.seq
        of_command.command_arrived_ns = follower.arrived_ns
        known = follower.basis_step if times.get(follower.basis_step) is not None else 0
        self.basis_step = of_command.basis_step = known
        self.encoded = b"".join(
            (
                self._seldom,
                self._motion,
                _EFFORT.pack(_EFFORT_HEAD, *follower.effort),
                of_command.SerializeToString(),
                parts,
            )
        )

    def sent(self, latency_ns: int) -> None:
        """The state has left; `latency_ns` is that of the loop that it closed, 0: none."""
        self._follows = False
        if self._parts_stated_ns:
            # Only now: what was encoded before may have been encoded anew, for a command that came later.
            self._parts_due_ns = self._parts_stated_ns + ALL_PARTS_PERIOD_NS
        if latency_ns:
            self._loops_us.append(latency_ns // 1000)

    def report(self) -> RigReport:
        """What is to be known of the rig since the last report."""
        loops_us, self._loops_us = self._loops_us, []
        return RigReport(rig=self.name, loop_us=loops_us, safe=self.follower.safe)

    def _encoded_seldom(self) -> bytes:
        """What is the same at most steps."""
        follower = self.follower
        force, torque = self._external
        return JointState(
            rig=self.name,
            session=follower.session,
            incarnation=self._incarnation,
            external_force_z=force,
            external_torque_z=torque,
            magnet=follower.magnet,
            held_part=self._held_part,
            limit_flags=self._limit_flags,
            safe=follower.safe,
        ).SerializeToString()

    def _encoded_parts(self) -> bytes:
        """The parts; what the magnet holds is noted.

        A message that is used again would keep the memory of every part that was ever added to it; this one is not.
        """
        world, index = self._world, self.index
        poses = zip(
            self._part_names,
            world.x[:, index].tolist(),
            world.y[:, index].tolist(),
            world.z[:, index].tolist(),
            world.yaw[:, index].tolist(),
            strict=False,
        )
        held = int(world.held[index])
        self._held_part = self._part_names[held] if held != NO_PART else ""
        parts = [PartState(name=name, x=x, y=y, z=z, yaw=yaw) for name, x, y, z, yaw in poses]
        return JointState(parts=parts).SerializeToString()
