"""Defaults have one home, the models of `lab.toml`: parameters, documentation and examples state the same values."""

import inspect
import re
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import pytest
from pydantic import BaseModel

from hilrig_cli.commands.impair import impair
from hilrig_cli.commands.jitter import jitter
from hilrig_modbus_edge.command_scheduler import COALESCE_WINDOW_NS, DEADLINE_MARGIN_NS
from hilrig_modbus_edge.server.tls import HANDSHAKE_TIMEOUT_S
from hilrig_recorder.mcap_format.chunk import CHUNK_BYTES
from hilrig_recorder.mcap_format.records import COMPRESSION
from hilrig_runtime.config.bus import BusConfig, BusTlsConfig
from hilrig_runtime.config.edge_tls import TlsConfig
from hilrig_runtime.config.impairment import PRESETS, ImpairmentSetting
from hilrig_runtime.config.lab import (
    ArmConfig,
    EdgeConfig,
    LabConfig,
    RecorderConfig,
    RigSettings,
    SimConfig,
)
from hilrig_runtime.config.scene import MagnetConfig, PartConfig, SceneConfig, TableConfig, TrayConfig
from hilrig_runtime.config.task import TaskConfig
from hilrig_runtime.config.template import lab_template
from hilrig_sim.arm.integrators import TABLEAUS
from hilrig_sim.arm.model import RigParameters
from hilrig_sim.parameters import rig_parameters
from hilrig_study.controllers.control_laws import ComputedTorque, Pid
from hilrig_study.simulation.timing import LoopTiming
from hilrig_study.study_config import ControllerConfig, LoopConfig
from support.virtual_rig import pick_and_place

ROOT = Path(__file__).parents[2]
PORT, TLS_PORT, BUS_PORT = "edge.first_port", "edge.tls.first_port", "bus.first_port"
DOCUMENTED = [
    # Page, pattern of a statement with a group for each value, and for each group: key, and its unit per unit of the
    # page.
    ("README.md", r"Modbus TCP, port (\d+)", [(PORT, 1)]),
    ("README.md", r"sets the torques to zero after (\S+) s", [("edge.watchdog_ms", 1000)]),
    ("docs/controllers.md", r"there was no write for (\S+) s", [("edge.watchdog_ms", 1000)]),
    ("docs/adr/0008-lease-and-watchdog.md", r"\((\S+) s by default\)", [("edge.watchdog_ms", 1000)]),
    (
        "docs/controllers.md",
        r"sets another timeout, (\S+) ms to (\S+) s",
        [("edge.watchdog_min_ms", 1), ("edge.watchdog_max_ms", 1000)],
    ),
    ("docs/controllers.md", r"sent no request for (\S+) s", [("edge.lease_timeout_ms", 1000)]),
    ("docs/controllers/openplc.md", r"runs every (\d+) ms, like the simulation", [("sim.step_ms", 1)]),
    (
        "docs/controllers.md",
        r"at most (\d+) mm beside and (\d+) mm below",
        [("scene.magnet.reach_mm", 1), ("scene.magnet.gap_mm", 1)],
    ),
    ("docs/controllers.md", r"on a table at (\S+) mm", [("scene.table.height_mm", 1)]),
    ("docs/controllers.md", r"rig\.example:(\d+)", [(TLS_PORT, 1)]),
    ("docs/operations.md", r"^\| (\d+), \d+, … \| edge: one port per rig", [(PORT, 1)]),
    ("docs/operations.md", r"^\| (\d+), \d+, … \| edge: the same with TLS", [(TLS_PORT, 1)]),
    ("docs/operations.md", r"^\| (\d+), \d+, \d+ \| simulation, edge, recorder", [(BUS_PORT, 1)]),
    ("docs/several-hosts.md", r"`sim\.command_timeout_ms` \((\d+) ms\)", [("sim.command_timeout_ms", 1)]),
    ("docs/troubleshooting.md", r"the bus: can't listen on 127\.0\.0\.1:(\d+)", [(BUS_PORT, 1)]),
    *(
        (page, r"to `rig64`,? at ports (\d+) to", [(PORT, 1)])
        for page in ("docs/operations.md", "docs/configuration.md")
    ),
    ("docs/adr/0002-mesh-on-one-host.md", r"\(simulation (\d+), edge", [(BUS_PORT, 1)]),
    ("docs/model.md", r"^\| θ1 .* l1 = (\S+) m .*, l2 = (\S+) m", [("arm.l1_m", 1), ("arm.l2_m", 1)]),
    ("docs/model.md", r"^\| θ2 .* l3 = (\S+) m", [("arm.l3_m", 1)]),
    *(
        (
            "docs/model.md",
            rf"^\| {joint} \|.*\| (\S+?)°? to (\S+?)(?:°| mm) \|",
            [(f"arm.lower_limits.{index}", 1), (f"arm.upper_limits.{index}", 1)],
        )
        for index, joint in enumerate(("θ1", "θ2", "d3", "θ4"))
    ),
    (
        "docs/model.md",
        r"^\| m1, m2 .* \| (\S+), (\S+), (\S+) kg",
        [(f"arm.masses_kg.{index}", 1) for index in range(3)],
    ),
    (
        "docs/model.md",
        r"^\| b1…b4 .* \| (\S+), (\S+) N·m·s, (\S+) N·s/m, (\S+) N·m·s",
        [(f"arm.friction.{index}", 1) for index in range(4)],
    ),
    ("docs/model.md", r"^\| J4 .* \| (\S+) kg·m²", [("arm.j4_kgm2", 1)]),
    (
        "docs/model-decisions.md",
        r"\*\*m3 and b3\*\* are (\S+) kg and (\S+) N",
        [("arm.masses_kg.2", 1), ("arm.friction.2", 1)],
    ),
    ("docs/model-decisions.md", r"top is at z = (\S+) mm", [("scene.table.height_mm", 1)]),
    (
        "docs/model-decisions.md",
        r"within (\d+) mm sideways and (\d+) mm in height",
        [("scene.magnet.reach_mm", 1), ("scene.magnet.gap_mm", 1)],
    ),
    ("docs/recordings.md", r"from (two) seconds before the start", [("recorder.preroll_s", 1)]),
    *(
        (page, pattern, [(PORT, 1)])
        for page in (
            "README.md",
            "docs/controllers.md",
            *(f"docs/controllers/{name}.md" for name in ("python", "c", "nodejs", "go", "forte")),
            *(f"examples/hold_position.{kind}" for kind in ("py", "c", "js")),
        )
        for pattern in (r"(?:127\.0\.0\.1[: ]|-p |--port |port=|[pP]ort.{1,22}[=:] \"?)(\d{4})\b",)
    ),
    ("examples/pick_and_place.py", r"--port.*?(\d{4})", [(PORT, 1)]),
    ("examples/openplc/mbconfig.cfg", r'IP_Port = "(\d+)"', [(PORT, 1)]),
]


