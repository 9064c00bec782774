"""A recorder that is killed at any moment: what it wrote is found again, and what was sent is not lost."""

import random
import time
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import pytest
from mcap.reader import make_reader

from hilrig_runtime.messaging.recording_stream import LONGEST_KEPT_S
from hilrig_runtime.timing.clock import SYSTEM_CLOCK
from support.recorder_rig import RecorderProcess, files_of, make_lab, metadata, recorded, sending, times, wait_ready
from support.waiting import Stalls, eventually

KILLS = times("HILRIG_RECORDER_KILLS", 4)
CACHED_S = LONGEST_KEPT_S - 3
"""What was sent so long ago its sender still has, with something to spare."""
LAST_S = 1.0
"""What a recorder that is killed may not have written yet."""
STEADY_S = 1.6
"""A recorder that has been there so long has caught up, and written once since then."""
STAGES = 3
"""On a message's way to the disk each of so many processes and threads may be held up by the machine."""


@dataclass(frozen=True, slots=True)
class Life:
    """One recorder's; wall clock, s."""

    ready_s: float
    killed_s: float
    stall_s: float
    """For how long the machine kept a thread waiting meanwhile, at worst."""


@pytest.mark.rig
@pytest.mark.timeout(60 + 15 * KILLS)
def test_kill_9_at_random_moments_loses_nothing_that_was_sent(tmp_path: Path) -> None:
    seed = random.randrange(1 << 30)
    print(f"seed {seed}")
    rng = random.Random(seed)
    config, lab = make_lab(tmp_path, rigs=3)
    rigs = [rig.name for rig in lab.rigs]
    lives: list[Life] = []
    with sending(lab, rigs) as senders, Stalls() as stalls:
        for number in range(KILLS):
            with RecorderProcess(config) as recorder:
                wait_ready(lab, recorder)
                ready_s = now_s()
                stalls.forget()
                if not number:
                    for rig in rigs:
                        senders.begin(rig)
                time.sleep(rng.uniform(0, 2.5))
                recorder.kill()
                lives.append(Life(ready_s, now_s(), stalls.worst_s))
        with RecorderProcess(config) as recorder:
            wait_ready(lab, recorder)
            lives.append(Life(now_s(), float("inf"), 0))
            for rig in rigs:
                senders.end(rig)
            for rig in rigs:
                eventually(lambda rig=rig: files_of(lab, rig) and not files_of(lab, rig, "*.part"))
    for rig in rigs:
        paths = files_of(lab, rig)
        found = recorded(paths)
        sent = senders.sent[rig]
        assert len(found) == len(set(found)), f"{rig}: something was recorded twice"
        # Byte for byte what was sent; a file begins before its session and ends after it.
        assert {key for key in found if sent[0][1] <= key[1] <= sent[-1][1]} <= set(sent)
        arrivals = arrivals_of(paths)
        judge_last_second(rig, lives, arrivals)
        gap_s = longest_gap(lives, arrivals)
        missing = set(sent) - set(found)
        about = f"{rig}: {len(missing)} of {len(sent)} missing; up to {gap_s:.1f} s had to be fetched"
        print(about)
        if gap_s < CACHED_S:
            assert not missing, about
        # A machine so busy that recorders took longer to come back than the senders' caches reach: the files say so.
        summaries = [metadata(path)["hilrig.summary"] for path in paths]
        stated = sum(int(summary["lost_recorder"]) + int(summary["lost_transport"]) for summary in summaries)
        assert len(missing) <= stated, f"{about}, {stated} stated"
        assert metadata(paths[-1])["hilrig.summary"]["ended"] == "ended"
        for before, path in pairwise(paths):
            assert metadata(path)["hilrig.session"]["previous"] == before.name
            assert metadata(before)["hilrig.summary"]["ended"] == "recovered"


def now_s() -> float:
    """Wall clock, s: recorder and senders are on this machine."""
    return SYSTEM_CLOCK.wall_ns() * 1e-9


def arrivals_of(paths: list[Path]) -> list[tuple[float, float]]:
    """When each message that was recorded arrived, and when it was sent; wall clock, s."""
    found = []
    for path in paths:
        with path.open("rb") as stream:
            found += [
                (one.log_time * 1e-9, one.publish_time * 1e-9) for _, _, one in make_reader(stream).iter_messages()
            ]
    return found


def judge_last_second(rig: str, lives: list[Life], arrivals: list[tuple[float, float]]) -> None:
    """What a recorder that was killed had not written is younger than a second."""
    for life in lives:
        if STEADY_S <= life.killed_s - life.ready_s < float("inf"):
            newest_s = max(sent_s for arrived_s, sent_s in arrivals if arrived_s <= life.killed_s)
            torn_s = life.killed_s - newest_s
            assert torn_s <= LAST_S + STAGES * life.stall_s, (
                f"{rig}: {torn_s:.2f} s torn, stalls of {life.stall_s:.2f} s"
            )


def longest_gap(lives: list[Life], arrivals: list[tuple[float, float]]) -> float:
    """How old the oldest message was at worst that a recorder which came back had to fetch, s."""
    gaps = [
        after.ready_s - max((sent_s for arrived_s, sent_s in arrivals if arrived_s <= before.killed_s), default=0.0)
        for before, after in pairwise(lives)
    ]
    # Before anything was recorded there is nothing that could be missing.
    return max((gap_s for gap_s in gaps if gap_s < 1e6), default=0.0)
