"""Converts the configuration of a lab to the parameters of its rigs in SI units, and validates them."""

import math

from hilrig_runtime.config.lab import ArmConfig, LabConfig, RigSettings
from hilrig_runtime.config.scene import SceneConfig, TrayConfig
from hilrig_runtime.errors import InputError
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