CONSTANTS = [
    # Page, pattern of a statement with a group for the value, and the value in the unit of the page.
    ("docs/adr/0044-commands-are-throttled-with-a-deadline.md", r"within the last (\S+) ms", COALESCE_WINDOW_NS / 1e6),
    ("docs/adr/0044-commands-are-throttled-with-a-deadline.md", r"beyond (\S+) ms before", DEADLINE_MARGIN_NS / 1e6),
    ("docs/modbus-conformance.md", r"incomplete after (\S+) s is aborted", HANDSHAKE_TIMEOUT_S),
    ("docs/recordings.md", r"chunks compressed with (\w+)", COMPRESSION),
    ("docs/recipes.md", r"`HANDSHAKE_TIMEOUT_S` \| (\S+) s", HANDSHAKE_TIMEOUT_S),
    ("docs/recordings.md", r"in chunks of at most (\S+) KiB", CHUNK_BYTES / 1024),
]


def default(key: str) -> float:
    """Return the default of a key of `lab.toml`; `arm` is the one of a rig, a number the index in a tuple."""
    value: Any = ArmConfig() if key.startswith("arm.") else LabConfig()
    for name in key.removeprefix("arm.").split("."):
        if name == "tls":
            value = TlsConfig
        elif name.isdecimal():
            value = value[int(name)]
        else:
            value = TlsConfig.model_fields[name].default if value is TlsConfig else getattr(value, name)
    return float(value)


def number(text: str) -> float:
    return {"two": 2.0}.get(text) or float(text.replace("−", "-").replace(",", ""))


@pytest.mark.parametrize(
    ("page", "pattern", "keys"), DOCUMENTED, ids=[f"{keys[0][0]} in {page}" for page, _, keys in DOCUMENTED]
)
def test_documented_default_equals_the_configuration(page: str, pattern: str, keys: list[tuple[str, float]]) -> None:
    stated = list(re.finditer(pattern, (ROOT / page).read_text(encoding="utf-8"), flags=re.MULTILINE))
    assert stated, f"{page} has no statement {pattern!r}: change the list DOCUMENTED with the page"
    for statement in stated:
        for text, (key, unit) in zip(statement.groups(), keys, strict=True):
            assert number(text) * unit == pytest.approx(default(key)), f"{page}: {statement.group()!r} states {key}"


