"""The extras of the distribution: their dependencies, and commands that each of them must run."""

import re
import tomllib
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, packages_distributions, requires
from pathlib import Path

import typer

from hilrig_cli import main

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
DATA = ROOT / "tests/data"
COMMANDS = {
    "": (
        "check --template",
        "check {root}/compose/lab.toml",
        "certs {out}/certs --config {root}/compose/lab.toml",
        "registers",
        "example hold_position.py --out {out}",
        "ik 0.3 0.2 0.1",
    ),
    "rig": (),
    "review": (
        "runs {data}",
        "latency {data}/limit-cycle.mcap --plot {out}/latency.png",
        "report {data}/limit-cycle.mcap --out {out}/report.html",
        "verify {data}/limit-cycle.mcap",
        "compare {data}/limit-cycle.mcap {data}/wall-clock-steps.mcap",
        "export {data}/limit-cycle.mcap --csv {out}/csv --parquet {out}/parquet --foxglove {out}/foxglove.mcap",
        "replay {data}/limit-cycle.mcap --save {out}/run.rrd",
        "recover {data}/limit-cycle.mcap",
    ),
    "console": (),
}
"""Command lines of each extra that end by themselves with exit code 0, or 1 for a run that is not fit."""
MODULES = {
    "rig": "hilrig_sim.service hilrig_modbus_edge.service hilrig_recorder.service hilrig_monitoring.metrics_server "
    "hilrig_cli.local.local_lab",
    "console": "hilrig_console.app hilrig_console.serving hilrig_console.worker",
}
"""Modules that the processes of an extra import."""
_REQUIREMENT = re.compile(r"^([\w.-]+)(?:\[([\w,]+)\])?[^;]*(?:;(.*))?$")


def distributions_of(extra: str) -> set[str]:
    """Return the distributions that hilrig with an extra needs, and those that they need."""
    found: set[tuple[str, str]] = set()
    to_visit = [("hilrig", extra)]
    while to_visit:
        name, wanted = to_visit.pop()
        if (name, wanted) not in found:
            found.add((name, wanted))
            to_visit += _required(name, wanted)
    return {name for name, _ in found}


def _required(name: str, wanted: str) -> Iterator[tuple[str, str]]:
    """Yield the distributions that one needs, each with an extra or `""`."""
    if name == "hilrig":
        lines = PROJECT["dependencies"] + (PROJECT["optional-dependencies"][wanted] if wanted else [])
    else:
        try:
            lines = requires(name) or []
        except PackageNotFoundError:
            # Required on another platform only.
            return
    for line in lines:
        parsed = _REQUIREMENT.match(line.replace(" ", ""))
        assert parsed is not None, line
        of_extra = re.search(r"extra==['\"]([\w-]+)['\"]", parsed[3] or "")
        if of_extra is None or of_extra[1] == wanted:
            for part in {"", *(parsed[2] or "").split(",")}:
                yield _normal(parsed[1]), part


def modules_without(extra: str) -> set[str]:
    """Return the top-level modules that are installed here, but not with hilrig and this extra alone."""
    allowed = distributions_of(extra)
    return {
        module
        for module, owners in packages_distributions().items()
        if not {_normal(owner) for owner in owners} & allowed and not module.startswith(("hilrig", "_"))
    }


def _normal(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def registered() -> Iterator[tuple[str, str, str | None]]:
    """Yield module, name and panel of each command, also of groups."""
    for command in main.app.registered_commands:
        assert command.callback is not None
        yield command.callback.__module__, command.name or command.callback.__name__, command.rich_help_panel
    for group in main.app.registered_groups:
        assert isinstance(group.typer_instance, typer.Typer)
        callback = group.typer_instance.registered_commands[0].callback
        assert callback is not None
        yield callback.__module__, str(group.name), group.rich_help_panel
