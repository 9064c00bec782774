"""Parameters of a rig in SI units, for simulation, visualization and grading.

They are computed from the lab's configuration, which has their defaults, published as JSON in
`RigConfig.parameters_json`, and read from a recording without loss.
"""

import dataclasses
import json
import math
import reprlib
from dataclasses import dataclass
from typing import Any, Final, Literal, Self, Union, get_args, get_origin, get_type_hints

from hilrig_runtime.config.lab import ArmConfig, SimConfig
from hilrig_runtime.config.scene import SceneConfig
from hilrig_runtime.errors import InputError
from hilrig_sim.arm.joints import JOINT_NAMES

GRAVITY: Final = 9.81
"""m/s², as in the paper (20)."""
LARGEST_REGISTER_FORCE: Final = 32.767
"""Largest force in the paper's force register, N."""
LARGEST_EFFORT: Final = 32.768
"""Largest effort of the drives, N·m or N: the absolute limit of a torque register."""
LARGEST_NUMBER: Final = 1e10
"""Largest magnitude of a number in recorded parameters; a step of 10 s has 10¹⁰ ns."""
MAX_JSON_CHARACTERS: Final = 1 << 20
"""Longest recorded parameters; those of 64 parts have 20,000 characters."""

PLANT_VERSION: Final = 3
"""Current rules of the plant; a recording is verified with its own."""
AUTO: Final = "auto"
"""Value of `StepParameters.substeps`: the number of integration steps is chosen for each rig and step."""

Vector2 = tuple[float, float]
Vector3 = tuple[float, float, float]
Vector4 = tuple[float, float, float, float]


_ARM: Final = ArmConfig()
_SIM: Final = SimConfig()
_SCENE: Final = SceneConfig()


def joints_si(joints: Vector4) -> Vector4:
    """Convert joint coordinates from the units of `lab.toml` (°, °, mm, °) to rad, rad, m, rad."""
    return (math.radians(joints[0]), math.radians(joints[1]), joints[2] / 1000, math.radians(joints[3]))


_LOWER, _UPPER, _START = map(joints_si, (_ARM.lower_limits, _ARM.upper_limits, _ARM.start_position))


def _positive(**values: float) -> None:
    for name, value in values.items():
        if not (value > 0 and math.isfinite(value)):
            raise InputError(f"the arm's {name} must be a positive number, got {value!r}")


@dataclass(frozen=True, slots=True)
class ArmParameters:
    """Parameters of the arm (docs/model.md); point masses at the distal ends of the links (17)–(19)."""

    l1: float = _ARM.l1_m
    """Height of the arm's plane above the base plane, m."""
    l2: float = _ARM.l2_m
    """Length of link 1, m."""
    l3: float = _ARM.l3_m
    """Length of link 2, m."""
    masses: Vector3 = _ARM.masses_kg
    """m1, m2, m3, kg."""
    j4: float = _ARM.j4_kgm2
    """Inertia of joint 4, kg·m²."""
    friction: Vector4 = _ARM.friction
    """b1…b4; N·m·s, N·m·s, N·s/m, N·m·s."""
    lower: Vector4 = _LOWER
    """Lower stops; rad, rad, m, rad."""
    upper: Vector4 = _UPPER
    """Upper stops; rad, rad, m, rad."""
    start: Vector4 = _START
    """Start pose; rad, rad, m, rad."""
    external_force_z: float = _ARM.external_force_z_n
    """f_z, force of the environment on the tool, along world z, N."""
    external_torque_z: float = _ARM.external_torque_z_nm
    """n_z, torque of the environment on the tool, about world z, N·m."""

    def __post_init__(self) -> None:
        _positive(l1=self.l1, l2=self.l2, l3=self.l3, j4=self.j4)
        for name, mass in zip(("m1", "m2", "m3"), self.masses, strict=True):
            _positive(**{name: mass})
        for name, coefficient in zip(("b1", "b2", "b3", "b4"), self.friction, strict=True):
            if not (coefficient >= 0 and math.isfinite(coefficient)):
                raise InputError(f"the arm's {name} must be a number ≥ 0, got {coefficient!r}")
        for name, low, high, start in zip(JOINT_NAMES, self.lower, self.upper, self.start, strict=True):
            if not low < high:
                raise InputError(f"the arm's {name}: the lower limit {low:g} must be below the upper limit {high:g}")
            if not low <= start <= high:
                raise InputError(f"the arm's {name}: the start {start:g} must be within {low:g} to {high:g}")


@dataclass(frozen=True, slots=True)
class PartParameters:
    """A part and its start pose."""

    name: str
    shape: str
    """"cylinder" or "box"."""
    size: Vector3
    """Length, width (a cylinder's both are its diameter), height, m."""
    mass: float
    """kg."""
    ferromagnetic: bool
    colour: str
    """#rrggbb."""
    position: Vector3
    """Center, world, m."""
    yaw: float
    """Angle about world z, rad."""

    @property
    def radius(self) -> float:
        """Radius of its footprint, the largest disc inside it, m."""
        return min(self.size[0], self.size[1]) / 2


@dataclass(frozen=True, slots=True)
class TrayParameters:
    """A flat tray and its places."""

    name: str
    size: Vector3
    """Length, width, height, m."""
    position: Vector3
    """Center of the bottom, world, m."""
    yaw: float
    """Angle about world z, rad."""
    colour: str
    """#rrggbb."""
    places: tuple[Vector3, ...]
    """Target positions for the bottoms of parts, world, m."""


