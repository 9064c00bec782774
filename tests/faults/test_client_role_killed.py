"""Client role: device, edge or simulation are killed; the torque goes to zero, and the loop closes again by itself."""

import json
import os
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from hilrig_replay.io.run import open_run
from support.clients import compile_with_libmodbus
from support.labs import RunningLab, free_ports, hilrig, write_lab
from support.waiting import eventually

pytestmark = pytest.mark.rig

SERVER = Path(__file__).parents[2] / "examples/server_controller.c"


@contextmanager
def device(program: Path, port: int) -> Iterator["subprocess.Popen[bytes]"]:
    with subprocess.Popen([program, "127.0.0.1", str(port), "60"], stdout=subprocess.DEVNULL) as process:
        try:
            yield process
        finally:
            process.kill()


def test_loop_closes_again_after_each_kill(tmp_path: Path) -> None:
    program, port = compile_with_libmodbus(SERVER, tmp_path), free_ports(1)
    config = write_lab(tmp_path, extra="edge.watchdog_ms = 300\nedge.session_grace_ms = 20000")
    text = config.read_text()
    config.write_text(text.replace('"rig1"\n', f'"rig1"\ncontroller = "127.0.0.1:{port}"\nregisters.echo = 9\n'))
    with RunningLab(config) as lab:

        def status() -> dict[str, Any]:
            done = hilrig("lease", "rig1", "--json", "--config", config)
            return json.loads(done.stdout) if done.returncode == 0 else {}

        def wait_for(condition: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
            return eventually(lambda: found if (found := status()) and condition(found) else None)

        def is_closed(found: dict[str, Any]) -> bool:
            return bool(found["session"]) and not found["watchdog_tripped"] and not found["controller_fault"]

        assert wait_for(lambda found: "connection refused" in found["controller_fault"])["session"] == ""
        with device(program, port) as process:
            session = wait_for(is_closed)["session"]
            process.kill()
            process.wait()
            killed = wait_for(lambda found: bool(found["watchdog_tripped"]))
            assert "connection" in killed["controller_fault"]
        with device(program, port):
            assert wait_for(is_closed)["session"] == session
            sim = lab.service_pid("sim")
            # A killed simulation is back before its outage is reported; a stopped one is not.
            os.kill(sim, signal.SIGSTOP)
            eventually(lambda: "rig1: no states since" in lab.output())
            os.kill(sim, signal.SIGKILL)
            eventually(lambda: "rig1: states received again" in lab.output())
            assert wait_for(is_closed)["session"] == session
            edge = lab.service_pid("edge")
            os.kill(edge, signal.SIGKILL)
            assert wait_for(lambda found: is_closed(found) and found["session"] != session)
    runs = [open_run(path) for path in lab.recordings]
    [first] = [run for run in runs if run.session == session]
    trips = first.events[first.events["kind"] == "WATCHDOG_TRIP"]
    assert len(trips) >= 2
    # After each trip the edge commands zero torque, and then torques of both incarnations of the simulation.
    written = first.commands[first.commands["read_sent_ns"] > 0]
    assert len(set(written["basis_incarnation"].tolist())) == 2
