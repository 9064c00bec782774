"""Faults in a lab on five hosts around a router: the torque becomes zero, and the loop recovers automatically.

docs/several-hosts.md documents the guarantees.
"""

import json
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from hilrig_runtime.config.lab import load_lab
from hilrig_runtime.messaging.recording_stream import MAX_CACHE_S
from support.multi_host_lab import (
    HILRIG,
    STEP_S,
    TIMEOUT_NS,
    TOLERANCE_NS,
    ControllerSession,
    MultiHostLab,
    time_to_zero_ns,
)
from support.namespaces import Network, require_namespaces
from support.waiting import LONG_TIMEOUT_S, eventually

pytestmark = [pytest.mark.hosts, pytest.mark.rig]

COMMANDS = {
    "router": ["router", "--listen", "tcp/0.0.0.0:7447"],
    "sim": ["sim"],
    "edge": ["edge"],
    "recorder": ["recorder"],
}


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[MultiHostLab]:
    require_namespaces()
    folder = tmp_path_factory.mktemp("lab")
    config = folder / "lab.toml"
    config.write_text(
        f"[bus]\ntopology = 'router'\nrouter = 'tcp/router:7447'\n[edge]\nhost = '0.0.0.0'\nsession_grace_ms = 0\n"
        f"[recorder]\nfolder = '{folder / 'recordings'}'\n"
    )
    with Network(["router", "sim", "edge", "recorder", "pc"]) as network:
        made = MultiHostLab(network, config, load_lab(config), COMMANDS)
        for host in COMMANDS:
            made.start(host)
        yield made


UNBATCHED_NS = 1_000_000_000
"""Last messages of a killed simulation that it had not sent to the recorder, or that the recorder had not written."""
FETCH_S = 1.0
"""Time in which a recorder that is ready fetches the messages of its outage; on a loaded machine of two processors."""
LOST = {"edge": "no states since ", "sim": "no command received for ", "recorder": "no messages of "}
"""Begin of the text of an outage, in the recording and in the log of each service."""


def test_loop_recovers_after_router_restart(lab: MultiHostLab) -> None:
    def count(host: str, text: str) -> int:
        return lab.log(host).read_text().count(text)

    outages = {"edge": 1, "sim": 1, "recorder": 2}
    """Log messages of each service: one, of the recorder one for each stream."""
    ended = {host: count(host, "received again") for host in LOST}
    logged = {host: count(host, text) for host, text in LOST.items()}
    with ControllerSession(lab) as session:
        killed_ns = lab.kill("router")
        time.sleep(2.0)  # the duration of the outage: longer than every time-out
        lab.start("router")
        lab.wait_for_closed_loop(15)
        back_ns = time.monotonic_ns()
        eventually(
            lambda: all(count(host, "received again") >= ended[host] + outages[host] for host in LOST), every_s=0.1
        )
    states = session.states()
    assert time_to_zero_ns(states, killed_ns) <= TIMEOUT_NS + TOLERANCE_NS
    recovered = states[states["sampled_ns"] > back_ns]
    assert np.abs(recovered["effort"]).max() > 0, "no torque after the recovery"
    steps = np.diff(states["step"].astype(np.int64))
    assert steps.max() == 1, "states of the outage are missing: the simulation must send them again"
    [lost], [_] = session.event_texts("STATE_LOST"), session.event_texts("STATE_BACK")
    assert lost.startswith(LOST["edge"])
    [lost], [_] = session.event_texts("COMMAND_LOST"), session.event_texts("COMMAND_BACK")
    assert lost.startswith(LOST["sim"])
    recorded = [text.partition(" since ")[0] for text in session.event_texts("RECORDING")]
    missing = [f"messages of {service}" for service in ("edge/1", "sim/1")]
    assert sorted(recorded) == [
        *(f"{messages} received again" for messages in missing),
        *(f"no {messages}" for messages in missing),
    ]
    assert {host: count(host, text) - logged[host] for host, text in LOST.items()} == outages


@pytest.mark.parametrize(
    "cut_s",
    [
        1.0,
        5.0,
        pytest.param(
            60.0,
            marks=[
                pytest.mark.long("runs for two minutes"),
                pytest.mark.timeout(300),
            ],
        ),
    ],
)
def test_loop_recovers_after_simulation_link_cut(lab: MultiHostLab, cut_s: float) -> None:
    with ControllerSession(lab) as session:
        lab.network.set_link("sim", False)
        cut_ns = time.monotonic_ns()
        time.sleep(cut_s)  # the duration of the cut is under test
        linked_ns = time.monotonic_ns()
        lab.network.set_link("sim", True)
        lab.wait_for_closed_loop(30)
        back_ns = time.monotonic_ns()
    states = session.states()
    recovered = states[states["sampled_ns"] > back_ns]
    assert np.abs(recovered["effort"]).max() > 0
    alone = states[(states["sampled_ns"] > cut_ns + TIMEOUT_NS + TOLERANCE_NS) & (states["sampled_ns"] < linked_ns)]
    if cut_s > 1:
        assert len(alone) > 100
    assert not alone["effort"].any(), "torque was applied without a link to the edge"
    missing = int((np.diff(states["step"].astype(np.int64)) - 1).sum())
    if cut_s < 10:
        assert time_to_zero_ns(states, cut_ns) <= TIMEOUT_NS + TOLERANCE_NS
        assert missing == session.reported_lost() == 0, "messages are missing in the recording"
    else:
        retained_s = MAX_CACHE_S - 1.0
        assert 0 < missing <= (cut_s - retained_s) / STEP_S, "messages of the last 30 s of the cut are missing"
        assert session.reported_lost() >= missing, "the recording reports too few lost messages"


