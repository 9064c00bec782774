"""Encodes the published state of a rig from pieces that are known at different times.

The motion is computed long before the tick, and the command fields are known when the command arrives. Only the
timestamps of the tick and the loop latency are not known before it. An encoded protobuf message may consist of
concatenated pieces, so everything known is encoded before the tick, and the tick adds a few bytes.
"""

import struct
from typing import Final

import numpy as np

from hilrig_schemas import JointState, PartState, RigReport
from hilrig_sim.arm.model import RigParameters
from hilrig_sim.commands import CommandLatch, StepTimes
from hilrig_sim.plant.plant import Plant
from hilrig_sim.plant.world import NO_PART

ALL_PARTS_PERIOD_NS: Final = 1_000_000_000
"""Longest time between two states with the poses of all parts, ns."""
_JOINTS: Final = 4
_VECTOR_BYTES: Final = 8 * _JOINTS


def _vector_head(field: str) -> bytes:
    """Return the prefix of a vector in protobuf's encoding of packed repeated fields.

    It consists of the field number with wire type 2 (length-delimited), and the length in bytes.
    """
    head = bytes([JointState.DESCRIPTOR.fields_by_name[field].number << 3 | 2, _VECTOR_BYTES])
    assert head[0] < 0x80, "field number must fit one byte"
    return head


_VECTORS: Final = ("position", "velocity", "integration_error")
_SUBSTEPS_HEAD: Final = JointState(substeps=1).SerializeToString()[:-1]
_MOTION: Final = np.dtype(
    [
        *(item for name in _VECTORS for item in ((f"{name} head", "V2"), (name, "<f8", _JOINTS))),
        ("substeps head", f"V{len(_SUBSTEPS_HEAD)}"),
        # A protobuf number below 128 is one byte.
        ("substeps", "u1"),
    ]
)
_EFFORT: Final = struct.Struct(f"<2s{_JOINTS}d")
_EFFORT_HEAD: Final = _vector_head("effort")


def encode_motion(plant: Plant) -> list[bytes]:
    """Encode position, velocity, integration error and sub-steps of each rig as fields of a `JointState`."""
    rows = np.empty(plant.count, _MOTION)
    for name, values in zip(_VECTORS, (plant.position, plant.velocity, plant.error), strict=True):
        rows[f"{name} head"] = np.void(_vector_head(name))
        rows[name] = values.T
    rows["substeps head"] = np.void(_SUBSTEPS_HEAD)
    rows["substeps"] = plant.substeps
    encoded, size = rows.tobytes(), _MOTION.itemsize
    return [encoded[start : start + size] for start in range(0, len(encoded), size)]


def encode_loop_latency(latency_ns: int) -> bytes:
    """Encode the loop latency as a field of a `JointState`."""
    return JointState(loop_latency_ns=latency_ns).SerializeToString()


