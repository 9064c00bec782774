"""The rerun viewer on a virtual display: it shows the arm, its table and the plots of a recording."""

import ctypes
import os
import shutil
import signal
import socket
import subprocess
import time
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from hilrig_replay.io.run import open_run
from hilrig_replay.rerun_view.view import save_rrd, send_runs
from hilrig_replay.rerun_view.viewer import environment, executable, free_port, running_viewer
from support.browser import share_of
from support.hilrig_process import HILRIG
from support.recordings import Script, record
from support.waiting import LONG_TIMEOUT_S, eventually

pytestmark = pytest.mark.rig

DRIVERS = sorted(Path("/usr/share/vulkan/icd.d").glob("lvp_icd*.json"))
"""Software Vulkan drivers of Debian's mesa-vulkan-drivers; in Debian 12 their names contain the architecture."""

LIBRARIES = {
    "libvulkan.so.1": "libvulkan1",
    "libxkbcommon-x11.so.0": "libxkbcommon-x11-0",
    "libXcursor.so.1": "libxcursor1",
    "libXi.so.6": "libxi6",
}
"""Libraries that the viewer loads at run time to open a window, with their Debian packages."""


@pytest.fixture(scope="module")
def rrd(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("viewer")
    save_rrd(open_run(record(folder / "run.mcap", Script(seconds=6.0))), folder / "run.rrd")
    return folder / "run.rrd"


def require_display() -> None:
    """Skip the test, with a reason, if the viewer can't open a window on a virtual display."""
    missing = [name for name, package in LIBRARIES.items() if not is_loadable(name)]
    if missing:
        pytest.skip(f"needs {', '.join(missing)} (Debian's packages {', '.join(LIBRARIES[name] for name in missing)})")
    if shutil.which("xvfb-run") is None or shutil.which("xauth") is None or not DRIVERS:
        pytest.skip("needs xvfb-run, xauth and a software Vulkan driver (Debian's xvfb, xauth, mesa-vulkan-drivers)")


def is_loadable(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


@pytest.mark.long("takes 10 s")
def test_screenshot_shows_arm_table_and_plots(rrd: Path, tmp_path: Path) -> None:
    require_display()
    shot = tmp_path / "shot.png"
    command = ["xvfb-run", "-a", "-s", "-screen 0 4000x3000x24", str(executable()), str(rrd)]
    command += ["--screenshot-to", str(shot), "--window-size", "1000x600"]
    drivers = os.pathsep.join(map(str, DRIVERS))
    environ = {**environment(), "VK_DRIVER_FILES": drivers, "XDG_RUNTIME_DIR": str(tmp_path)}
    result = subprocess.run(command, check=False, capture_output=True, text=True, timeout=100, env=environ)
    assert shot.exists(), result.stderr
    picture = imread(shot)[..., :3]
    scene = picture[: int(0.7 * len(picture)), : int(0.55 * picture.shape[1])]
    # Colors: the table is light wood, the first link orange, the background nearly black.
    assert share_of(scene, (0.75, 1), (0.7, 1), (0.6, 0.9)) > 0.1
    assert share_of(scene, (0.6, 1), (0.35, 0.75), (0, 0.45)) > 0.004
    assert share_of(scene, (0, 0.15), (0, 0.15), (0, 0.18)) > 0.1
    curves = picture[:, int(0.6 * picture.shape[1]) :]
    assert len(np.unique((curves.reshape(-1, 3) * 7).astype(np.uint8), axis=0)) > 10


def test_web_viewer_is_on_loopback_only_and_idle(rrd: Path) -> None:
    grpc_port, web_port = free_port(), free_port()
    with running_viewer(grpc_port, web_port) as viewer:
        send_runs([open_run(rrd.with_name("run.mcap"))], grpc_port, is_closed=lambda: False)
        with urllib.request.urlopen(f"http://127.0.0.1:{web_port}/", timeout=10) as page:
            assert b"<canvas" in page.read()
        for port in (grpc_port, web_port):
            with socket.socket() as other:
                # The port is free on another address of this host, because the viewer listens on one only.
                other.bind(("127.0.0.2", port))
        # With all data received and no browser connected, the viewer is idle.
        eventually(lambda: cpu_s_of(viewer.pid, while_s=0.5) < 0.1)
        assert viewer.poll() is None
    assert viewer.poll() is not None


def test_replay_web_stops_its_viewer_on_sigterm(rrd: Path) -> None:
    command = [*HILRIG, "replay", str(rrd.with_name("run.mcap")), "--web"]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    try:
        assert process.stderr is not None
        line = process.stderr.readline()
        assert line.startswith("open http://127.0.0.1:"), line
        process.send_signal(signal.SIGTERM)
        assert process.wait(LONG_TIMEOUT_S) == 0
        eventually(lambda: not session_of(process.pid))
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
        if process.stderr is not None:
            process.stderr.close()


def cpu_s_of(process: int, while_s: float) -> float:
    """CPU time of a process within `while_s`, s."""

    def used_s() -> float:
        fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    before_s = used_s()
    time.sleep(while_s)  # the processor time within this time is measured
    return used_s() - before_s


def session_of(leader: int) -> list[int]:
    """Living processes of a process group."""
    found = subprocess.run(["pgrep", "-g", str(leader)], check=False, capture_output=True, text=True)
    return [int(pid) for pid in found.stdout.split()]
