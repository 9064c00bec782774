"""A secured lab on six hosts, attacked: a flood on one edge, certificates that are wrong, one that ends meanwhile.

What is promised here stands in docs/operations.md.
"""

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from hilrig_runtime.config.lab import load_lab
from hilrig_runtime.security.x509 import Credential, issue_peer
from support.bus_certificates import bad_identities, folder_of_one, make_bus_folder, write
from support.lab_of_hosts import HILRIG, SLACK_NS, TIMEOUT_NS, LabOfHosts, Rig, Session, zero_after
from support.namespaces import Network, require_namespaces
from support.waiting import PATIENT_S, eventually

pytestmark = [pytest.mark.hosts, pytest.mark.rig]

FLOODED = Rig("rig1", "east", 5020)
BESIDE = Rig("rig3", "east", 5022)
ELSEWHERE = Rig("rig2", "west", 5021)
EDGES = {"east": ["rig1", "rig3"], "west": ["rig2"]}
COMMANDS = {
    "router": ["router", "--listen", "tls/0.0.0.0:7447"],
    "sim": ["sim"],
    **{name: ["edge", "--instance", name, "--rigs", ",".join(rigs)] for name, rigs in EDGES.items()},
    "recorder": ["recorder"],
}
WATCHDOG_NS = 1_000_000_000
"""The edge's watchdog_ms."""
FLOOD_S = 6.0
FLOOD = """
import socket, struct, sys, time
request = struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, 4, 4)
end = time.monotonic() + float(sys.argv[3])
connections = []
while time.monotonic() < end:
    # As many connections as it gets, each with all requests that go into it; what is closed is opened again.
    if len(connections) < 40:
        try:
            one = socket.create_connection((sys.argv[1], int(sys.argv[2])), timeout=1)
            one.setblocking(False)
            connections.append(one)
        except OSError:
            pass
    for one in list(connections):
        try:
            one.send(request * 100)
            one.recv(65536)
        except BlockingIOError:
            pass
        except OSError:
            one.close()
            connections.remove(one)
"""


@contextmanager
def secured(folder: Path) -> Iterator[tuple[LabOfHosts, Credential]]:
    """The lab with its certificates and nothing running, and their authority."""
    require_namespaces()
    authority = make_bus_folder(folder / "bus", ["router", "sim", *EDGES, "recorder", "operator"], ["router"])
    config = folder / "lab.toml"
    config.write_text(config_of(folder, folder / "bus"))
    with Network([*COMMANDS, "pc", "stranger"]) as network:
        yield LabOfHosts(network, config, load_lab(config), COMMANDS), authority


def config_of(folder: Path, certificates: Path) -> str:
    return (
        f"[bus]\ntopology = 'router'\nrouter = 'tls/router:7447'\n[bus.tls]\nfolder = '{certificates}'\n"
        f"edges = {{east = ['rig1', 'rig3'], west = ['rig2']}}\n[edge]\nhost = '0.0.0.0'\nsession_grace_ms = 2000\n"
        f"[recorder]\nfolder = '{folder / 'recordings'}'\n[rigs]\ncount = 3\n"
    )


@pytest.fixture(scope="module")
def lab_and_authority(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[LabOfHosts, Credential]]:
    with secured(tmp_path_factory.mktemp("lab")) as (lab, authority):
        for host in COMMANDS:
            lab.start(host)
        yield lab, authority


@pytest.fixture
def lab(lab_and_authority: tuple[LabOfHosts, Credential]) -> LabOfHosts:
    return lab_and_authority[0]


