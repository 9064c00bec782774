"""What `hilrig demo` does: lab up, controller on, lab down; then latency, verification, picture and plot of the run."""

import importlib.util
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

from hilrig_cli.local.local_lab import POLL_S, running_lab, why_not_free
from hilrig_cli.local.supervisor import own_process_group
from hilrig_replay.analysis.latency import LatencyReport, measure
from hilrig_replay.analysis.verify import Verification, verify
from hilrig_replay.grading.placement import PlacementReport, evaluate_placement
from hilrig_replay.io.run import Run, open_run
from hilrig_replay.plots.latency_plot import save_plot
from hilrig_replay.rerun_view.view import save_rrd
from hilrig_runtime.config.lab import LabConfig, load_lab
from hilrig_runtime.errors import OperationError
from hilrig_schemas import PartState
from hilrig_sim.arm.model import RigParameters

CONTROLLER: Final = "pick_and_place.py"
DURATION_S: Final = 20.0
OVERTIME_S: Final = 20.0
"""What the controller may take beyond that where nobody said how long it is to run, to finish its work, s."""
CONTROLLER_GRACE_S: Final = 15.0
"""What the controller may take beyond its duration, to start and to end, s."""
LAB: Final = """# The lab of `hilrig demo`: one rig with the defaults, on ports that were free.
name = "demo"

[edge]
first_port = {modbus_port}
# The recording ends with the controller.
session_grace_ms = 0

[bus]
first_port = {bus_port}

[recorder]
folder = {folder}
"""


@dataclass(frozen=True, slots=True)
class DemoRun:
    """What a demo left behind."""

    recording: Path
    controller: dict[str, Any]
    """What the controller said at its end; empty: it ended badly."""

    @property
    def why_unfinished(self) -> str:
        """Why the controller did not do all of its work, by its own account; empty: it did."""
        if "done_s" not in self.controller:
            return "the controller ended badly"
        if self.controller["done_s"] is not None or not self.controller["missing"]:
            return ""
        return f"the controller's {self.controller['duration_s']:.0f} s were over at {self.controller['doing']!r}"


def run_demo(duration_s: float | None, out: Path, say: Callable[[str], None], tick: Callable[[float], None]) -> DemoRun:
    """Run the lab with the example controller; `tick` hears the share of its time that has passed.

    For `duration_s`; with None for 20 s, and for up to 20 s more if a busy machine has it take longer to finish.

    Raises:
        OperationError: the folder can't be written, a service could not start, or nothing was recorded.
    """
    recordings = out / "recordings"
    try:
        out.mkdir(parents=True, exist_ok=True)
        # A demo's folder holds one demo.
        shutil.rmtree(recordings, ignore_errors=True)
        config = out / "lab.toml"
        config.write_text(
            LAB.format(
                modbus_port=free_ports(5020), bus_port=free_ports(7447, 3), folder=json.dumps(str(recordings.resolve()))
            )
        )
    except OSError as error:
        raise OperationError(f"{out}: results can't be written there: {error.strerror}") from error
    lab = load_lab(config)
    stopping = threading.Event()
    say("starting simulation, Modbus edge and recorder")
    with running_lab(lab, config, say, stopping) as supervisor:
        say(f"running for {duration_s or DURATION_S:g} s: {CONTROLLER} over Modbus TCP at {lab.edge.host}:{_port(lab)}")
        said = _run_controller(lab, config, duration_s, supervisor.poll, tick)
    found = sorted(recordings.rglob("*.mcap"))
    if not found:
        raise OperationError(
            f"{recordings}: nothing was recorded: did the controller connect? It said: {said or 'nothing'}"
        )
    return DemoRun(found[-1], said)


def _port(lab: LabConfig) -> int:
    return lab.ports[lab.rigs[0].name]


def _run_controller(
    lab: LabConfig, config: Path, asked_s: float | None, poll: Callable[[], None], tick: Callable[[float], None]
) -> dict[str, Any]:
    duration_s, overtime_s = (DURATION_S, OVERTIME_S) if asked_s is None else (asked_s, 0.0)
    command = [sys.executable, str(controller_path()), "--host", lab.edge.host, "--port", str(_port(lab))]
    command += ["--duration", str(duration_s), "--overtime", str(overtime_s), "--scene", str(config), "--json"]
    begin_s = time.monotonic()
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, **own_process_group()) as process:
        try:
            while process.poll() is None:
                poll()
                passed_s = time.monotonic() - begin_s
                tick(min(1.0, passed_s / duration_s))
                if passed_s > duration_s + overtime_s + CONTROLLER_GRACE_S:
                    process.kill()
                time.sleep(POLL_S)
        except BaseException:
            process.kill()
            raise
        output = process.stdout.read() if process.stdout is not None else ""
    try:
        said = json.loads(output)
    except ValueError:
        return {}
    # 1: it ran, and did not place all.
    return said if isinstance(said, dict) and process.returncode in (0, 1) else {}


