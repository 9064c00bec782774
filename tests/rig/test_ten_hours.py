"""Commands on a recording of ten hours: each succeeds within its memory limit.

The test takes minutes, so it runs only if HILRIG_LONG is set; `bench/review.py` measures one hour.
"""

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from hilrig_schemas import Event, JointState, ModbusTraffic, TorqueCommand
from support.hilrig_process import HILRIG
from support.recordings import MS, Script, TimedMessage, make, write

pytestmark = [
    pytest.mark.real_time,
    pytest.mark.rig,
    pytest.mark.timeout(1200),
    pytest.mark.long("takes minutes"),
]

SECTION_S = 360.0
SECTIONS = 100
MAX_MEMORY_MB = 250.0
"""Limit for any length: only rerun's index of the file that it writes grows in memory, by 2 MB per hour."""
PEAK = """
import json, resource, subprocess, sys
code = subprocess.run(sys.argv[1:], stdout=subprocess.PIPE, check=False)
peak = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / (1024 * 1024 if sys.platform == "darwin" else 1024)
print(json.dumps({"code": code.returncode, "peak_mb": peak, "stdout": code.stdout.decode()}))
"""


def ten_hours() -> Iterator[TimedMessage]:
    """Repeat a section of a run; the messages are shifted in time and number for each repetition."""
    script = Script(seconds=SECTION_S, poll_ms=20.0, delay_ms=3.0)
    made = [one for one in make(script) if not isinstance(one.message, Event)]
    steps = sum(isinstance(one.message, JointState) for one in made)
    commands = sum(isinstance(one.message, TorqueCommand) for one in made)
    section_ns = steps * 20 * MS
    for section in range(SECTIONS):
        for one in made:
            if section:
                _shift(one, section_ns, steps, commands)
            yield one


def _shift(one: TimedMessage, by_ns: int, steps: int, commands: int) -> None:
    one.publish_wall_ns += by_ns
    message = one.message
    if isinstance(message, JointState):
        message.step += steps
        message.sampled_ns += by_ns
        message.wall_ns += by_ns
        if message.command_seq:
            message.command_seq += commands
        if message.basis_step:
            message.basis_step += steps
            message.command_arrived_ns += by_ns
    elif isinstance(message, TorqueCommand):
        message.seq += commands
        message.basis_step += steps
        for name in ("wall_ns", "state_arrived_ns", "state_served_ns", "write_arrived_ns", "sent_ns"):
            setattr(message, name, getattr(message, name) + by_ns)
    elif isinstance(message, ModbusTraffic):
        message.wall_ns += by_ns
        message.closed_ns += by_ns
        message.arrived_ns[:] = [arrived_ns + by_ns for arrived_ns in message.arrived_ns]


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write(tmp_path_factory.mktemp("long") / "ten.mcap", ten_hours(), script=Script(seconds=SECTION_S * SECTIONS))


@pytest.mark.parametrize("command", ["latency", "replay", "report", "export", "runs"])
def test_commands_stay_within_their_memory_limit(run: Path, command: str) -> None:
    options = {
        "latency": [run, "--json"],
        "replay": [run, "--save", run.with_suffix(".rrd")],
        "report": [run, "--out", run.with_suffix(".html"), "--json"],
        "export": [run, "--csv", run.with_suffix("")],
        "runs": [run.parent, "--loop", "--json"],
    }[command]
    arguments = [sys.executable, "-c", PEAK, *HILRIG, command, *map(str, options)]
    done = json.loads(subprocess.run(arguments, check=True, capture_output=True, text=True).stdout)
    print(f"{command}: {done['peak_mb']:.0f} MB")
    assert done["code"] == 0
    assert done["peak_mb"] < MAX_MEMORY_MB
    if command == "latency":
        # At the boundaries of sections, one or two commands do not match their states.
        assert json.loads(done["stdout"])["samples"] > 0.98 * SECTION_S * SECTIONS * 50
