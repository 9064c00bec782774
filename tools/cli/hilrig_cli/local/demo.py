"""The demo: runs a lab with the example controller; measures, verifies and plots the recording."""

import json
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from hilrig_cli.examples import example_path
from hilrig_cli.local.local_lab import POLL_S, free_ports, running_lab
from hilrig_cli.local.supervisor import own_process_group
from hilrig_recorder.mcap_format.file_names import MCAP_PATTERN
from hilrig_replay.analysis.latency import LatencyReport, measure
from hilrig_replay.analysis.verify import Verification, verify
from hilrig_replay.grading.placement import PlacementReport, evaluate_placement
from hilrig_replay.io.run import Run, open_run
from hilrig_replay.plots.latency_plot import save_plot
from hilrig_replay.rerun_view.view import save_rrd
from hilrig_runtime.config.lab import LabConfig, load_lab
from hilrig_runtime.errors import InputError, OperationError
from hilrig_schemas import PartState
from hilrig_sim.arm.model import RigParameters

CONTROLLER: Final = "pick_and_place.py"
DURATION_S: Final = 20.0
OVERTIME_S: Final = 20.0
"""Extra time for the controller to finish its work, if no duration was given, s."""
CONTROLLER_GRACE_S: Final = 15.0
"""Time for the controller to start and to end, besides its duration, s."""
LAB_NAME: Final = "demo"
LAB_HEADING: Final = "# The lab of `hilrig demo`: one rig with default settings, on free ports."
LAB_TEMPLATE: Final = (
    LAB_HEADING
    + """
name = "demo"

[edge]
first_port = {modbus_port}
# The recording ends when the controller disconnects.
session_grace_ms = 0

[bus]
first_port = {bus_port}

[recorder]
folder = {folder}
"""
)


@dataclass(frozen=True, slots=True)
class DemoRun:
    """Recording of a demo and the result of its controller."""

    recording: Path
    controller: dict[str, Any]
    """JSON result of the controller; empty: it failed."""

    @property
    def unfinished_reason(self) -> str:
        """Reason why the controller did not finish, as it reported itself; empty: it finished."""
        if "done_s" not in self.controller:
            return "the controller failed"
        if self.controller["done_s"] is not None or not self.controller["missing"]:
            return ""
        return f"the controller's {self.controller['duration_s']:.0f} s ended during {self.controller['doing']!r}"


def run_demo(
    duration_s: float | None, out: Path, log: Callable[[str], None], on_progress: Callable[[float], None]
) -> DemoRun:
    """Run the lab with the example controller.

    Args:
        duration_s: duration; None: 20 s, and up to 20 s more if the controller needs longer on a busy host.
        out: folder of the results.
        log: receives messages, one line each.
        on_progress: receives the elapsed share of the duration.

    Raises:
        InputError: the folder has a `lab.toml` of another lab.
        OperationError: the folder can't be written, a service could not start, or nothing was recorded.
    """
    recordings = out / "recordings"
    try:
        out.mkdir(parents=True, exist_ok=True)
        config = out / "lab.toml"
        if config.exists() and not config.read_bytes().startswith(LAB_HEADING.encode()):
            raise InputError(f"{config}: is not of a demo and is not overwritten: choose another folder with --out")
        # The folder holds the results of one demo only. Recordings of other labs are kept.
        shutil.rmtree(recordings / LAB_NAME, ignore_errors=True)
        config.write_text(
            LAB_TEMPLATE.format(
                modbus_port=free_ports(LabConfig().edge.first_port),
                bus_port=free_ports(LabConfig().bus.first_port, 3),
                folder=json.dumps(str(recordings.resolve())),
            )
        )
    except OSError as error:
        raise OperationError(f"{out}: results can't be written there: {error.strerror}") from error
    lab = load_lab(config)
    stopping = threading.Event()
    log("starting simulation, Modbus edge and recorder")
    with running_lab(lab, config, log, stopping) as supervisor:
        log(f"running {CONTROLLER} for {duration_s or DURATION_S:g} s over Modbus TCP at {lab.edge.host}:{_port(lab)}")
        result = _run_controller(lab, config, duration_s, supervisor.poll, on_progress)
    found = sorted((recordings / LAB_NAME).rglob(MCAP_PATTERN))
    if not found:
        raise OperationError(f"{recordings}: no recording: did the controller connect? Its output: {result or 'none'}")
    return DemoRun(found[-1], result)


def _port(lab: LabConfig) -> int:
    return lab.ports[lab.rigs[0].name]


