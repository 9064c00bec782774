"""The files of one session: each number once, whatever became of those before."""

from pathlib import Path

import pytest

from hilrig_recorder.mcap_format.channels import CHANNEL_OF_TOPIC, EVENT_CHANNEL
from hilrig_recorder.mcap_format.recover import Tail
from hilrig_recorder.storage.segments import horizon_of, next_part

SESSION = "20260101T000000Z-rig1-abcd"


@pytest.mark.parametrize(
    ("there", "number", "previous"),
    [
        ([], 1, None),
        (["mcap"], 2, "mcap"),
        (["mcap.part"], 2, "mcap"),
        (["mcap", "2.mcap", "3.mcap.part"], 4, "3.mcap"),
        # The first were deleted by the rules of keeping, while the session goes on.
        (["9.mcap", "10.mcap"], 11, "10.mcap"),
        (["mcap", "2.recovered.mcap", "mcap.verified", "2.mcap.recovering"], 2, "mcap"),
    ],
)
def test_a_session_goes_on_behind_its_last_file(
    tmp_path: Path, there: list[str], number: int, previous: str | None
) -> None:
    for name in there:
        (tmp_path / f"{SESSION}.{name}").touch()
    (tmp_path / "20260101T000000Z-rig1-other.7.mcap").touch()
    (tmp_path / "7.mcap").touch()
    part = next_part(tmp_path, SESSION)
    assert part.number == number
    assert part.path.name == (f"{SESSION}.mcap" if number == 1 else f"{SESSION}.{number}.mcap")
    assert (part.previous and part.previous.name) == (previous and f"{SESSION}.{previous}")


def test_a_rig_without_a_folder_begins_with_the_first(tmp_path: Path) -> None:
    assert next_part(tmp_path / "rig1", SESSION).number == 1


def test_what_is_older_than_what_was_looked_at_is_not_recorded_again() -> None:
    state, command = CHANNEL_OF_TOPIC["state"], CHANNEL_OF_TOPIC["command"]
    seen = {(state, 7, 1_000), (state, 6, 980), (command, 3, 940), (command, 4, 960), (EVENT_CHANNEL, 1, 990)}
    horizon_ns = horizon_of(Tail("", seen, {}, 0))
    # Each channel by its sender's clock; of events, and of what was not seen, all that is older than everything.
    assert horizon_ns == {
        state: 980,
        command: 940,
        EVENT_CHANNEL: 940,
        CHANNEL_OF_TOPIC["traffic"]: 940,
    }
    assert set(horizon_of(Tail("", set(), {}, 0)).values()) == {0}


def test_a_file_that_was_moved_away_keeps_its_number(tmp_path: Path) -> None:
    part = next_part(tmp_path, SESSION, f"{SESSION}.2.mcap")
    assert (part.number, part.path.name) == (3, f"{SESSION}.3.mcap")
    assert part.previous is not None
    assert part.previous.name == f"{SESSION}.2.mcap"


def test_a_folder_that_can_not_be_looked_into_is_not_taken_for_empty(tmp_path: Path) -> None:
    (tmp_path / "rig1").touch()
    with pytest.raises(NotADirectoryError):
        next_part(tmp_path / "rig1", SESSION)
