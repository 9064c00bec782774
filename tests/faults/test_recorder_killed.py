"""A recorder that is killed at any moment: what it wrote is found again, and what was sent is not lost."""

import random
import time
from itertools import pairwise
from pathlib import Path

import pytest

from recorder_rig import RecorderProcess, files_of, make_lab, metadata, recorded, sending, times, wait_ready
from waiting import eventually

KILLS = times("HILRIG_RECORDER_KILLS", 4)


@pytest.mark.rig
@pytest.mark.timeout(60 + 10 * KILLS)
def test_kill_9_at_random_moments_loses_nothing_that_was_sent(tmp_path: Path) -> None:
    seed = random.randrange(1 << 30)
    print(f"seed {seed}")
    rng = random.Random(seed)
    config, lab = make_lab(tmp_path, rigs=3)
    rigs = [rig.name for rig in lab.rigs]
    with sending(lab, rigs) as senders:
        for number in range(KILLS):
            with RecorderProcess(config) as recorder:
                wait_ready(lab, recorder)
                if number == 0:
                    for rig in rigs:
                        senders.begin(rig)
                time.sleep(rng.uniform(0, 2.5))
                recorder.kill()
        with RecorderProcess(config) as recorder:
            wait_ready(lab, recorder)
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
        # The recorder is back before the senders' caches forget what it missed.
        assert not missing, f"{rig}: {len(missing)} of {len(sent)} missing, {min(missing)[:2]} to {max(missing)[:2]}"
        assert metadata(paths[-1])["hilrig.summary"]["ended"] == "ended"
        for before, path in pairwise(paths):
            assert metadata(path)["hilrig.session"]["previous"] == before.name
            assert metadata(before)["hilrig.summary"]["ended"] == "recovered"
