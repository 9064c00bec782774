"""A recorder that is killed at random times: written messages are recovered, and published messages are not lost."""

import random
import sys
import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import pytest
from mcap.reader import make_reader

from hilrig_runtime.messaging.recording_stream import MAX_CACHE_S
from hilrig_runtime.timing.clock import SYSTEM_CLOCK
from support.recorder_rig import (
    ZERO_TORQUE,
    RecorderProcess,
    files_of,
    make_lab,
    metadata,
    recorded,
    recorded_events,
    sending,
    times,
    wait_ready,
)
from support.waiting import StallMonitor, cpu_wait_s, eventually

KILLS = times("HILRIG_RECORDER_KILLS", 4)
CACHED_S = MAX_CACHE_S - 3
"""Messages of at most this age are still in the cache of their publisher, with a margin."""
LAST_S = 1.0
"""Maximum age of the messages that a killed recorder has not written yet."""
STEADY_S = 1.6
"""After this time a recorder has fetched all cached messages and written once since then."""
STAGES = 3
"""Number of processes and threads between publisher and disk that may stall."""


@dataclass(frozen=True, slots=True)
class Life:
    """The lifetime of one recorder process; wall clock, s."""

    ready_s: float
    killed_s: float
    stall_s: float
    """Longest stall of a thread of the test meanwhile."""
    waited_s: float
    """Time that the recorder waited for a processor, because other programs used all."""


@pytest.mark.long("takes 10 s")
@pytest.mark.rig
@pytest.mark.timeout(60 + 15 * KILLS)
def test_kill_9_at_random_times_loses_no_messages(tmp_path: Path) -> None:
    seed = random.randrange(1 << 30)
    print(f"seed {seed}")
    rng = random.Random(seed)
    config, lab = make_lab(tmp_path, rigs=3)
    rigs = [rig.name for rig in lab.rigs]
    lives: list[Life] = []
    with sending(lab, rigs) as senders, StallMonitor() as stalls:
        for number in range(KILLS):
            with RecorderProcess(config) as recorder:
                wait_ready(lab, recorder)
                ready_s = now_s()
                waited_s = cpu_wait_s(recorder.process.pid)
                stalls.reset()
                if not number:
                    for rig in rigs:
                        senders.begin(rig)
                time.sleep(rng.uniform(0, 2.5))
                waited_s = cpu_wait_s(recorder.process.pid) - waited_s
                recorder.kill()
                lives.append(Life(ready_s, now_s(), stalls.worst_s, waited_s))
        with RecorderProcess(config) as recorder:
            wait_ready(lab, recorder)
            lives.append(Life(now_s(), float("inf"), 0, 0))
            for rig in rigs:
                senders.end(rig)
            eventually(lambda: all(files_of(lab, rig) and not files_of(lab, rig, "*.part") for rig in rigs))
    for rig in rigs:
        paths = files_of(lab, rig)
        found = recorded(paths)
        sent = senders.sent[rig]
        assert len(found) == len(set(found)), f"{rig}: duplicate messages"
        # Payloads are unchanged. A file begins before its session and ends after it.
        assert {key for key in found if sent[0][1] <= key[1] <= sent[-1][1]} <= set(sent)
        arrivals = arrivals_of(paths)
        check_last_second(rig, lives, arrivals)
        gap_s = longest_gap(lives, arrivals)
        missing = set(sent) - set(found)
        report = f"{rig}: {len(missing)} of {len(sent)} missing; up to {gap_s:.1f} s had to be fetched"
        print(report)
        if gap_s < CACHED_S:
            assert not missing, report
        # On a busy machine a recorder may restart too late for the caches of the publishers: the files state the loss.
        summaries = [metadata(path)["hilrig.summary"] for path in paths]
        stated = sum(int(summary["lost_recorder"]) + int(summary["lost_transport"]) for summary in summaries)
        assert len(missing) <= stated, f"{report}, {stated} stated"
        assert metadata(paths[-1])["hilrig.summary"]["ended"] == "ended"
        for before, path in pairwise(paths):
            assert metadata(path)["hilrig.session"]["previous"] == before.name
            assert metadata(before)["hilrig.summary"]["ended"] == "recovered"


SHORT_CACHE = 25
"""Batches: half a second."""
RECORDER_OF_SHORT_CACHES = f"""
import sys
import hilrig_runtime.process.service as service
service.batch_cache_depth = lambda *_: {SHORT_CACHE}
from hilrig_cli.__main__ import main
main()
"""


@pytest.mark.rig
def test_event_outlasts_the_cache_of_states(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hilrig_runtime.process.service.batch_cache_depth", lambda *_: SHORT_CACHE)
    program = [sys.executable, "-c", RECORDER_OF_SHORT_CACHES]
    config, lab = make_lab(tmp_path)
    with sending(lab, ["rig1"]) as senders:
        with RecorderProcess(config, program=program) as recorder:
            wait_ready(lab, recorder)
            senders.begin("rig1")
            eventually(lambda: files_of(lab, "rig1", "*.part"))
            recorder.kill()
        senders.emit("rig1")
        sent = senders.count("rig1")
        eventually(lambda: senders.count("rig1") > sent + 4 * SHORT_CACHE)
        with RecorderProcess(config, program=program) as recorder:
            wait_ready(lab, recorder)
            eventually(lambda: len(files_of(lab, "rig1", "*.part")) + len(files_of(lab, "rig1")) == 2)
            senders.end("rig1")
            eventually(lambda: not files_of(lab, "rig1", "*.part"))
    paths = files_of(lab, "rig1")
    assert set(senders.sent["rig1"]) - set(recorded(paths)), "the outage was too short to test anything"
    assert len(recorded_events(paths, ZERO_TORQUE)) == 1


def now_s() -> float:
    """Wall clock, s; recorder and publishers are on this machine."""
    return SYSTEM_CLOCK.wall_ns() * 1e-9


def arrivals_of(paths: list[Path]) -> list[tuple[float, float]]:
    """(arrival time, publish time) of each recorded message, wall clock, s."""
    found = []
    for path in paths:
        with path.open("rb") as stream:
            found += [
                (one.log_time * 1e-9, one.publish_time * 1e-9) for _, _, one in make_reader(stream).iter_messages()
            ]
    return found


def check_last_second(rig: str, lives: list[Life], arrivals: list[tuple[float, float]]) -> None:
    """Check that the messages that a killed recorder had not written are younger than one second."""
    for life in lives:
        if STEADY_S <= life.killed_s - life.ready_s < float("inf"):
            newest_s = max(sent_s for arrived_s, sent_s in arrivals if arrived_s <= life.killed_s)
            lost_s = life.killed_s - newest_s
            assert lost_s <= LAST_S + STAGES * life.stall_s + life.waited_s, (
                f"{rig}: {lost_s:.2f} s lost, stalls of {life.stall_s:.2f} s, waited {life.waited_s:.2f} s"
            )


def longest_gap(lives: list[Life], arrivals: list[tuple[float, float]]) -> float:
    """Maximum age of the oldest message that a restarted recorder had to fetch, s."""
    gaps = [
        after.ready_s - max((sent_s for arrived_s, sent_s in arrivals if arrived_s <= before.killed_s), default=0.0)
        for before, after in pairwise(lives)
    ]
    # Before the first recorded message nothing can be missing.
    return max((gap_s for gap_s in gaps if gap_s < 1e6), default=0.0)
