"""A scene that can't be is refused with the part, the place and what would be right."""

from pathlib import Path

import pytest

from hilrig_runtime.config.lab import LabConfig, load_lab, parse_lab
from hilrig_runtime.errors import InputError
from hilrig_sim.arm.kinematics import inverse
from hilrig_sim.parameters import rig_parameters

PART = '[[scene.parts]]\nname = "{name}"\nposition_mm = [{x}, {y}]\n'


def parameters(text: str) -> None:
    lab = parse_lab(text)
    for rig in lab.rigs:
        rig_parameters(lab, rig)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (PART.format(name="far", x=900, y=0), "'far' at (900, 0) mm is outside the table, which is 1300 mm by 1300 mm"),
        (
            PART.format(name="a", x=300, y=0) + PART.format(name="b", x=320, y=0),
            "parts 'a' and 'b' overlap: their centers are 20.0 mm apart and must be 40.0 mm apart",
        ),
        (PART.format(name="a", x=300, y=0) * 2, "duplicate part or tray name 'a'"),
        (PART.format(name="tray", x=300, y=0), "duplicate part or tray name 'tray'"),
        (PART.format(name="a", x=300, y=0) + "mass_kg = 0", "scene.parts[0].mass_kg: must be > 0, got 0"),
        (PART.format(name="a", x=300, y=0) + 'colour = "red"', "scene.parts[0].colour"),
        (
            PART.format(name="a", x=300, y=0) + "size_mm = [40, 30, 30]",
            "cylinder 'a': length and width must be equal, got 40 and 30 mm",
        ),
        (PART.format(name="a", x=300, y=0) + "weight = 1", "scene.parts[0].weight: unknown key"),
        (
            '[[scene.trays]]\nname = "t"\nposition_mm = [300, 0]\nrows = 5',
            "tray 't' is 150 mm long, but its places need 280 mm",
        ),
        (
            PART.format(name="a", x=300, y=0) + "mass_kg = 3.5",
            "part 'a' is too heavy: quill and part weigh 39.2 N, but the force register is limited to 32.767 N",
        ),
        ("[[rigs]]\n[rigs.arm]\nmasses_kg = [1, -1, 0.5]", "masses_kg[1]: must be > 0, got -1"),
        ("[[rigs]]\n[rigs.arm]\nj4_kgm2 = 0", "j4_kgm2: must be > 0, got 0"),
        (
            "[[rigs]]\n[rigs.arm]\nfriction = [-1, 2, 5, 0.1]",
            "friction[0]: must be ≥ 0, got -1",
        ),
        ("[[rigs]]\n[rigs.arm]\nstart_position = [140, 0, 0, 0]", "theta1: the start"),
        ("[[rigs]]\n[rigs.arm]\nlower_limits = [0, 160, 0, 0]", "theta2: the lower limit"),
        ("[sim]\nstep_ms = 30\nsubsteps = 1", "largest safe step is 23.8 ms"),
        ("[sim]\nstep_ms = 20\nsubsteps = 1\nintegrator = 'euler'", "unstable with euler"),
    ],
)
def test_invalid_value_is_reported_with_its_place(text: str, says: str) -> None:
    with pytest.raises(InputError) as refused:
        parameters(text)
    assert says in str(refused.value)
    assert "\n" not in str(refused.value).strip()


def test_part_that_is_not_ferromagnetic_may_be_heavy() -> None:
    parameters(PART.format(name="vice", x=300, y=0) + "mass_kg = 20\nferromagnetic = false")


def test_part_rests_on_the_tray_below() -> None:
    lab = parse_lab(PART.format(name="a", x=320, y=-220) + PART.format(name="b", x=300, y=200))
    on_tray, on_table = rig_parameters(lab, lab.rigs[0]).scene.parts
    assert on_tray.position[2] == pytest.approx(-0.060 + 0.008 + 0.015)
    assert on_table.position[2] == pytest.approx(-0.060 + 0.015)


def test_rotated_tray_supports_parts_and_places() -> None:
    tray = (
        '[[scene.trays]]\nname = "t"\nposition_mm = [300, 200]\nsize_mm = [200, 100, 12]\nyaw_deg = 45\n'
        "rows = 1\ncolumns = 1\n"
    )
    # Along the tray's length, which points to x and y alike, a part is over it; as far across it is not.
    parts = PART.format(name="along", x=360, y=260) + PART.format(name="across", x=240, y=260)
    lab = parse_lab(tray + parts)
    scene = rig_parameters(lab, lab.rigs[0]).scene
    along, across = (part.position[2] - part.size[2] / 2 for part in scene.parts)
    assert (along, across) == pytest.approx((-0.048, -0.060))
    assert [place[2] for tray in scene.trays for place in tray.places] == pytest.approx([-0.048])


def test_scene_of_a_rig_replaces_the_labs(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    text = '[[rigs]]\nname = "a"\n[[rigs]]\nname = "b"\n[rigs.scene]\nparts = []\n[rigs.scene.table]\nheight_mm = -80'
    path.write_text(text)
    lab = load_lab(path)
    first, second = (rig_parameters(lab, rig).scene for rig in lab.rigs)
    assert len(first.parts) == 4
    assert second.parts == ()
    assert second.table_height == -0.080


def test_default_parts_and_places_are_reachable() -> None:
    lab = LabConfig()
    rig = rig_parameters(lab, lab.rigs[0])
    for part in rig.scene.parts:
        assert len(inverse(rig.arm, (*part.position[:2], part.position[2] + part.size[2] / 2, 0.0)))
    for tray in rig.scene.trays:
        for x, y, z in tray.places:
            assert len(inverse(rig.arm, (x, y, z + 0.03, 0.0)))