class RigStateEncoder:
    """Encodes the state of one rig at each step."""

    def __init__(self, index: int, name: str, parameters: RigParameters, incarnation: int, plant: Plant) -> None:
        self.name = name
        self.encoded = b""
        """Encoded state without timestamps and loop latency, which the tick adds; empty: not encoded yet."""
        self.basis_step = 0
        """Step that the new command is based on; 0: no new command, or an unknown step."""
        self._incarnation = incarnation
        self._external = (parameters.arm.external_force_z, parameters.arm.external_torque_z)
        self._motion = b""
        self._limit_flags = 0
        self._held_part = ""
        self._encoded_slow_values: tuple[object, ...] = ()
        """Values that `_slow_fields` was encoded from."""
        self._slow_fields = b""
        self._command_fields = JointState()
        self._effects: list[tuple[int, int]] = []
        """Steps since the last report at which the command changed, and its loop latency, ns; 0: it has no basis."""
        self._basis_ns = 0
        """Tick of the basis of the command that acted at the last report; 0: none."""
        self._reported_step = 0
        self._parts_due_ns = 0
        self._parts_encoded_ns = 0
        """Tick whose encoded state has the parts, ns; 0: the encoded state has none."""
        self.set_index(index, plant)

    def set_index(self, index: int, plant: Plant) -> None:
        """Set the index of the rig in the plant, after rigs were added or removed."""
        self.index = index
        self._world = plant.world
        self._part_names = plant.world.part_names[index]

    def set_motion(self, motion: bytes, limit_flags: int) -> None:
        """Set the motion at the start of the next step, from `encode_motion`, and the `Plant.limit_flags`."""
        self._motion, self._limit_flags = motion, limit_flags
        self.encoded = b""

    def encode(self, command: CommandLatch, times: StepTimes, now_ns: int) -> None:
        """Encode everything that is known for a tick at `now_ns`, monotonic clock, with its latched command."""
        world, index = self._world, self.index
        parts, self._parts_encoded_ns = b"", 0
        if self._part_names and (world.moving[index] or now_ns >= self._parts_due_ns):
            parts, self._parts_encoded_ns = self._encode_parts(), now_ns
        slow_values = (command.session, command.magnet, command.safe, self._held_part, self._limit_flags)
        if slow_values != self._encoded_slow_values:
            self._encoded_slow_values = slow_values
            self._slow_fields = self._encode_slow_fields(command)
        # The message object is reused: it has numeric fields only, so setting them again allocates no memory.
        command_fields = self._command_fields
        command_fields.command_seq = command.seq
        command_fields.command_arrived_ns = command.arrived_ns
        basis_step = command.basis_step if times.get(command.basis_step) is not None else 0
        self.basis_step = command_fields.basis_step = basis_step
        self.encoded = b"".join(
            (
                self._slow_fields,
                self._motion,
                _EFFORT.pack(_EFFORT_HEAD, *command.effort),
                command_fields.SerializeToString(),
                parts,
            )
        )

    def on_published(self, step: int, latency_ns: int, changed: bool) -> None:
        """Record that the state of a step was published.

        Args:
            step: the step.
            latency_ns: loop latency of the new command; 0: no new command, or it has no basis.
            changed: whether the effort is that of another command, or is zero because the commands timed out.
        """
        if self._parts_encoded_ns:
            # Not in `encode`: the state may have been encoded several times before the tick.
            self._parts_due_ns = self._parts_encoded_ns + ALL_PARTS_PERIOD_NS
        if changed or latency_ns:
            self._effects.append((step, latency_ns))

    def report(self, safe: bool, times: StepTimes) -> RigReport:
        """Return the report on the rig since the last report; `safe`: its commands have timed out."""
        effects, self._effects = self._effects, []
        report = RigReport(rig=self.name, safe=safe, loop_us=[latency // 1000 for _, latency in effects if latency])
        step = self._reported_step + 1
        for following, latency_ns in effects:
            self._add_ages(report, times, step, following)
            self._basis_ns = (times.get(following) or 0) - latency_ns if latency_ns else 0
            step = following
        self._add_ages(report, times, step, times.step + 1)
        self._reported_step = times.step
        return report

    def _add_ages(self, report: RigReport, times: StepTimes, begin: int, end: int) -> None:
        """Add the ages of the acting command's basis at the steps from `begin` to before `end`."""
        if self._basis_ns > 0:
            sampled = (times.get(step) for step in range(begin, end))
            report.age_us.extend([(at_ns - self._basis_ns) // 1000 for at_ns in sampled if at_ns is not None])

    def _encode_slow_fields(self, command: CommandLatch) -> bytes:
        """Encode the fields that rarely change."""
        force, torque = self._external
        return JointState(
            rig=self.name,
            session=command.session,
            incarnation=self._incarnation,
            external_force_z=force,
            external_torque_z=torque,
            magnet=command.magnet,
            held_part=self._held_part,
            limit_flags=self._limit_flags,
            safe=command.safe,
        ).SerializeToString()

    def _encode_parts(self) -> bytes:
        """Encode the parts, and update the name of the held part.

        A new message each time: a reused one would keep the memory of every part that was ever added.
        """
        world, index = self._world, self.index
        columns = (world.x, world.y, world.z, world.yaw, *world.velocity)
        values = [column[:, index].tolist() for column in columns]
        motions = zip(self._part_names, *values, strict=False)
        held = int(world.held[index])
        self._held_part = self._part_names[held] if held != NO_PART else ""
        parts = [
            PartState(name=name, x=x, y=y, z=z, yaw=yaw, vx=vx, vy=vy, vz=vz)
            for name, x, y, z, yaw, vx, vy, vz in motions
        ]
        return JointState(parts=parts).SerializeToString()
