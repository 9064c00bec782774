"""Converts the configuration of a lab to the parameters of its rigs in SI units, and validates them."""

import math
from collections.abc import Iterator

from hilrig_runtime.config.lab import ArmConfig, LabConfig, RigSettings
from hilrig_runtime.config.scene import SceneConfig, TrayConfig
from hilrig_runtime.config.task import TaskConfig
from hilrig_runtime.errors import InputError, first_errors
from hilrig_sim.arm.kinematics import UnreachableError, forward, in_reach, inverse
from hilrig_sim.arm.model import (
    ArmParameters,
    PartParameters,
    RigParameters,
    SceneParameters,
    StepParameters,
    TrayParameters,
    Vector3,
    joints_si,
)
from hilrig_sim.arm.stability import check_stable


def rig_parameters(lab: LabConfig, rig: RigSettings) -> RigParameters:
    """Return the parameters of a rig.

    Raises:
        InputError: values are inconsistent, or the step would be unstable.
    """
    try:
        parameters = RigParameters(
            arm=_arm(rig.arm),
            sim=StepParameters(lab.sim.step_ns, lab.sim.substeps, lab.sim.integrator),
            scene=_scene(lab.scene_of(rig)),
        )
        check_stable(parameters)
    except InputError as error:
        raise InputError(f"rig {rig.name!r}: {error}") from error
    return parameters


def lab_parameters(lab: LabConfig, where: str) -> dict[str, RigParameters]:
    """Return the parameters of every rig of a lab, whose rigs can perform the lab's task.

    Args:
        lab: the lab.
        where: name of its file in messages.

    Raises:
        InputError: lists the first mistakes.
    """
    found, mistakes = {}, []
    for rig in lab.rigs:
        try:
            found[rig.name] = rig_parameters(lab, rig)
        except InputError as error:
            mistakes += str(error).splitlines()
        else:
            mistakes += () if lab.task is None else task_mistakes(lab.task, found[rig.name])
    if mistakes:
        raise InputError("\n".join(f"{where}: {line}" for line in first_errors(list(dict.fromkeys(mistakes)))))
    return found


def task_mistakes(task: TaskConfig, parameters: RigParameters) -> Iterator[str]:
    """Yield each reason why a rig can't perform a task: a pose or point out of reach, or a part not in the scene."""
    for pose in task.poses:
        x, y, z = (length / 1000 for length in pose.position_mm)
        try:
            inverse(parameters.arm, (x, y, z, 0.0 if pose.yaw_deg is None else math.radians(pose.yaw_deg)))
        except UnreachableError as error:
            yield f"task: pose {pose.name!r} is out of reach: {error}"
    # The highest and the lowest position of the quill.
    strokes = parameters.arm.upper[2], parameters.arm.lower[2]
    low, high = (float(forward(parameters.arm, (0.0, 0.0, d3, 0.0))[2]) for d3 in strokes)
    for number, (x_mm, y_mm, z_mm) in enumerate(() if task.path is None else task.path.points_mm, start=1):
        within = low <= z_mm / 1000 <= high and bool(in_reach(parameters.arm, x_mm / 1000, y_mm / 1000))
        if not within:
            yield f"task: point {number} of the path, ({x_mm:g}, {y_mm:g}, {z_mm:g}) mm, is out of reach"
    known = [part.name for part in parameters.scene.parts if part.ferromagnetic]
    for name in () if task.place is None else task.place.parts:
        if name not in known:
            yield (
                f"task.place.parts: no ferromagnetic part {name!r} in the scene; its ferromagnetic parts: "
                f"{', '.join(known) or 'none'}"
            )
    if task.place is not None:
        required = len(task.place.parts or known)
        places = sum(len(tray.places) for tray in parameters.scene.trays)
        if not places:
            yield "task.place: the scene has no tray with places"
        elif places < required:
            yield f"task.place: {required} parts are to be placed, but the trays have {places} places"


def _arm(config: ArmConfig) -> ArmParameters:
    return ArmParameters(
        l1=config.l1_m,
        l2=config.l2_m,
        l3=config.l3_m,
        masses=config.masses_kg,
        j4=config.j4_kgm2,
        friction=config.friction,
        lower=joints_si(config.lower_limits),
        upper=joints_si(config.upper_limits),
        start=joints_si(config.start_position),
        external_force_z=config.external_force_z_n,
        external_torque_z=config.external_torque_z_nm,
    )


def _scene(config: SceneConfig) -> SceneParameters:
    table = config.table.height_mm / 1000
    trays = tuple(
        TrayParameters(
            name=tray.name,
            size=_meters3(tray.size_mm),
            position=(tray.position_mm[0] / 1000, tray.position_mm[1] / 1000, table),
            yaw=math.radians(tray.yaw_deg),
            colour=tray.colour,
            places=tuple((x / 1000, y / 1000, table + tray.size_mm[2] / 1000) for x, y in _places_mm(tray)),
        )
        for tray in config.trays
    )
    parts = []
    for part in config.parts:
        x, y = part.position_mm[0] / 1000, part.position_mm[1] / 1000
        radius = part.footprint_radius_mm / 1000
        below = max((t.position[2] + t.size[2] for t in trays if on_tray(t, x, y, radius)), default=table)
        size = _meters3(part.size_mm)
        parts.append(
            PartParameters(
                name=part.name,
                shape=part.shape,
                size=size,
                mass=part.mass_kg,
                ferromagnetic=part.ferromagnetic,
                colour=part.colour,
                position=(x, y, below + size[2] / 2),
                yaw=math.radians(part.yaw_deg),
            )
        )
    return SceneParameters(
        table_height=table,
        table_centre=(config.table.centre_mm[0] / 1000, config.table.centre_mm[1] / 1000),
        table_size=(config.table.size_mm[0] / 1000, config.table.size_mm[1] / 1000),
        magnet_reach=config.magnet.reach_mm / 1000,
        magnet_gap=config.magnet.gap_mm / 1000,
        trays=trays,
        parts=tuple(parts),
    )


def _places_mm(tray: TrayConfig) -> list[tuple[float, float]]:
    """Return world x, y of each place, row by row, mm."""
    c, s = math.cos(math.radians(tray.yaw_deg)), math.sin(math.radians(tray.yaw_deg))
    places = []
    for row in range(tray.rows):
        for column in range(tray.columns):
            u = (row - (tray.rows - 1) / 2) * tray.pitch_mm
            v = (column - (tray.columns - 1) / 2) * tray.pitch_mm
            places.append((tray.position_mm[0] + c * u - s * v, tray.position_mm[1] + s * u + c * v))
    return places


def on_tray(tray: TrayParameters, x: float, y: float, radius: float) -> bool:
    """Return whether a disc of `radius` about (x, y), m, overlaps a tray."""
    c, s = math.cos(tray.yaw), math.sin(tray.yaw)
    dx, dy = x - tray.position[0], y - tray.position[1]
    u = max(abs(c * dx + s * dy) - tray.size[0] / 2, 0.0)
    v = max(abs(c * dy - s * dx) - tray.size[1] / 2, 0.0)
    return u * u + v * v <= radius * radius


def _meters3(lengths_mm: Vector3) -> Vector3:
    return (lengths_mm[0] / 1000, lengths_mm[1] / 1000, lengths_mm[2] / 1000)