def test_a_flood_on_one_rig_stops_no_other_and_no_watchdog(lab: LabOfHosts) -> None:
    with Session(lab, ELSEWHERE) as elsewhere, Session(lab, BESIDE) as beside:
        lab.comes_back(10, ELSEWHERE)
        lab.comes_back(10, BESIDE)
        begin_ns = time.monotonic_ns()
        command = [sys.executable, "-c", FLOOD, FLOODED.edge, str(FLOODED.port), str(FLOOD_S)]
        flood = lab.network.popen("stranger", command)
        time.sleep(FLOOD_S / 2)
        # In the midst of it a controller dies: its torque goes as ever.
        killed_ns = time.monotonic_ns()
        beside.controller.kill()
        assert flood.wait(FLOOD_S + 10) == 0
        end_ns = time.monotonic_ns()
    states = beside.states()
    before = states[(states["sampled_ns"] > begin_ns) & (states["sampled_ns"] < killed_ns)]
    assert len(before) > 50
    assert (np.abs(before["effort"]).max(axis=1) > 0).all(), "its neighbour at the same edge goes on"
    assert zero_after(states, killed_ns) <= WATCHDOG_NS + SLACK_NS
    states = elsewhere.states()
    during = states[(states["sampled_ns"] > begin_ns) & (states["sampled_ns"] < end_ns)]
    assert len(during) > 200
    assert (np.abs(during["effort"]).max(axis=1) > 0).all(), "the other edge does not feel it"
    assert np.diff(states["step"].astype(np.int64)).max() == 1
    with Session(lab, FLOODED):
        lab.comes_back(10, FLOODED)


def test_a_host_with_a_wrong_certificate_hears_and_moves_nothing(
    lab_and_authority: tuple[LabOfHosts, Credential], tmp_path: Path
) -> None:
    lab, authority = lab_and_authority
    wrong = bad_identities(authority)
    with Session(lab, ELSEWHERE) as session:
        lab.comes_back(10, ELSEWHERE)
        begin_ns = time.monotonic_ns()
        for number, (what, identity) in enumerate(wrong.items()):
            config = tmp_path / f"{number}.toml"
            config.write_text(
                config_of(tmp_path, folder_of_one(tmp_path / str(number), authority, "operator", identity))
            )
            done = lab.run("stranger", "top", "-c", str(config), "--json")
            assert done.returncode == 3, what
            assert "do not trust each other" in done.stderr, what
        config.write_text(config_of(tmp_path, folder_of_one(tmp_path / "sim", authority, "sim", wrong["expired"])))
        with (tmp_path / "said").open("w") as said:
            command = [HILRIG, "sim", "-c", str(config)]
            stranger = lab.network.popen("stranger", command, stdin=subprocess.PIPE, stderr=said)
        eventually(lambda: "waiting: no zenoh router answers" in Path(said.name).read_text())
        stranger.terminate()
        assert stranger.wait(PATIENT_S) == 0
    states = session.states()
    during = states[(states["sampled_ns"] > begin_ns) & (states["sampled_ns"] < session.end_ns)]
    assert len(np.unique(states["incarnation"])) == 1, "the lab's own simulation, and no other"
    assert (np.abs(during["effort"]).max(axis=1) > 0).all(), "the lab goes on"
    assert np.diff(states["step"].astype(np.int64)).max() == 1


def test_a_certificate_that_ends_while_it_is_used_ends_the_link_and_the_torque(tmp_path: Path) -> None:
    with secured(tmp_path) as (lab, authority):
        for host in ("router", "sim", "west", "recorder"):
            lab.start(host)
        # A certificate's times are whole seconds.
        ends = datetime.now(UTC).replace(microsecond=0) + timedelta(seconds=25)
        write(tmp_path / "bus", "east", issue_peer(authority, "east", ["router"], ends - timedelta(days=1), 1))
        lab.start("east")
        with Session(lab, BESIDE) as session:
            lab.comes_back(15, BESIDE)
            assert datetime.now(UTC) < ends - timedelta(seconds=2), "too slow a machine to see it"
            left_ns = round((ends - datetime.now(UTC)).total_seconds() * 1e9)
            ended_ns = time.monotonic_ns() + left_ns
            eventually(lambda: not lab.simulation_is_alive(BESIDE), timeout_s=left_ns * 1e-9 + 10, every_s=0.1)
            assert time.monotonic_ns() > ended_ns
            # Renewed, and the service started again.
            write(tmp_path / "bus", "east", issue_peer(authority, "east", ["router"], datetime.now(UTC), 30))
            lab.kill("east")
            lab.start("east")
            lab.comes_back(20, BESIDE)
        states = session.states()
        before = states[(states["sampled_ns"] < ended_ns) & (states["sampled_ns"] > ended_ns - 10**9)]
        assert (np.abs(before["effort"]).max(axis=1) > 0).all()
        # zenoh looks at the end of a certificate once a second or so.
        assert zero_after(states, ended_ns) <= 2_000_000_000 + TIMEOUT_NS + SLACK_NS
