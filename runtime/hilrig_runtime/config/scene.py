"""The `[scene]` section of `lab.toml`: the table, the trays and the parts that the magnet picks.

Lengths are in millimeters and angles in degrees, in the world frame seen from above: x forward, y to the left.
Footprints are approximated by discs (docs/model.md): parts overlap here exactly if they support each other there.
"""

import math
from typing import Annotated, Literal

from pydantic import Field, model_validator

from hilrig_runtime.config.types import Color, Flag, Name, Number, Positive, Section, Vector2, check_distinct


class TableConfig(Section):
    """The table that carries the arm's pedestal, the trays and the parts."""

    height_mm: Annotated[float, Field(strict=True, lt=0, ge=-1000, allow_inf_nan=False)] = -60.0
    """World z of its top; negative, because the arm's base plane is above it."""
    centre_mm: Vector2 = (0.0, 0.0)
    """Center of its top: x, y."""
    size_mm: tuple[Positive, Positive] = (1300.0, 1300.0)
    """Its extent along x and y; by default it covers the whole workspace of the arm."""


class MagnetConfig(Section):
    """The magnet at the tool's tip."""

    reach_mm: Positive = 15.0
    """Largest horizontal distance between the tip and the center of a part's top for picking."""
    gap_mm: Positive = 5.0
    """Largest difference in height between the tip and a part's top for picking."""


class PartConfig(Section):
    """A part of the scene at its start."""

    name: Name
    shape: Literal["cylinder", "box"] = "cylinder"
    size_mm: tuple[Positive, Positive, Positive] = (40.0, 40.0, 30.0)
    """Length, width, height; a cylinder's length and width are both its diameter."""
    mass_kg: Positive = 0.2
    ferromagnetic: Flag = True
    """Whether the magnet can hold it."""
    colour: Color = "#c8ccd0"
    position_mm: Vector2
    """Its center: x, y. It rests on the tray or the table below it."""
    yaw_deg: Number = 0.0

    @model_validator(mode="after")
    def _cylinder_is_round(self) -> "PartConfig":
        if self.shape == "cylinder" and self.size_mm[0] != self.size_mm[1]:
            raise ValueError(
                f"cylinder {self.name!r}: length and width must be equal, "
                f"got {self.size_mm[0]:g} and {self.size_mm[1]:g} mm"
            )
        return self

    @property
    def footprint_radius_mm(self) -> float:
        """Radius of the largest disc inside its footprint, mm."""
        return min(self.size_mm[0], self.size_mm[1]) / 2


class TrayConfig(Section):
    """A flat tray with places for parts, in rows and columns around its center."""

    name: Name
    position_mm: Vector2
    """Its center: x, y."""
    yaw_deg: Number = 0.0
    size_mm: tuple[Positive, Positive, Positive] = (150.0, 150.0, 8.0)
    """Length, width, height above the table."""
    rows: Annotated[int, Field(strict=True, ge=1, le=20)] = 2
    """Places along its length."""
    columns: Annotated[int, Field(strict=True, ge=1, le=20)] = 2
    """Places along its width."""
    pitch_mm: Positive = 70.0
    """Distance between neighboring places."""
    colour: Color = "#4a5560"

    @model_validator(mode="after")
    def _places_fit(self) -> "TrayConfig":
        for count, length, along in ((self.rows, self.size_mm[0], "long"), (self.columns, self.size_mm[1], "wide")):
            span = (count - 1) * self.pitch_mm
            if span > length:
                raise ValueError(f"tray {self.name!r} is {length:g} mm {along}, but its places need {span:g} mm")
        return self


DEFAULT_PARTS = (
    PartConfig(name="red", colour="#d6453d", mass_kg=0.20, position_mm=(376.0, 137.0)),
    PartConfig(
        name="blue",
        shape="box",
        size_mm=(36.0, 36.0, 30.0),
        colour="#2f6fc4",
        mass_kg=0.30,
        position_mm=(328.0, 229.0),
        yaw_deg=35.0,
    ),
    PartConfig(name="green", colour="#3d9a50", mass_kg=0.15, position_mm=(257.0, 306.0)),
    PartConfig(
        name="yellow",
        shape="box",
        size_mm=(36.0, 36.0, 30.0),
        colour="#e8b32e",
        mass_kg=0.25,
        position_mm=(169.0, 363.0),
        yaw_deg=65.0,
    ),
)
DEFAULT_TRAYS = (TrayConfig(name="tray", position_mm=(320.0, -220.0), yaw_deg=-35.0),)


class SceneConfig(Section):
    """The surroundings of the arm; by default four parts and a tray with four places."""

    table: TableConfig = TableConfig()
    magnet: MagnetConfig = MagnetConfig()
    trays: tuple[TrayConfig, ...] = DEFAULT_TRAYS
    parts: Annotated[tuple[PartConfig, ...], Field(max_length=64)] = DEFAULT_PARTS

    @model_validator(mode="after")
    def _objects_are_distinct_and_on_the_table(self) -> "SceneConfig":
        objects: tuple[TrayConfig | PartConfig, ...] = (*self.trays, *self.parts)
        check_distinct("part or tray name", (item.name for item in objects))
        half = [length / 2 for length in self.table.size_mm]
        for item in objects:
            x, y = (at - center for at, center in zip(item.position_mm, self.table.centre_mm, strict=True))
            if abs(x) > half[0] or abs(y) > half[1]:
                raise ValueError(
                    f"{item.name!r} at {_place(item.position_mm)} is outside the table, which is "
                    f"{self.table.size_mm[0]:g} mm by {self.table.size_mm[1]:g} mm about {_place(self.table.centre_mm)}"
                )
        for index, one in enumerate(self.parts):
            for other in self.parts[index + 1 :]:
                needed = one.footprint_radius_mm + other.footprint_radius_mm
                distance = math.dist(one.position_mm, other.position_mm)
                if distance < needed:
                    raise ValueError(
                        f"parts {one.name!r} and {other.name!r} overlap: their centers are {distance:.1f} mm apart "
                        f"and must be {needed:.1f} mm apart"
                    )
        return self


def _place(position_mm: tuple[float, float]) -> str:
    return f"({position_mm[0]:g}, {position_mm[1]:g}) mm"
