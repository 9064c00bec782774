"""Loading of recordings: all fields are read as written, and each defect of a file has a clear error message."""

from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType

from hilrig_replay.io.columns import COMMAND_DTYPE, STATE_DTYPE
from hilrig_replay.io.run import open_run
from hilrig_runtime.errors import InputError
from hilrig_schemas import Event, JointState, TorqueCommand
from support.recordings import START_WALL_NS, Script, TimedMessage, make, record, write


@pytest.fixture(scope="module")
def made() -> list[TimedMessage]:
    return make(Script(seconds=3.0))


@pytest.fixture
def path(tmp_path: Path, made: list[TimedMessage]) -> Path:
    return write(tmp_path / "run.mcap", made)


def test_reads_all_fields_of_states(path: Path, made: list[TimedMessage]) -> None:
    run = open_run(path)
    sent = [one.message for one in made if isinstance(one.message, JointState)]
    assert len(run.states) == len(sent) == 150
    texts = {"session", "held_part"}
    for name in STATE_DTYPE.names or ():
        if name in ("log_ns", "sequence"):
            continue
        for row, message in zip(run.states, sent, strict=True):
            value = run.names[int(row[name])] if name in texts else row[name]
            expected = getattr(message, name)
            assert np.array_equal(value, expected if not hasattr(expected, "append") else list(expected)), name


def test_reads_all_fields_of_commands(path: Path, made: list[TimedMessage]) -> None:
    run = open_run(path)
    sent = [one.message for one in made if isinstance(one.message, TorqueCommand)]
    assert len(run.commands) == len(sent) > 500
    texts = {"session", "controller"}
    for name in COMMAND_DTYPE.names or ():
        if name in ("log_ns", "sequence"):
            continue
        for row, message in zip(run.commands, sent, strict=True):
            value = run.names[int(row[name])] if name in texts else row[name]
            expected = getattr(message, name)
            if name == "write_received_ns":
                expected = expected or message.write_arrived_ns
            assert np.array_equal(value, expected if not hasattr(expected, "append") else list(expected)), name


def test_reads_parts_events_and_requests(path: Path, made: list[TimedMessage]) -> None:
    run = open_run(path)
    assert set(run.names.texts(run.parts["part"])) == {"red", "blue", "green", "yellow"}
    assert list(run.events["kind"]) == ["SESSION_START", "SESSION_END"]
    assert isinstance(run.events["message"][0], Event)
    requests = run.traffic
    assert len(requests) == 2 * len(run.commands)
    assert set(requests["function"].tolist()) == {3, 16}
    answered_ns, arrived_ns = requests["answered_ns"], requests["arrived_ns"]
    assert (answered_ns - arrived_ns == 15_000).all()


def test_reads_the_metadata(path: Path) -> None:
    run = open_run(path)
    assert (run.session, run.rig, run.lab) == ("20260101T000000Z-rig1-abcd", "rig1", "lab")
    assert run.controller == "192.0.2.7:40001"
    assert run.step_ns == 20_000_000
    assert run.losses is not None
    assert (run.losses.transport, run.losses.recorder) == (0, 0)
    assert "<robot" in run.urdf


def test_time_axis_uses_the_clock_of_the_states(path: Path) -> None:
    run = open_run(path)
    times = run.time_s(run.states)
    assert times[0] == 0
    assert np.allclose(np.diff(times), 0.02, atol=2e-4)
    # The monotonic clocks of edge and simulation are unrelated: commands are placed by the wall clock.
    assert np.array_equal(run.time_ns(run.commands), run.commands["wall_ns"] - run.start_wall_ns)


def test_time_axis_continues_across_a_simulation_restart(tmp_path: Path, made: list[TimedMessage]) -> None:
    states = [one for one in made if isinstance(one.message, JointState)]
    for number, one in enumerate(states[100:]):
        message = JointState.FromString(one.message.SerializeToString())
        # A new process: steps from 1, and an unrelated clock.
        message.incarnation, message.step = 99, number + 1
        message.sampled_ns -= 4_000_000_000_000
        states[100 + number] = TimedMessage("state", one.publish_wall_ns, message)
    run = open_run(write(tmp_path / "run.mcap", states))
    assert np.allclose(np.diff(run.time_s(run.states)), 0.02, atol=2e-4)


