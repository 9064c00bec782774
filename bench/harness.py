"""Common functions of the benchmarks: machine description, compilation of C programs, results, thresholds, output.

A benchmark answers one question, compares hilrig with a peer in the same run and reports medians of several runs. A
threshold is the value that a result must reach; it is a ratio wherever possible.
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

from hilrig_cli.local.local_lab import free_ports
from hilrig_runtime.config.lab import LabConfig, load_lab

HERE = Path(__file__).parent
BUILD = HERE / "build"


@dataclass(frozen=True, slots=True)
class Result:
    """One measured value."""

    case: str
    metric: str
    value: float
    unit: str


@dataclass(frozen=True, slots=True)
class Threshold:
    """A result that was compared with its required bound."""

    what: str
    value: float
    bound: str
    holds: bool


@dataclass
class Report:
    """Results, thresholds and notes of one benchmark run."""

    question: str
    results: list[Result] = field(default_factory=list)
    thresholds: list[Threshold] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def add(self, case: str, metric: str, value: float, unit: str) -> float:
        """Add one result and return its value."""
        self.results.append(Result(case, metric, float(value), unit))
        return float(value)

    def require(self, what: str, value: float, relation: Literal["<=", ">="], bound: float, unit: str = "") -> bool:
        """Compare a result with its required bound; return whether the bound holds."""
        holds = value <= bound if relation == "<=" else value >= bound
        self.thresholds.append(Threshold(what, float(value), f"{relation} {bound:g} {unit}".strip(), bool(holds)))
        return holds

    def add_note(self, note: str) -> None:
        """Add a sentence that explains the results."""
        self.notes.append(note)

    def as_dict(self) -> dict[str, Any]:
        """Return the report as the JSON object that `--json` prints."""
        return {
            "question": self.question,
            "machine": machine(),
            "results": [asdict(result) for result in self.results],
            "bars": [asdict(threshold) for threshold in self.thresholds],
            "notes": self.notes,
        }


def machine() -> dict[str, Any]:
    """Describe the machine on which the benchmark runs."""
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


class MissingDependencyError(Exception):
    """A program or library that the benchmark needs is not installed."""


def build_c(source: str, library: str = "libmodbus") -> Path:
    """Compile `bench/<source>`, linked with `library` unless it is empty, and return the path of the program.

    Raises:
        MissingDependencyError: the C compiler or the library is not installed; the message names the package.
    """
    if shutil.which("gcc") is None or shutil.which("pkg-config") is None:
        raise MissingDependencyError("gcc or pkg-config not found: install the packages gcc and pkg-config")
    flags: list[str] = []
    if library:
        flags_query = subprocess.run(
            ["pkg-config", "--cflags", "--libs", library], check=False, capture_output=True, text=True
        )
        if flags_query.returncode:
            raise MissingDependencyError(
                f"the development files of {library} were not found: install the package {library}-dev"
            )
        flags = flags_query.stdout.split()
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
    """Write a lab.toml with free ports that records into `folder`; return the lab, the file and the first port."""
    config = folder / "lab.toml"
    port, bus_port = free_ports(20_000, rigs), free_ports(7447, 8)
    config.write_text(
        f"[sim]\nstep_ms = {step_ms}\n[edge]\nfirst_port = {port}\nsession_grace_ms = {session_grace_ms}\n"
        f"[bus]\nfirst_port = {bus_port}\n[recorder]\nfolder = '{folder}'\n[rigs]\ncount = {rigs}\n"
    )
    return load_lab(config), config, port


def rigs_text(count: int) -> str:
    """Return a number of rigs with the noun."""
    return f"{count} rig{'s' if count != 1 else ''}"


def cpu_seconds(pid: int) -> float:
    """Return the CPU time that a process has used, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def percentile(values: Sequence[float], fraction: float) -> float:
    """Return the value below which `fraction` of `values` lie (nearest rank)."""
    ordered = sorted(values)
    return ordered[min(len(ordered) - 1, round(fraction * (len(ordered) - 1)))]


def progress(text: str) -> None:
    """Print the current activity on standard error if it is a terminal."""
    if sys.stderr.isatty():
        print(f"  {text}", file=sys.stderr, flush=True)


@contextmanager
def services_log(path: Path) -> Iterator[None]:
    """Redirect the standard error of child processes into a file; this process still writes to the terminal."""
    sys.stderr.flush()
    original_fd = os.dup(2)
    before = sys.stderr
    with path.open("ab") as log, os.fdopen(original_fd, "w", buffering=1) as stream:
        os.dup2(log.fileno(), 2)
        sys.stderr = stream
        try:
            yield
        finally:
            sys.stderr = before
            os.dup2(original_fd, 2)


def run(measure: Callable[[Report, bool], None], question: str) -> int:
    """Run a benchmark as a command: measure and print.

    Exit code 1: a threshold does not hold; 3: a dependency is missing.
    """
    parser = argparse.ArgumentParser(description=question)
    parser.add_argument("--json", action="store_true", help="print one JSON object only")
    parser.add_argument(
        "--quick", action="store_true", help="fewer and shorter runs: a test of the benchmark, not for results"
    )
    arguments = parser.parse_args()
    report = Report(question)
    try:
        measure(report, arguments.quick)
    except MissingDependencyError as error:
        print(f"the benchmark can't run: {error}", file=sys.stderr)
        return 3
    if arguments.json:
        print(json.dumps(report.as_dict(), indent=1))
    else:
        _print_table(report)
    return 0 if all(threshold.holds for threshold in report.thresholds) else 1


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
    table = Table("threshold", "measured", "bound", "holds")
    for threshold in report.thresholds:
        holds = "yes" if threshold.holds else "[red]no[/red]"
        table.add_row(threshold.what, f"{threshold.value:,.4g}", threshold.bound, holds)
    console.print(table)
    for note in report.notes:
        console.print(note)
