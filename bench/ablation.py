"""Ablation study: measures the effect of each optimization of the services.

Each optimization is disabled alone, some together, and all together, alternating with the unchanged version in one run,
so that a slow phase of the machine affects all variants. A lab of 1, 16, 64 and 128 rigs is polled at 50 Hz as in
`scale.py`; one controller polls without pauses at steps of 20, 5 and 1 ms as in `loop.py`; two connections read and
write at 50, 100 and 200 Hz, compared with a libmodbus server, as in `modbus.py`. The variants are functions in
`variants/`.
"""

import argparse
import json
import os
import statistics
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from harness import HERE, build_c, write_lab
from loop import log, rig_run
from modbus import run_modbus_client
from modbus_servers import serving_c
from scale import run_lab
from steal import StealMonitor

sys.path.append(str(HERE / "variants"))
from variants import VARIANTS  # type: ignore[attr-defined]  # a folder of the same name is found by mypy

from hilrig_cli.local.local_lab import running_lab

COUNTS = (1, 16, 64, 128)
RATES = (50, 100, 200)
STEPS_MS = (20.0, 5.0, 1.0)
Figures = dict[str, float]


@contextmanager
def variant(name: str) -> Iterator[None]:
    """Make child processes that are started in this context run as the variant."""
    before = os.environ.get("PYTHONPATH", "")
    os.environ["HILRIG_BENCH_VARIANT"] = name
    os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, (str(HERE / "variants"), before)))
    try:
        yield
    finally:
        del os.environ["HILRIG_BENCH_VARIANT"]
        os.environ["PYTHONPATH"] = before


def rigs(load: Path, count: int, seconds: float) -> Figures:
    """Measure a lab of `count` rigs."""
    found = run_lab(load, count, 1, seconds)
    return {
        f"{count} rigs: within one step, %": 100 * float((found.steps <= 1).mean()),
        f"{count} rigs: longest hold, steps": float(found.longest_hold),
        f"{count} rigs: read p50, us": found.load["read_us"]["p50"],
        f"{count} rigs: read p99, us": found.load["read_us"]["p99"],
        f"{count} rigs: CPU load per rig, mcore": 1e3 * sum(found.cpu_s.values()) / found.wall_s / count,
        f"{count} rigs: CPU steal, CPUs": found.steal,
    }


def loop(client: Path, step_ms: float, seconds: float) -> Figures:
    """Measure the loop of one controller that polls without pauses."""
    run = rig_run(client, step_ms, seconds)
    ms = run.samples["loop"] / 1e6
    return {f"{step_ms:g} ms: loop p{p:g}, ms": float(np.percentile(ms, p)) for p in (50, 99, 99.9)} | {
        f"{step_ms:g} ms: cycles, 1/s": run.figures["cycles_per_s"],
        f"{step_ms:g} ms: edge CPU time per cycle, us": run.edge_us,
        f"{step_ms:g} ms: CPU steal, CPUs": run.steal,
    }


def reads(client: Path, rate: int, seconds: float) -> Figures:
    """Measure the read times of two connections."""
    with tempfile.TemporaryDirectory() as folder:
        lab, config, port = write_lab(Path(folder), rigs=2)
        with running_lab(lab, config, log, threading.Event()), StealMonitor() as steal:
            figures = run_modbus_client(client, port, 1, 2, seconds, rate)
    return _reads(figures, rate, steal)


def reads_of_libmodbus(client: Path, server: Path, rate: int, seconds: float) -> Figures:
    """Measure the read times of two connections to the libmodbus server."""
    with serving_c(server) as (port, step, _), StealMonitor() as steal:
        figures = run_modbus_client(client, port, step, 2, seconds, rate)
    return _reads(figures, rate, steal)


def _reads(figures: dict[str, Any], rate: int, steal: StealMonitor) -> Figures:
    read_us = figures["read_us"]
    return {
        f"{rate} Hz: read p50, us": read_us["p50"],
        f"{rate} Hz: read p99, us": read_us["p99"],
        f"{rate} Hz: CPU steal, CPUs": steal.mean_cpus,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=3, help="number of runs of each variant")
    parser.add_argument("--seconds", type=float, default=8.0, help="duration of each measurement, s")
    parser.add_argument("--only", default="", help="variants, separated by semicolons; empty: all")
    parser.add_argument("--what", default="rigs,loop,reads", help="measurements, separated by commas")
    parser.add_argument("--counts", default=",".join(map(str, COUNTS)), help="numbers of rigs, separated by commas")
    parser.add_argument("--json", type=Path, help="append each result to this file, one JSON object per line")
    options = parser.parse_args()
    names = [name for name in options.only.split(";") if name] or list(VARIANTS)
    if unknown := set(names) - VARIANTS.keys():
        parser.error(f"unknown variant: {', '.join(sorted(unknown))}; available: {'; '.join(VARIANTS)}")
    what, counts = options.what.split(","), tuple(map(int, options.counts.split(",")))
    load, server = build_c("scale_load.c", library=""), build_c("modbus_server.c")
    fast, equal = build_c("loop_client.c"), build_c("modbus_client.c")
    jobs: list[Callable[[], Figures]] = []
    if "rigs" in what:
        jobs += [partial(rigs, load, count, options.seconds) for count in counts]
    if "loop" in what:
        jobs += [partial(loop, fast, step_ms, options.seconds) for step_ms in STEPS_MS]
    if "reads" in what:
        jobs += [partial(reads, equal, rate, options.seconds) for rate in RATES]
    found: dict[str, dict[str, list[float]]] = {}

    def note(name: str, figures: Figures) -> None:
        for metric, value in figures.items():
            found.setdefault(metric, {}).setdefault(name, []).append(value)
        if options.json:
            with options.json.open("a") as file:
                file.write(json.dumps({"variant": name, **figures}) + "\n")

    for run in range(options.runs):
        for job in jobs:
            for name in names if run % 2 == 0 else reversed(names):
                print(f"run {run + 1}: {name}", file=sys.stderr, flush=True)
                with variant(name):
                    note(name, job())
        if "reads" in what:
            for rate in RATES:
                note("libmodbus", reads_of_libmodbus(equal, server, rate, options.seconds))
    columns = [*names, *(["libmodbus"] if "reads" in what else [])]
    print("| figure | " + " | ".join(columns) + " |")
    print("|---" * (len(columns) + 1) + "|")
    for metric, by_name in found.items():
        cells = (f"{statistics.median(by_name[name]):.4g}" if name in by_name else "" for name in columns)
        print(f"| {metric} | " + " | ".join(cells) + " |")
    return 0


if __name__ == "__main__":
    sys.exit(main())
