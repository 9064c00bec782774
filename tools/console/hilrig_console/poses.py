"""The newest pose of each rig out of the batches of states that a simulation sends. Pure: batches and time come in.

A rig's newest state is decoded. Most states leave the parts out, so of the others one is decoded too that is as long as
the rig's last one with parts: decoding all of hundreds of rigs would take a third of a core.
"""

from collections.abc import Sequence
from typing import Any, Final

from google.protobuf.message import DecodeError

from hilrig_console.arm_picture import Pose, Scene, parts_of, pose_of, scene_of
from hilrig_monitoring.lab_view import SILENT_AFTER_S
from hilrig_runtime.errors import InputError
from hilrig_schemas import JointState, RigBatch, RigConfig
from hilrig_sim.arm.model import ArmParameters, RigParameters

_STATE: Final = JointState.FromString
_VARIES: Final = 32
"""By so many bytes at most states with the same parts differ in length."""


class _Rig:
    def __init__(self) -> None:
        self.incarnation = 0
        self.heard_s = 0.0
        self.pose: Pose | None = None
        self.parts: list[list[int]] = []
        self.length_with_parts = 0
        self.arm: ArmParameters | None = None
        self.scene = -1
        self.asked_for = 0


class Poses:
    """What is drawn of each rig."""

    def __init__(self) -> None:
        self._rigs: dict[str, _Rig] = {}
        self.scenes: list[Scene] = []
        """What stands still, each once however many rigs have it."""

    def hear(self, payloads: Sequence[bytes], now_s: float) -> None:
        """Take encoded batches of states that have come by `now_s`, the oldest first; what is none is left out."""
        moved: set[str] = set()
        placed: set[str] = set()
        for payload in reversed(payloads):
            try:
                batch = RigBatch.FromString(payload)
                for name, message in zip(batch.rigs, batch.messages, strict=False):
                    if name not in moved:
                        moved.add(name)
                        self._take(name, _STATE(message), now_s)
                    rig = self._rigs[name]
                    if name not in placed and len(message) >= rig.length_with_parts - _VARIES:
                        parts = parts_of(_STATE(message))
                        if parts:
                            placed.add(name)
                            rig.parts, rig.length_with_parts = parts, len(message)
            except DecodeError:
                continue

    def _take(self, name: str, state: JointState, now_s: float) -> None:
        rig = self._rigs.setdefault(name, _Rig())
        rig.incarnation, rig.heard_s = state.incarnation, now_s
        if rig.arm is not None and len(state.position) == 4:
            rig.pose = pose_of(rig.arm, state)

    def unknown(self) -> list[str]:
        """Rigs of which it is not known yet what they look like, or no longer: their simulation started anew."""
        return [name for name, rig in self._rigs.items() if rig.asked_for != rig.incarnation]

    def learn(self, name: str, config: RigConfig | None) -> None:
        """Take a rig's answer to what it is; None: it gave none."""
        rig = self._rigs.get(name)
        if rig is None or config is None:
            return
        # Once a run of its simulation, also where the answer is of no use.
        rig.asked_for = rig.incarnation
        try:
            parameters = RigParameters.from_json(config.parameters_json)
        except InputError:
            return
        scene = scene_of(parameters)
        if scene not in self.scenes:
            self.scenes.append(scene)
        rig.arm, rig.scene = parameters.arm, self.scenes.index(scene)

    def drawn(self, now_s: float) -> dict[str, list[Any]]:
        """Of each rig that was heard lately: number of its scene, pose, places of its parts."""
        for name in [name for name, rig in self._rigs.items() if now_s - rig.heard_s > SILENT_AFTER_S]:
            del self._rigs[name]
        return {
            name: [rig.scene, rig.pose, rig.parts] for name, rig in self._rigs.items() if rig.pose and rig.scene >= 0
        }