def test_controllers_detect_simulation_host_failure(lab: MultiHostLab) -> None:
    with ControllerSession(lab) as session:
        killed_ns = lab.kill("sim")
        eventually(lambda: not lab.receives_states(), timeout_s=5, every_s=0.1)
        assert time.monotonic_ns() - killed_ns < 3_000_000_000
        lab.start("sim")
        lab.wait_for_closed_loop(20)
    states = session.states()
    assert len(np.unique(states["incarnation"])) == 2
    incarnation, sampled_ns = states["incarnation"], states["sampled_ns"]
    newest = states[(incarnation == incarnation[-1]) & (sampled_ns < session.end_ns)]
    assert np.abs(newest["effort"]).max() > 0, "no torque in the restarted simulation"
    assert session.answered > 50


def test_edge_failure_zeroes_torque(lab: MultiHostLab) -> None:
    with ControllerSession(lab) as session:
        killed_ns = lab.kill("edge")
        time.sleep(1.5)  # the duration of the outage
        lab.start("edge")
        lab.wait_for_closed_loop(20)
        time.sleep(1.0)  # the recording shall have torques after the recovery
    states = session.states()
    assert time_to_zero_ns(states, killed_ns) <= TIMEOUT_NS + TOLERANCE_NS
    recovered = states[states["sampled_ns"] > killed_ns + 2 * TIMEOUT_NS]
    assert np.abs(recovered["effort"]).max() > 0, "the controller did not reconnect"


def test_recorder_failure_does_not_affect_the_loop(lab: MultiHostLab) -> None:
    with ControllerSession(lab) as session:
        killed_ns = lab.kill("recorder")
        time.sleep(1.5)  # the duration of the outage
        lab.start("recorder")
        eventually(lab.unfinished)
    states = session.states()
    after = states[(states["sampled_ns"] > killed_ns) & (states["sampled_ns"] < session.end_ns)]
    assert len(after) > 50
    assert (np.abs(after["effort"]).max(axis=1) > 0).all(), "the torque was interrupted during the recorder outage"
    assert np.diff(states["step"].astype(np.int64)).max() == 1, "messages of the outage are missing"


RECORDER_OUTAGE_S = 3.7


@pytest.mark.long("takes 30 s")
@pytest.mark.timeout(120)
@pytest.mark.parametrize("is_fetched", [True, False])
def test_simulation_killed_after_a_recorder_failure(lab: MultiHostLab, is_fetched: bool) -> None:
    with ControllerSession(lab) as session:
        recorder_killed_ns = lab.kill("recorder")
        time.sleep(RECORDER_OUTAGE_S)  # the duration of the outage
        if is_fetched:
            ready = lab.log("recorder").read_text().count("ready:")
            lab.start("recorder")
            eventually(lambda: lab.log("recorder").read_text().count("ready:") > ready, every_s=0.02)
            time.sleep(FETCH_S)  # the recorder fetches the messages of the outage
        killed_ns = lab.kill("sim")
        if not is_fetched:
            lab.start("recorder")
        eventually(lambda: not lab.receives_states(), timeout_s=5, every_s=0.1)
        lab.start("sim")
        lab.wait_for_closed_loop(20)
    states = session.states()
    before = states[states["incarnation"] == states["incarnation"][0]]
    assert np.diff(before["step"].astype(np.int64)).max() == 1
    silent_ns = killed_ns - int(before["sampled_ns"][-1])
    if is_fetched:
        assert silent_ns < UNBATCHED_NS, "messages of the outage are missing"
        assert session.reported_lost() == 0
    else:
        outage_ns = killed_ns - recorder_killed_ns
        assert outage_ns <= silent_ns <= outage_ns + UNBATCHED_NS
        lost = silent_ns / 1e9 / STEP_S
        assert lost - 1 <= session.reported_lost() <= lost + UNBATCHED_NS / 1e9 / STEP_S


@pytest.mark.long("takes 15 s")
def test_two_labs_on_one_router_are_isolated(lab: MultiHostLab) -> None:
    other = lab.config.parent / "other.toml"
    other.write_text(lab.config.read_text().replace("[bus]", 'name = "other"\n[bus]', 1))
    simulation = lab.network.popen("sim", [HILRIG, "sim", "-c", str(other)], stdin=subprocess.PIPE)

    def services(config: Path) -> list[str]:
        done = lab.run("pc", "top", "-c", str(config), "--json")
        return [] if done.returncode else [row["service"] for row in json.loads(done.stdout)["services"]]

    eventually(lambda: services(other) == ["sim"], every_s=0.2)
    assert services(lab.config) == ["edge", "recorder", "sim"]
    second = lab.run("sim", "sim", "-c", str(lab.config), "--instance", "2")
    assert second.returncode == 3
    assert "already serves rig1; each rig has one sim" in second.stderr
    simulation.terminate()
    assert simulation.wait(LONG_TIMEOUT_S) == 0