@pytest.mark.parametrize(("page", "pattern", "value"), CONSTANTS, ids=[pattern for _, pattern, _ in CONSTANTS])
def test_documented_constant_equals_the_code(page: str, pattern: str, value: float | str) -> None:
    stated = re.findall(pattern, (ROOT / page).read_text(encoding="utf-8"))
    found = [text if isinstance(value, str) else number(text) for text in stated]
    assert found == [value], f"{page}: {pattern!r} must state {value}"


def test_rig_parameters_have_the_defaults_of_the_lab_file() -> None:
    parameters = rig_parameters(LabConfig(), RigSettings())
    assert replace(parameters, scene=replace(parameters.scene, trays=(), parts=())) == RigParameters()


def test_lab_file_accepts_every_integrator() -> None:
    assert set(get_args(SimConfig.model_fields["integrator"].annotation)) == set(TABLEAUS)


def test_model_page_lists_every_integrator() -> None:
    rows = re.findall(
        r"^\| .* \| `(\w+)`.* \| (\S+) \| (\S+) ms \|$", (ROOT / "docs/model.md").read_text(), re.MULTILINE
    )
    assert {name: float(limit) for name, limit, _ in rows} == {
        name: pytest.approx(table.negative_real_limit(), abs=1e-3) for name, table in TABLEAUS.items()
    }


def test_every_preset_is_documented() -> None:
    names = list(PRESETS)
    page = (ROOT / "docs/impairment.md").read_text(encoding="utf-8")
    rows = page.partition("| preset |")[2].partition("\n\n")[0]
    assert re.findall(r"^\| `([\w-]+)`", rows, re.MULTILINE) == names[1:]
    listed = f"{', '.join(names[:-1])} or {names[-1]}."
    assert listed in lab_template()
    (option,) = inspect.signature(impair).parameters["preset"].annotation.__metadata__
    assert option.help == f"Preset: {listed}"
    assert ImpairmentSetting().preset == names[0]


def test_command_options_have_the_defaults_of_the_lab_file() -> None:
    assert inspect.signature(jitter).parameters["step_ms"].default == LabConfig().sim.step_ms
    assert inspect.signature(impair).parameters["seed"].default == LabConfig().impairment.seed


def test_study_has_the_defaults_of_its_parts() -> None:
    assert LoopConfig().timing() == LoopTiming()
    for law in (Pid, ComputedTorque):
        assert inspect.signature(law).parameters["filter_s"].default == ControllerConfig().filter_ms / 1e3
    assert inspect.signature(ComputedTorque).parameters["zeta"].default == ControllerConfig().zeta


def test_example_controller_knows_the_default_arm_and_scene() -> None:
    example = pick_and_place()
    rig = rig_parameters(LabConfig(), RigSettings())
    arm = rig.arm
    assert (arm.l1, arm.l2, arm.l3, arm.j4) == (example.L1, example.L2, example.L3, example.J4)
    assert arm.masses == (example.M1, example.M2, example.M3)
    assert tuple(example.FRICTION) == arm.friction
    # The range of theta4 is that of its register.
    assert tuple(example.LOWER[:3]) == pytest.approx(arm.lower[:3])
    assert tuple(example.UPPER[:3]) == pytest.approx(arm.upper[:3])
    assert rig.sim.step == example.RIG_STEP_S
    for task in (example.task_of({}), example.task_of(LabConfig().scene.model_dump())):
        assert [(part.name, part.x, part.y, part.yaw, part.height, part.mass) for part in task.parts] == [
            (part.name, *part.position[:2], part.yaw, part.size[2], part.mass) for part in rig.scene.parts
        ]
        assert [value for place in task.places for value in (place.x, place.y, place.z)] == pytest.approx(
            [value for tray in rig.scene.trays for place in tray.places for value in place]
        )
        assert task.table == rig.scene.table_height
    assert example.Task((), ()).table == rig.scene.table_height


def test_every_key_of_the_lab_file_is_used() -> None:
    sources = [path for folder in ("runtime", "services", "tools") for path in (ROOT / folder).rglob("*.py")]
    text = "".join(path.read_text(encoding="utf-8") for path in sources if not path.stem.endswith("_pb2"))
    models: list[type[BaseModel]] = [LabConfig, SimConfig, EdgeConfig, TlsConfig, RecorderConfig, BusConfig]
    models += [BusTlsConfig, RigSettings, ArmConfig, SceneConfig, TableConfig, MagnetConfig, PartConfig, TrayConfig]
    models.append(TaskConfig)
    assert [
        f"{model.__name__}.{key}"
        for model in models
        for key in model.model_fields
        if not re.search(rf"\.{key}\b", text)
    ] == []