def controller_path() -> Path:
    """The example controller: of this checkout, or as it was installed with the package.

    Raises:
        OperationError: this installation has none.
    """
    beside = Path(__file__).parents[4] / "examples" / CONTROLLER
    if beside.exists():
        return beside
    spec = importlib.util.find_spec("hilrig_examples")
    for folder in (spec.submodule_search_locations or []) if spec is not None else []:
        if (path := Path(folder) / CONTROLLER).exists():
            return path
    raise OperationError(f"the example controller {CONTROLLER} is not part of this installation")


def free_ports(wanted: int, count: int = 1) -> int:
    """First of `count` neighbouring ports that are free on loopback, from `wanted` on."""
    first = wanted
    while any(why_not_free("127.0.0.1", port) for port in range(first, first + count)):
        first += count
    return first


@dataclass(frozen=True, slots=True)
class Review:
    """What a demo's recording tells."""

    run: DemoRun
    latency: LatencyReport
    verification: Verification
    task: PlacementReport
    plot: Path
    rrd: Path

    @property
    def closed(self) -> bool:
        """Whether torques came back that answered states, and re-simulation gives the states that were recorded."""
        return self.latency.samples > 0 and self.verification.same

    @property
    def missing(self) -> list[str]:
        """Names of the parts that stand in no tray."""
        return [part.part for part in self.task.parts if part.place is None]

    @property
    def why_missing(self) -> str:
        """Why they do not; empty: all stand."""
        reasons = [self.run.why_unfinished] if self.missing and self.run.why_unfinished else []
        believed = [name for name in self.missing if name not in self.run.controller.get("missing", [])]
        if believed and self.run.controller:
            reasons.append(f"the controller believed {', '.join(believed)} placed")
        return "; ".join(reasons)

    @property
    def good(self) -> bool:
        """Whether the loop closed, and no part is missing but those for which there was no time."""
        return self.closed and set(self.missing) <= set(self.run.controller.get("missing", []))

    def as_dict(self) -> dict[str, Any]:
        """As plain values, for JSON."""
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
                "why": self.why_missing,
                "largest_error_mm": self.task.largest_error_mm,
            },
            "controller": self.run.controller,
        }

    def sentences(self) -> list[str]:
        """What a person reads below the table of latency."""
        error_mm = self.task.largest_error_mm
        placed = f"placed: {self.task.placed} of {len(self.task.parts)} parts stand in the tray"
        if error_mm is not None:
            placed += f", at most {error_mm:.2f} mm from their places"
        if self.missing:
            placed += f"; not {', '.join(self.missing)}: {self.why_missing}"
        return [
            f"verified: {self.verification.sentence()}",
            placed,
            f"recording: {self.run.recording}",
            f"3D run:    {self.rrd}  (look at it: hilrig replay {self.run.recording})",
            f"plot:      {self.plot}",
        ]


def review(recorded: DemoRun, out: Path) -> Review:
    """Measure, verify and draw what a demo recorded.

    Raises:
        HilrigError: the recording holds no loop, or a result can't be written.
    """
    run = open_run(recorded.recording)
    latency = measure(run)
    plot, rrd = out / "latency.png", out / "run.rrd"
    save_plot(latency, run, plot)
    save_rrd(run, rrd)
    return Review(recorded, latency, verify(recorded.recording), judge(run), plot, rrd)


def judge(run: Run) -> PlacementReport:
    """Which parts stand in the tray at the end of a run.

    Raises:
        InputError: the recording does not say what its scene is.
    """
    parts = run.parts
    last = parts[parts["step"] == parts["step"][-1]] if len(parts) else parts
    poses = [PartState(name=run.names[row["part"]], x=row["x"], y=row["y"], z=row["z"], yaw=row["yaw"]) for row in last]
    held = run.names[run.states["held_part"][-1]]
    return evaluate_placement(RigParameters.from_json(run.parameters_json).scene, poses, held=held)
