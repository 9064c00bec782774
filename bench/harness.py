"""What every benchmark shares: the machine, C programs built on the spot, figures and bars, a table or JSON.

A benchmark answers one question, compares with a peer in the same run and takes medians of several runs. A *bar* is
what the project promises, as a ratio wherever it can be one.
"""

import argparse
import json
import os
import platform
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

from hilrig_cli.local.demo import free_ports
from hilrig_runtime.config.lab import LabConfig, load_lab

HERE = Path(__file__).parent
BUILD = HERE / "build"


@dataclass(frozen=True, slots=True)
class Result:
    case: str
    metric: str
    value: float
    unit: str


@dataclass(frozen=True, slots=True)
class Bar:
    what: str
    value: float
    bound: str
    holds: bool


@dataclass
class Report:
    """What a benchmark found."""

    question: str
    results: list[Result] = field(default_factory=list)
    bars: list[Bar] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def add(self, case: str, metric: str, value: float, unit: str) -> float:
        """Note one figure; gives it back."""
        self.results.append(Result(case, metric, float(value), unit))
        return float(value)

    def bar(self, what: str, value: float, relation: Literal["<=", ">="], bound: float, unit: str = "") -> bool:
        """Hold a figure against what is promised."""
        holds = value <= bound if relation == "<=" else value >= bound
        self.bars.append(Bar(what, float(value), f"{relation} {bound:g} {unit}".strip(), bool(holds)))
        return holds

    def say(self, note: str) -> None:
        """Add a sentence that the figures need, for example what is missing on this machine."""
        self.notes.append(note)

    def as_dict(self) -> dict[str, Any]:
        return {
            "question": self.question,
            "machine": machine(),
            "results": [asdict(result) for result in self.results],
            "bars": [asdict(bar) for bar in self.bars],
            "notes": self.notes,
        }


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    libraries = ("eclipse-zenoh", "pymodbus", "numpy", "mcap", "protobuf", "rerun-sdk")
    return {
        "system": platform.platform(),
        "processor": _processor(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "libraries": {name: version(name) for name in libraries},
    }


def _processor() -> str:
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        for line in cpuinfo.read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor()


class MissingPartError(Exception):
    """A system part that the benchmark needs is not on this machine."""


def build_c(source: str, library: str = "libmodbus") -> Path:
    """Compile `bench/<source>` against a library, or against none; gives the program.

    Raises:
        MissingPartError: there is no C compiler or no libmodbus; the message says which package brings it.
    """
    if shutil.which("gcc") is None or shutil.which("pkg-config") is None:
        raise MissingPartError("no C compiler: install gcc and pkg-config (Debian's packages of these names)")
    flags: list[str] = []
    if library:
        asked = subprocess.run(
            ["pkg-config", "--cflags", "--libs", library], check=False, capture_output=True, text=True
        )
        if asked.returncode:
            raise MissingPartError(f"no {library} to build with: install Debian's package {library}-dev")
        flags = asked.stdout.split()
    BUILD.mkdir(exist_ok=True)
    program = BUILD / Path(source).stem
    path = HERE / source
    if not program.exists() or program.stat().st_mtime < path.stat().st_mtime:
        command = [
            "gcc",
            "-O2",
            "-Wall",
            "-Wextra",
            "-o",
            str(program),
            str(path),
            *flags,
            "-lm",
            "-lpthread",
        ]
        subprocess.run(command, check=True)
    return program


def write_lab(
    folder: Path, *, rigs: int = 1, step_ms: float = 20.0, session_grace_ms: float = 0.0
) -> tuple[LabConfig, Path, int]:
    """A lab whose ports are free and that records into `folder`: the lab, its file there, its first rig's port."""
    config = folder / "lab.toml"
    port, bus_port = free_ports(20_000, rigs), free_ports(7447, 8)
    config.write_text(
        f"[sim]\nstep_ms = {step_ms}\n[edge]\nfirst_port = {port}\nsession_grace_ms = {session_grace_ms}\n"
        f"[bus]\nfirst_port = {bus_port}\n[recorder]\nfolder = '{folder}'\n[rigs]\ncount = {rigs}\n"
    )
    return load_lab(config), config, port


def cpu_seconds(pid: int) -> float:
    """Processor time that a process has used, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def percentile(values: Sequence[float], share: float) -> float:
    """The value below which `share` of `values` lie (nearest rank)."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, round(share * (len(ordered) - 1)))]


def progress(text: str) -> None:
    """Say on standard error what runs now, where somebody watches."""
    if sys.stderr.isatty():
        print(f"  {text}", file=sys.stderr, flush=True)


@contextmanager
def services_log(path: Path) -> Iterator[None]:
    """What processes that are started meanwhile say on standard error goes into a file; what we say does not."""
    sys.stderr.flush()
    ours = os.dup(2)
    before = sys.stderr
    with path.open("ab") as log, os.fdopen(ours, "w", buffering=1) as said:
        os.dup2(log.fileno(), 2)
        sys.stderr = said
        try:
            yield
        finally:
            sys.stderr = before
            os.dup2(ours, 2)


def run(measure: Callable[[Report, bool], None], question: str) -> int:
    """Command line of a benchmark: measure, print; exit code 1 when a bar does not hold, 3 when a part is missing."""
    parser = argparse.ArgumentParser(description=question)
    parser.add_argument("--json", action="store_true", help="print one JSON object and nothing else")
    parser.add_argument("--quick", action="store_true", help="fewer and shorter runs: for trying out, not for figures")
    arguments = parser.parse_args()
    report = Report(question)
    try:
        measure(report, arguments.quick)
    except MissingPartError as error:
        print(f"can't measure here: {error}", file=sys.stderr)
        return 3
    if arguments.json:
        print(json.dumps(report.as_dict(), indent=1))
    else:
        _print_table(report)
    return 0 if all(bar.holds for bar in report.bars) else 1


def _print_table(report: Report) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console()
    about = machine()
    console.print(f"[bold]{report.question}[/bold]")
    console.print(f"{about['processor']}, {about['cores']} cores, Python {about['python']}")
    table = Table("case", "metric", "value", "unit")
    for result in report.results:
        table.add_row(result.case, result.metric, f"{result.value:,.4g}", result.unit)
    console.print(table)
    bars = Table("promise", "measured", "bound", "holds")
    for bar in report.bars:
        bars.add_row(bar.what, f"{bar.value:,.4g}", bar.bound, "yes" if bar.holds else "[red]no[/red]")
    console.print(bars)
    for note in report.notes:
        console.print(note)