@dataclass(frozen=True, slots=True)
class SceneParameters:
    """Objects around the arm."""

    table_height: float = _SCENE.table.height_mm / 1000
    """World z of the table's top, m."""
    table_centre: Vector2 = (_SCENE.table.centre_mm[0] / 1000, _SCENE.table.centre_mm[1] / 1000)
    table_size: Vector2 = (_SCENE.table.size_mm[0] / 1000, _SCENE.table.size_mm[1] / 1000)
    """Extent along x and y, m."""
    magnet_reach: float = _SCENE.magnet.reach_mm / 1000
    """Largest horizontal distance from the tip to the center of a part's top, m."""
    magnet_gap: float = _SCENE.magnet.gap_mm / 1000
    """Largest vertical distance between the tip and a part's top, m."""
    trays: tuple[TrayParameters, ...] = ()
    parts: tuple[PartParameters, ...] = ()


@dataclass(frozen=True, slots=True)
class StepParameters:
    """Step length and integration method."""

    step_ns: int = _SIM.step_ns
    substeps: int | Literal["auto"] = _SIM.substeps
    """Integration steps of a step of the loop: a fixed number, or `AUTO`."""
    integrator: str = _SIM.integrator
    plant_version: int = PLANT_VERSION
    """Rules of the plant: 1, of recordings without this number: released parts fall from rest; up to 2: automatic
    sub-steps do not limit the turn of joint 2."""

    def __post_init__(self) -> None:
        known = get_args(SimConfig.model_fields["integrator"].annotation)
        if self.integrator not in known:
            raise InputError(f"the integrator must be one of {', '.join(known)}, got {reprlib.repr(self.integrator)}")

    @property
    def step(self) -> float:
        """Length of a step of the loop, s."""
        return self.step_ns * 1e-9


def describe_substeps(substeps: int | Literal["auto"]) -> str:
    """Return a number of integration steps as human-readable text."""
    return "automatic sub-steps" if substeps == AUTO else f"{substeps} sub-steps"


@dataclass(frozen=True, slots=True)
class RigParameters:
    """Parameters of one rig: arm, step and scene."""

    arm: ArmParameters = ArmParameters()
    sim: StepParameters = StepParameters()
    scene: SceneParameters = SceneParameters()

    def __post_init__(self) -> None:
        for part in self.scene.parts:
            weight = (self.arm.masses[2] + part.mass) * GRAVITY
            if part.ferromagnetic and weight > LARGEST_REGISTER_FORCE:
                most = LARGEST_REGISTER_FORCE / GRAVITY - self.arm.masses[2]
                raise InputError(
                    f"part {part.name!r} is too heavy: quill and part weigh {weight:.1f} N, but the force register "
                    f"is limited to {LARGEST_REGISTER_FORCE} N; the part must have at most {most:.2f} kg"
                )

    def to_json(self) -> str:
        """Return the parameters as JSON, without loss."""
        return json.dumps(dataclasses.asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Self:
        """Return the parameters from the JSON of `to_json`.

        Raises:
            InputError: the text is not such JSON, or a value is invalid.
        """
        try:
            if len(text) > MAX_JSON_CHARACTERS:
                raise ValueError(f"{len(text)} characters, expected at most {MAX_JSON_CHARACTERS}")
            fields = json.loads(text)
            if not isinstance(fields, dict) or fields.keys() != {"arm", "sim", "scene"}:
                raise ValueError("expected an object with the keys arm, sim, scene")
            if isinstance(fields["sim"], dict):
                fields["sim"].setdefault("plant_version", 1)
            found: Self = _decode(cls, fields, "parameters")
            return found
        except (ValueError, TypeError, RecursionError) as error:
            raise InputError(
                f"invalid rig parameters (parameters_json): {error}; use the hilrig version that made the recording"
            ) from error


def _decode(kind: Any, value: Any, place: str) -> Any:
    """Convert a JSON value to a type of the parameters; `place` is its name in messages."""
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        hints = get_type_hints(kind)
        if not isinstance(value, dict) or not value.keys() <= hints.keys():
            raise ValueError(f"{place} must be an object with the keys {', '.join(hints)}")
        return kind(**{key: _decode(hints[key], item, f"{place}.{key}") for key, item in value.items()})
    if get_origin(kind) is tuple:
        kinds = get_args(kind)
        if kinds[-1] is Ellipsis and isinstance(value, list):
            kinds = (kinds[0],) * len(value)
        if not isinstance(value, list) or len(value) != len(kinds):
            raise ValueError(f"{place} must be a list of {len(kinds)} items, got {_shown(value)}")
        return tuple(_decode(one, item, place) for one, item in zip(kinds, value, strict=True))
    if get_origin(kind) is Union:
        # A number, or one of a few words.
        kind, words = get_args(kind)
        if value in get_args(words):
            return value
    numeric = isinstance(value, int | float) and not isinstance(value, bool)
    if kind is float and not (numeric and abs(value) <= LARGEST_NUMBER):
        raise ValueError(f"{place} must be a number up to {LARGEST_NUMBER:g}, got {_shown(value)}")
    if kind is int and not (numeric and isinstance(value, int) and 1 <= value <= LARGEST_NUMBER):
        raise ValueError(f"{place} must be an integer from 1 to {LARGEST_NUMBER:g}, got {_shown(value)}")
    if kind in (str, bool) and not isinstance(value, kind):
        raise ValueError(f"{place} must be a {kind.__name__}, got {_shown(value)}")
    return value


def _shown(value: Any) -> str:
    return reprlib.repr(value)
