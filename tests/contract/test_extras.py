"""The extras of the distribution: each command has one, and each extra has the dependencies of its commands."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from hilrig_cli import extras
from support.extras import COMMANDS, DATA, MODULES, PROJECT, ROOT, distributions_of, modules_without, registered

OLD_NAMES = {"router", "sim", "edge", "recorder", "replay"}
"""Extras of version 0.1, which remain as aliases."""

CODE = """
import json, sys
from importlib import import_module
from typer.testing import CliRunner

blocked, modules, commands = json.loads(sys.argv[1])
sys.modules.update(dict.fromkeys(blocked))
for module in modules:
    import_module(module)
from hilrig_cli.main import app
for command in commands:
    done = CliRunner().invoke(app, command.split())
    if done.exit_code not in (0, 1) or isinstance(done.exception, ImportError):
        sys.exit(f"hilrig {command}: exit code {done.exit_code}: {done.exception!r}")
"""


def test_each_command_has_one_extra() -> None:
    names = [name for commands in extras.COMMANDS.values() for name in commands.split()]
    assert sorted(names) == sorted({name.rpartition(" ")[2] if " " in name else name for _, name, _ in registered()})
    assert {extra for extra in extras.COMMANDS if extra} <= set(PROJECT["optional-dependencies"])


def test_old_names_of_extras_are_aliases() -> None:
    found = PROJECT["optional-dependencies"]
    assert set(found) == {"rig", "review", "console", "study", "frames", "all", "dev", "docs", *OLD_NAMES}
    assert {name: found[name] for name in OLD_NAMES} == {
        "router": [],
        "sim": ["hilrig[rig]"],
        "edge": ["hilrig[rig]"],
        "recorder": ["hilrig[rig]"],
        "replay": ["hilrig[review]"],
    }


@pytest.mark.parametrize("extra", ["", "rig", "review", "console"])
def test_commands_of_an_extra_need_no_other_packages(extra: str, tmp_path: Path) -> None:
    places = {"root": ROOT, "data": shutil.copytree(DATA, tmp_path / "data"), "out": tmp_path}
    commands = [command.format_map(places) for command in COMMANDS[extra]]
    job = json.dumps((sorted(modules_without(extra)), MODULES.get(extra, "").split(), commands))
    process = [sys.executable, "-c", CODE, job]
    done = subprocess.run(process, check=False, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr


def test_extras_have_only_what_their_commands_need() -> None:
    assert not {"rerun-sdk", "pyarrow", "matplotlib", "starlette", "mcap"} & distributions_of("")
    assert not {"rerun-sdk", "pyarrow", "matplotlib", "starlette"} & distributions_of("rig")
    assert not {"rerun-sdk", "pyarrow", "pymodbus"} & distributions_of("console")
    assert not {"pymodbus", "starlette"} & distributions_of("review")
