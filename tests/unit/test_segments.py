"""The segments of one session: each number is used once, even if earlier files are gone."""

from pathlib import Path

import pytest

from hilrig_recorder.mcap_format.channels import CHANNEL_OF_TOPIC, EVENT_CHANNEL
from hilrig_recorder.mcap_format.recover import SegmentTail
from hilrig_recorder.storage.segments import horizon_by_channel, next_segment

SESSION = "20260101T000000Z-rig1-abcd"


@pytest.mark.parametrize(
    ("existing", "number", "previous"),
    [
        ([], 1, None),
        (["mcap"], 2, "mcap"),
        (["mcap.part"], 2, "mcap"),
        (["mcap", "2.mcap", "3.mcap.part"], 4, "3.mcap"),
        # The first segments were deleted by the retention rules during the session.
        (["9.mcap", "10.mcap"], 11, "10.mcap"),
        (["mcap", "2.recovered.mcap", "mcap.verified", "2.mcap.recovering"], 2, "mcap"),
    ],
)
def test_next_segment_follows_the_last_file(
    tmp_path: Path, existing: list[str], number: int, previous: str | None
) -> None:
    for name in existing:
        (tmp_path / f"{SESSION}.{name}").touch()
    (tmp_path / "20260101T000000Z-rig1-other.7.mcap").touch()
    (tmp_path / "7.mcap").touch()
    segment = next_segment(tmp_path, SESSION)
    assert segment.number == number
    assert segment.path.name == (f"{SESSION}.mcap" if number == 1 else f"{SESSION}.{number}.mcap")
    assert (segment.previous and segment.previous.name) == (previous and f"{SESSION}.{previous}")


def test_first_segment_without_a_folder(tmp_path: Path) -> None:
    assert next_segment(tmp_path / "rig1", SESSION).number == 1


def test_horizon_is_the_earliest_known_publish_time() -> None:
    state, command = CHANNEL_OF_TOPIC["state"], CHANNEL_OF_TOPIC["command"]
    seen = {(state, 7, 1_000), (state, 6, 980), (command, 3, 940), (command, 4, 960), (EVENT_CHANNEL, 1, 990)}
    horizon_ns = horizon_by_channel(SegmentTail("", seen, {}, 0))
    # State and command: their own earliest time. Events and channels without messages: the earliest of all.
    assert horizon_ns == {
        state: 980,
        command: 940,
        EVENT_CHANNEL: 940,
        CHANNEL_OF_TOPIC["traffic"]: 940,
    }
    assert set(horizon_by_channel(SegmentTail("", set(), {}, 0)).values()) == {0}


def test_moved_segment_keeps_its_number(tmp_path: Path) -> None:
    segment = next_segment(tmp_path, SESSION, f"{SESSION}.2.mcap")
    assert (segment.number, segment.path.name) == (3, f"{SESSION}.3.mcap")
    assert segment.previous is not None
    assert segment.previous.name == f"{SESSION}.2.mcap"


def test_folder_that_cannot_be_listed_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "rig1").touch()
    with pytest.raises(NotADirectoryError):
        next_segment(tmp_path / "rig1", SESSION)