def test_blocks_contain_the_complete_run(path: Path) -> None:
    run = open_run(path)
    blocks = list(run.blocks(rows=100))
    assert len(blocks) > 5
    assert np.array_equal(np.concatenate([block.states for block in blocks]), run.states)
    assert np.array_equal(np.concatenate([block.commands for block in blocks]), run.commands)
    assert np.array_equal(np.concatenate([block.traffic for block in blocks]), run.traffic)


def test_reads_a_time_range(path: Path) -> None:
    run = open_run(path)
    between = run.between(1.0, 2.0)
    low, high = START_WALL_NS + int(1e9), START_WALL_NS + int(2e9)
    times = between.states["wall_ns"]
    assert len(times) == 50
    assert times.min() >= low
    assert times.max() < high + 100_000
    assert 0 < len(between.commands) < len(run.commands) / 2


@pytest.mark.parametrize("compression", list(CompressionType))
def test_reads_all_mcap_compressions(tmp_path: Path, made: list[TimedMessage], compression: CompressionType) -> None:
    assert len(open_run(write(tmp_path / "run.mcap", made, compression=compression)).states) == 150


def test_reports_a_missing_file(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"run\.mcap: no such file"):
        open_run(tmp_path / "run.mcap")


def test_reports_a_folder(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"expected a recording \(\.mcap\), found a folder"):
        open_run(tmp_path)


@pytest.mark.parametrize(
    ("content", "words"), [(b"", "the file is empty"), (b"# not a recording\n" * 9, "not an MCAP file")]
)
def test_reports_a_file_of_another_format(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "run.mcap"
    path.write_bytes(content)
    with pytest.raises(InputError, match=words):
        open_run(path)


def test_truncated_file_error_names_the_recover_command(tmp_path: Path, made: list[TimedMessage]) -> None:
    path = write(tmp_path / "run.mcap.part", made, finish=False)
    with pytest.raises(InputError, match=r"still being written, or truncated.*`hilrig recover .*run\.mcap\.part`"):
        open_run(path)


def test_reports_a_file_truncated_at_any_position(path: Path) -> None:
    whole = path.read_bytes()
    cut = path.with_name("cut.mcap")
    for size in range(0, len(whole) - 1, max(1, len(whole) // 40)):
        cut.write_bytes(whole[:size])
        with pytest.raises(InputError):
            open_run(cut)


def test_checksum_detects_a_flipped_bit(path: Path) -> None:
    whole = bytearray(path.read_bytes())
    whole[len(whole) // 3] ^= 0x40
    path.write_bytes(whole)
    with pytest.raises(InputError, match=r"damaged.*hilrig recover"):
        for _ in open_run(path).blocks():
            pass


def test_reports_a_recording_without_states(tmp_path: Path, made: list[TimedMessage]) -> None:
    path = write(tmp_path / "run.mcap", [one for one in made if one.topic == "event"])
    with pytest.raises(InputError, match=r"empty recording: it contains no state of the arm \(2 other messages\)"):
        open_run(path)


def test_reports_a_newer_schema_version(tmp_path: Path, made: list[TimedMessage]) -> None:
    path = write(tmp_path / "run.mcap", made, schema_version="hilrig.v2")
    with pytest.raises(
        InputError, match=r"recorded with message schemas hilrig\.v2, but this version reads hilrig\.v1"
    ):
        open_run(path)


def test_losses_are_unknown_without_metadata(tmp_path: Path) -> None:
    script = Script(seconds=1.0)
    path = write(tmp_path / "run.mcap", make(script), metadata={"hilrig.summary": {"ended": "recovered"}})
    run = open_run(path)
    assert run.losses is None
    assert run.recovered


def test_opens_a_run_without_a_controller(tmp_path: Path) -> None:
    run = open_run(record(tmp_path / "run.mcap", Script(seconds=1.0, controllers=False)))
    assert len(run.states) == 50
    assert len(run.commands) == 0
    assert run.controller == ""
