"""Cache of the newest pose of each rig, from batches of states. Pure: batches and time are passed in.

The newest state of each rig is decoded. Most states do not contain the parts, so additionally the newest state is
decoded whose length is similar to the rig's last state with parts. Decoding all states of hundreds of rigs would take a
third of a core.
"""

from collections.abc import Sequence
from typing import Any, Final

from google.protobuf.message import DecodeError

from hilrig_monitoring.lab_view import SILENT_AFTER_S
from hilrig_replay.geometry.arm_picture import Pose, Scene, parts_of, pose_of, scene_of
from hilrig_runtime.errors import InputError
from hilrig_schemas import JointState, RigBatch, RigConfig
from hilrig_schemas.topics import STATE
from hilrig_sim.arm.model import ArmParameters, RigParameters

_STATE: Final = STATE.decode
_MAX_LENGTH_VARIATION: Final = 32
"""Largest difference in length between states with the same parts, bytes."""


class _RigPose:
    """Newest pose, parts and scene of one rig."""

    def __init__(self) -> None:
        self.incarnation = 0
        self.received_s = 0.0
        self.pose: Pose | None = None
        self.parts: list[list[int]] = []
        self.length_with_parts = 0
        self.arm: ArmParameters | None = None
        self.scene = -1
        self.configured_incarnation = 0


class PoseCache:
    """Newest poses, parts and scenes of all rigs."""

    def __init__(self) -> None:
        self._rigs: dict[str, _RigPose] = {}
        self.scenes: list[Scene] = []
        """Distinct static scenes of the rigs."""

    def add(self, payloads: Sequence[bytes], now_s: float) -> None:
        """Add encoded batches of states received by `now_s`, oldest first; an invalid message is ignored."""
        updated: set[str] = set()
        placed: set[str] = set()
        for payload in reversed(payloads):
            try:
                batch = RigBatch.FromString(payload)
                for name, message in zip(batch.rigs, batch.messages, strict=False):
                    if name not in updated:
                        updated.add(name)
                        self._update(name, _STATE(message), now_s)
                    rig = self._rigs[name]
                    if name not in placed and len(message) >= rig.length_with_parts - _MAX_LENGTH_VARIATION:
                        parts = parts_of(_STATE(message))
                        if parts:
                            placed.add(name)
                            rig.parts, rig.length_with_parts = parts, len(message)
            except DecodeError:
                continue

    def _update(self, name: str, state: JointState, now_s: float) -> None:
        rig = self._rigs.setdefault(name, _RigPose())
        rig.incarnation, rig.received_s = state.incarnation, now_s
        if rig.arm is not None and len(state.position) == 4:
            rig.pose = pose_of(rig.arm, state)

    def unconfigured(self) -> list[str]:
        """Return the rigs without configuration, for example after a restart of their simulation."""
        return [name for name, rig in self._rigs.items() if rig.configured_incarnation != rig.incarnation]

    def configure(self, name: str, config: RigConfig | None) -> None:
        """Set the configuration of a rig; None: the query was not answered."""
        rig = self._rigs.get(name)
        if rig is None or config is None:
            return
        # Once per incarnation of the simulation, also if the configuration is invalid.
        rig.configured_incarnation = rig.incarnation
        try:
            parameters = RigParameters.from_json(config.parameters_json)
        except InputError:
            return
        scene = scene_of(parameters)
        if scene not in self.scenes:
            self.scenes.append(scene)
        rig.arm, rig.scene = parameters.arm, self.scenes.index(scene)

    def as_dict(self, now_s: float) -> dict[str, list[Any]]:
        """Return scene number, pose and part positions of each rig with a recent state."""
        for name in [name for name, rig in self._rigs.items() if now_s - rig.received_s > SILENT_AFTER_S]:
            del self._rigs[name]
        return {
            name: [rig.scene, rig.pose, rig.parts] for name, rig in self._rigs.items() if rig.pose and rig.scene >= 0
        }