def _run_controller(
    lab: LabConfig,
    config: Path,
    requested_s: float | None,
    poll: Callable[[], None],
    on_progress: Callable[[float], None],
) -> dict[str, Any]:
    duration_s, overtime_s = (DURATION_S, OVERTIME_S) if requested_s is None else (requested_s, 0.0)
    command = [sys.executable, str(example_path(CONTROLLER)), "--host", lab.edge.host, "--port", str(_port(lab))]
    command += ["--duration", str(duration_s), "--overtime", str(overtime_s), "--scene", str(config), "--json"]
    start_s = time.monotonic()
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, **own_process_group()) as process:
        try:
            while process.poll() is None:
                poll()
                elapsed_s = time.monotonic() - start_s
                on_progress(min(1.0, elapsed_s / duration_s))
                if elapsed_s > duration_s + overtime_s + CONTROLLER_GRACE_S:
                    process.kill()
                time.sleep(POLL_S)
        except BaseException:
            process.kill()
            raise
        output = process.stdout.read() if process.stdout is not None else ""
    try:
        result = json.loads(output)
    except ValueError:
        return {}
    # Exit code 1: the controller ran, but did not place every part.
    return result if isinstance(result, dict) and process.returncode in (0, 1) else {}


@dataclass(frozen=True, slots=True)
class Review:
    """Results of a demo: latency, verification, placed parts and files."""

    run: DemoRun
    latency: LatencyReport
    verification: Verification
    task: PlacementReport
    plot: Path
    rrd: Path

    @property
    def loop_closed(self) -> bool:
        """Whether torques answered states, and re-simulation reproduces the recorded states."""
        return self.latency.samples > 0 and self.verification.same

    @property
    def missing(self) -> list[str]:
        """Names of the parts that are not in a tray."""
        return [part.part for part in self.task.parts if part.place is None]

    @property
    def missing_reason(self) -> str:
        """Reason why parts are missing; empty: none is."""
        reasons = [self.run.unfinished_reason] if self.missing and self.run.unfinished_reason else []
        believed = [name for name in self.missing if name not in self.run.controller.get("missing", [])]
        if believed and self.run.controller:
            reasons.append(f"the controller reported {', '.join(believed)} as placed")
        return "; ".join(reasons)

    @property
    def passed(self) -> bool:
        """Whether the loop closed, and no part is missing except those that the controller had no time for."""
        return self.loop_closed and set(self.missing) <= set(self.run.controller.get("missing", []))

    def as_dict(self) -> dict[str, Any]:
        """The results as plain values, for JSON."""
        return {
            "recording": str(self.run.recording),
            "rrd": str(self.rrd),
            "plot": str(self.plot),
            "latency": self.latency.as_dict(),
            "verify": self.verification.as_dict(),
            "task": {
                "parts": [asdict(part) for part in self.task.parts],
                "placed": self.task.placed,
                "missing": self.missing,
                "why": self.missing_reason,
                "largest_error_mm": self.task.largest_error_mm,
            },
            "controller": self.run.controller,
        }

    def summary_lines(self) -> list[str]:
        """Lines that `hilrig demo` prints below the latency table."""
        error_mm = self.task.largest_error_mm
        placed = f"placed: {self.task.placed} of {len(self.task.parts)} parts are in the tray"
        if error_mm is not None:
            placed += f", position error at most {error_mm:.2f} mm"
        if self.missing:
            placed += f"; missing {', '.join(self.missing)}: {self.missing_reason}"
        return [
            f"verified: {self.verification.sentence()}",
            placed,
            f"recording: {self.run.recording}",
            f"3D view:   {self.rrd}  (open it: hilrig replay {self.run.recording})",
            f"plot:      {self.plot}",
        ]


def review(demo: DemoRun, out: Path) -> Review:
    """Measure, verify and plot the recording of a demo.

    Raises:
        HilrigError: the recording contains no closed loop, or a result can't be written.
    """
    run = open_run(demo.recording)
    latency = measure(run)
    plot, rrd = out / "latency.png", out / "run.rrd"
    save_plot(latency, run, plot)
    save_rrd(run, rrd)
    return Review(demo, latency, verify(demo.recording), check_placement(run), plot, rrd)


def check_placement(run: Run) -> PlacementReport:
    """Check which parts are in the tray at the end of a run.

    Raises:
        InputError: the recording does not contain its scene.
    """
    parts = run.parts
    step = parts["step"]
    last = parts[step == step[-1]] if len(parts) else parts
    poses = [PartState(name=run.names[row["part"]], x=row["x"], y=row["y"], z=row["z"], yaw=row["yaw"]) for row in last]
    held = run.names[run.states["held_part"][-1]]
    return evaluate_placement(RigParameters.from_json(run.parameters_json).scene, poses, held=held)
