"""ARCHITECTURE.md names every module, and names none that is gone."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "ARCHITECTURE.md").read_text()
FLOORS = {
    "runtime": "runtime/hilrig_runtime",
    "sim": "services/sim/hilrig_sim",
    "modbus_edge": "services/modbus_edge/hilrig_modbus_edge",
    "recorder": "services/recorder/hilrig_recorder",
    "replay": "tools/replay/hilrig_replay",
    "study": "tools/study/hilrig_study",
    "monitoring": "tools/monitoring/hilrig_monitoring",
    "console": "tools/console/hilrig_console",
}


@pytest.mark.parametrize("floor", FLOORS)
def test_each_module_of_a_package_is_named_and_exists(floor: str) -> None:
    paragraph = PAGE.partition(f"**{floor}** —")[2].partition("\n\n")[0]
    named = set(re.findall(r"`([a-z_0-9]+(?:\.[a-z_0-9]+)?)`", paragraph)) - {"lab.toml"}
    package = ROOT / FLOORS[floor]
    files = (path.relative_to(package).with_suffix("") for path in package.rglob("*.py") if path.stem != "__init__")
    modules = {".".join(file.parts) for file in files}
    assert modules - named == set(), "not in ARCHITECTURE.md"
    # `hilrig` subcommands may be named beside modules; a word that is neither is a module that is gone.
    commands = {path.stem for path in (ROOT / "tools/cli/hilrig_cli/commands").glob("*.py")}
    assert named - modules - commands == set(), "no module of that name any more"
