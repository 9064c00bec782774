"""A recorder that is killed at any moment: what it wrote is found again, and what was sent is not lost."""

import random
import time
from itertools import pairwise
from pathlib import Path

import pytest

from recorder_rig import RecorderProcess, files_of, make_lab, metadata, recorded, sending, times, wait_ready
from waiting import eventually

KILLS = times("HILRIG_RECORDER_KILLS", 4)
CACHED_S = 8.0
"""What was sent so long ago its sender still has, with something to spare."""


@pytest.mark.rig
@pytest.mark.timeout(60 + 10 * KILLS)
def test_kill_9_at_random_moments_loses_nothing_that_was_sent(tmp_path: Path) -> None:
    seed = random.randrange(1 << 30)
    print(f"seed {seed}")
    rng = random.Random(seed)
    config, lab = make_lab(tmp_path, rigs=3)
    rigs = [rig.name for rig in lab.rigs]
    with sending(lab, rigs) as senders:
        killed_s = away_s = 0.0
        for number in range(KILLS):
            with RecorderProcess(config) as recorder:
                wait_ready(lab, recorder)
                if number:
                    away_s = max(away_s, time.monotonic() - killed_s)
                else:
                    for rig in rigs:
                        senders.begin(rig)
                time.sleep(rng.uniform(0, 2.5))
                recorder.kill()
                killed_s = time.monotonic()
        with RecorderProcess(config) as recorder:
            wait_ready(lab, recorder)
            away_s = max(away_s, time.monotonic() - killed_s)
            for rig in rigs:
                senders.end(rig)
            for rig in rigs:
                eventually(lambda rig=rig: files_of(lab, rig) and not files_of(lab, rig, "*.part"), timeout_s=20)
    for rig in rigs:
        paths = files_of(lab, rig)
        found = recorded(paths)
        sent = senders.sent[rig]
        assert len(found) == len(set(found)), f"{rig}: something was recorded twice"
        missing = set(sent) - set(found)
        about = f"{rig}: {len(missing)} of {len(sent)} missing, the recorder was away for {away_s:.1f} s"
        if away_s < CACHED_S:
            assert not missing, about
        # A machine so busy that the recorder took longer to come back than the senders' caches reach: it says so.
        summaries = [metadata(path)["hilrig.summary"] for path in paths]
        stated = sum(int(summary["lost_recorder"]) + int(summary["lost_transport"]) for summary in summaries)
        assert len(missing) <= stated, f"{about}, {stated} stated"
        assert metadata(paths[-1])["hilrig.summary"]["ended"] == "ended"
        for before, path in pairwise(paths):
            assert metadata(path)["hilrig.session"]["previous"] == before.name
            assert metadata(before)["hilrig.summary"]["ended"] == "recovered"
