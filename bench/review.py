"""Measures how long `hilrig latency`, `replay` and `report` take for a one-hour recording.

The recording (one rig at 50 Hz, a controller at 50 Hz, all requests) is generated once from a script. Each command runs
in its own process, whose peak memory is measured. The peer is the standard MCAP reader, which iterates over the same
file and discards the messages.
"""

import json
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from harness import Report, progress, run

ROOT = Path(__file__).parents[1]
HOUR_S = 3600.0
RUNS = 3
MAX_LATENCY_S, MAX_REPLAY_S, MAX_REPORT_S, MAX_MEMORY_MB, MAX_RATIO = 8.0, 15.0, 15.0, 500.0, 2.0

STANDARD_READER = """
import sys
from mcap.reader import make_reader
with open(sys.argv[1], "rb") as stream:
    print(sum(1 for _ in make_reader(stream).iter_messages()))
"""
WRAPPER = """
import json, resource, subprocess, sys
subprocess.run(sys.argv[1:], stdout=subprocess.DEVNULL)
peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
print(json.dumps({"peak_mb": peak / (1024 * 1024 if sys.platform == "darwin" else 1024)}))
"""


def make_hour(path: Path, seconds: float) -> int:
    """Write the recording and return the number of its messages."""
    sys.path.insert(0, str(ROOT / "tests"))
    from support.recordings import Script, make, write

    script = Script(seconds=seconds, poll_ms=20.0, delay_ms=3.0)
    messages = make(script)
    write(path, messages, script=script)
    return len(messages)


def timed(command: list[str]) -> tuple[float, float]:
    """Return the wall time of a process, s, and its peak memory, MB."""
    began = time.perf_counter()
    wrapper = [sys.executable, "-c", WRAPPER, *command]
    done = subprocess.run(wrapper, check=True, capture_output=True, text=True)
    took = time.perf_counter() - began
    return took, float(json.loads(done.stdout)["peak_mb"])


def measure(report: Report, quick: bool) -> None:
    """Time each command on the recording."""
    with tempfile.TemporaryDirectory() as folder:
        file, out = Path(folder) / "hour.mcap", Path(folder)
        messages = make_hour(file, HOUR_S / 12 if quick else HOUR_S)
        report.add("recording", "messages", messages, "")
        report.add("recording", "size", file.stat().st_size / 1e6, "MB")
        hilrig = [sys.executable, "-m", "hilrig_cli"]
        commands = {
            "standard MCAP reader": [sys.executable, "-c", STANDARD_READER, str(file)],
            "latency": [*hilrig, "latency", str(file), "--json"],
            "replay": [*hilrig, "replay", str(file), "--save", str(out / "hour.rrd")],
            "report": [*hilrig, "report", str(file), "--out", str(out / "hour.html")],
        }
        seconds_of: dict[str, float] = {}
        peaks: dict[str, float] = {}
        for name, command in commands.items():
            progress(name)
            figures = [timed(command) for _ in range(1 if quick else RUNS)]
            seconds_of[name] = report.add(name, "time", statistics.median(took for took, _ in figures), "s")
            peaks[name] = report.add(name, "peak memory", max(peak for _, peak in figures), "MB")
        report.add("replay", "size", (out / "hour.rrd").stat().st_size / 1e6, "MB")
        report.add("report", "size", (out / "hour.html").stat().st_size / 1e6, "MB")
    ratio = seconds_of["latency"] / seconds_of["standard MCAP reader"]
    report.require("latency of one hour, ratio to the standard MCAP reader", ratio, "<=", MAX_RATIO)
    report.require("latency of one hour", seconds_of["latency"], "<=", MAX_LATENCY_S, "s")
    report.require("replay of one hour into a file", seconds_of["replay"], "<=", MAX_REPLAY_S, "s")
    report.require("report of one hour", seconds_of["report"], "<=", MAX_REPORT_S, "s")
    peak_mb = max(peaks[name] for name in ("latency", "replay", "report"))
    report.require("peak memory", peak_mb, "<=", MAX_MEMORY_MB, "MB")


if __name__ == "__main__":
    sys.exit(run(measure, "How long does the analysis of a one-hour recording take?"))
