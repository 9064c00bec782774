"""Input files of any size, nesting and content are refused with the defect, in limited time and memory."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zstandard
from mcap.opcode import Opcode
from mcap.writer import Writer

from hilrig_recorder.mcap_format.reader import buffer_reader
from hilrig_recorder.mcap_format.recover import recover
from hilrig_recorder.mcap_format.scan import scan
from hilrig_replay.analysis.index import INDEX_NAME, RunIndex
from hilrig_replay.analysis.latency import measure
from hilrig_replay.export.export import export_foxglove, export_tables
from hilrig_replay.grading.task_loading import recorded_task
from hilrig_replay.io.columns import COMMAND_DTYPE, STATE_DTYPE
from hilrig_replay.io.recording_file import MAX_CHANNELS
from hilrig_replay.io.run import open_run
from hilrig_replay.io.timebase import Timebase
from hilrig_replay.plots.latency_plot import save_plot
from hilrig_replay.rerun_view.view import save_rrd
from hilrig_runtime.config.impairment import read_trace
from hilrig_runtime.config.lab import load_lab, parse_lab
from hilrig_runtime.config.validation import MAX_TEXT_BYTES, parse_toml, read_text
from hilrig_runtime.errors import InputError
from hilrig_sim.arm.model import MAX_JSON_CHARACTERS, RigParameters
from hilrig_study.study_config import load_study
from support import recordings
from support.labs import hilrig
from support.recordings import PARAMETERS, Script

SCRIPT = Script(seconds=0.5)
NESTED = "x = " + "[" * 200_000


def with_metadata(path: Path, record: str, **values: str) -> Path:
    before = {"config": {"step_ns": "20000000", "parameters_json": PARAMETERS.to_json()}}
    metadata = {f"hilrig.{record}": before.get(record, {}) | values}
    return recordings.write(path, recordings.make(SCRIPT), script=SCRIPT, metadata=metadata, configured=False)


@pytest.mark.parametrize("load", [load_lab, load_study])
def test_deeply_nested_toml_is_refused(tmp_path: Path, load: object) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(NESTED)
    with pytest.raises(InputError, match=r"lab\.toml: invalid TOML: nested too deeply"):
        load(path)  # type: ignore[operator]


@pytest.mark.parametrize("load", [load_lab, load_study, read_trace])
def test_large_text_is_refused(tmp_path: Path, load: object) -> None:
    path = tmp_path / "lab.toml"
    with path.open("wb") as file:
        file.truncate(50_000_000)
    with pytest.raises((InputError, ValueError), match=r"lab\.toml: can't be read: larger than 8 MiB"):
        load(path)  # type: ignore[operator]


def test_endless_device_is_not_read_to_its_end() -> None:
    with pytest.raises(InputError, match="larger than"):
        read_text(Path("/dev/zero"))


def test_text_of_the_largest_size_is_read(tmp_path: Path) -> None:
    path = tmp_path / "lab.toml"
    path.write_bytes(b"#" * MAX_TEXT_BYTES)
    assert load_lab(path).name


def test_integer_with_thousands_of_digits_is_refused() -> None:
    with pytest.raises(InputError, match=r"^lab\.toml: invalid TOML: "):
        parse_lab("x = " + "9" * 5000)


def test_check_reports_nesting_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "lab.toml").write_text(NESTED)
    done = hilrig("check", tmp_path / "lab.toml")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)


def test_nested_recorded_task_is_refused(tmp_path: Path) -> None:
    path = recordings.write(tmp_path / "run.mcap", recordings.make(SCRIPT), script=SCRIPT, lab_toml=NESTED)
    with pytest.raises(InputError, match=r"run\.mcap: recorded lab\.toml: invalid TOML: nested too deeply"):
        recorded_task(open_run(path))


@pytest.mark.parametrize("number", ["-1", "0", str(1 << 64), "9" * 400, "1e7", "", "x", "٣"])
def test_impossible_step_is_damage_and_can_be_recovered(tmp_path: Path, number: str) -> None:
    path = with_metadata(tmp_path / "run.mcap", "config", step_ns=number)
    with pytest.raises(InputError, match=r"damaged \(metadata hilrig\.config: step_ns is .*, expected 1 to"):
        open_run(path)
    recovery = recover(path, tmp_path / "new.mcap")
    assert recovery.damaged_bytes > 0
    # Without a recorded duration it is estimated from the states.
    assert measure(open_run(tmp_path / "new.mcap")).step_ms == 20


@pytest.mark.parametrize("number", ["-1", str(1 << 64), "9" * 400, "1" * 5000, "nan"])
@pytest.mark.parametrize(
    ("record", "key"), [("session", "part"), ("session", "start_wall_ns"), ("summary", "lost_transport")]
)
def test_impossible_numbers_are_damage(tmp_path: Path, record: str, key: str, number: str) -> None:
    path = with_metadata(tmp_path / "run.mcap", record, **{key: number})
    with pytest.raises(InputError, match=rf"damaged \(metadata hilrig\.{record}: {key} is "):
        open_run(path)
    [entry] = RunIndex(tmp_path).load()
    assert f"damaged (metadata hilrig.{record}: {key} is " in entry.error
    assert len(entry.error) < 250


def test_session_of_a_million_characters_is_damage(tmp_path: Path) -> None:
    path = with_metadata(tmp_path / "run.mcap", "session", session="s" * 1_000_000)
    with pytest.raises(InputError, match=r"session has 1000000 characters, expected at most 1000") as raised:
        open_run(path)
    assert len(str(raised.value)) < 500
    [entry] = RunIndex(tmp_path).load()
    assert "characters, expected at most" in entry.error


@pytest.mark.parametrize(
    ("text", "defect"),
    [
        ("[" * 10_000, "recursion"),
        ('{"arm":' * 10_000, "recursion"),
        ("9" * 400, "expected an object with the keys arm, sim, scene"),
        ("9" * 5000, "digits"),
        (" " * (MAX_JSON_CHARACTERS + 1), "expected at most"),
        ('{"arm": {}, "sim": {"step_ns": -1}, "scene": {}}', "step_ns must be an integer from 1 to"),
        ('{"arm": {}, "sim": {"step_ns": true}, "scene": {}}', "step_ns must be an integer from 1 to"),
        ('{"arm": {"l1": 1e400}, "sim": {}, "scene": {}}', "l1 must be a number up to 1e+10, got inf"),
        ('{"arm": {"l1": NaN}, "sim": {}, "scene": {}}', "l1 must be a number up to 1e+10, got nan"),
        ('{"arm": {"l1": 1' + "0" * 400 + '}, "sim": {}, "scene": {}}', "l1 must be a number up to 1e+10"),
        ('{"arm": {"masses": [1]}, "sim": {}, "scene": {}}', "masses must be a list of 3 items"),
        ('{"arm": {"other": 1}, "sim": {}, "scene": {}}', "arm must be an object with the keys"),
        ('{"arm": {}, "sim": {"integrator": "x"}, "scene": {}}', "integrator must be one of"),
        ('{"arm": {}, "sim": {}, "scene": {"parts": [1]}}', "parts must be an object with the keys"),
    ],
)
def test_malformed_parameters_are_refused(text: str, defect: str) -> None:
    with pytest.raises(InputError) as raised:
        RigParameters.from_json(text)
    assert defect in str(raised.value)
    assert len(str(raised.value)) < 400


def test_parameters_are_read_without_loss() -> None:
    assert RigParameters.from_json(PARAMETERS.to_json()) == PARAMETERS
    assert RigParameters.from_json(PARAMETERS.to_json()).to_json() == PARAMETERS.to_json()
    assert json.loads(PARAMETERS.to_json()).keys() == {"arm", "sim", "scene"}


def test_nested_index_is_rebuilt(tmp_path: Path) -> None:
    recordings.record(tmp_path / "run.mcap", SCRIPT)
    (tmp_path / INDEX_NAME).write_text("[" * 100_000)
    (tmp_path / "run.mcap.verified").write_text("[" * 100_000)
    [entry] = RunIndex(tmp_path).load()
    assert (entry.error, entry.verified) == ("", None)


@pytest.mark.parametrize(
    "text",
    [
        "[[task.poses]]\nname = 'a'\nposition_mm = [1e308, 0, 0]",
        "[task.path]\npoints_mm = [[0, 0, 0], [0, -1e308, 0]]",
        "[task]\ntime_limit_s = 1e308\nplace = {}",
    ],
)
def test_recorded_number_beyond_all_settings_is_refused(tmp_path: Path, text: str) -> None:
    path = recordings.write(tmp_path / "run.mcap", recordings.make(SCRIPT), script=SCRIPT, lab_toml=text)
    with pytest.raises(InputError, match=r"recorded lab\.toml: invalid task: .*must be [≤≥] -?1e\+?10, got"):
        recorded_task(open_run(path))


@pytest.mark.filterwarnings("error")
def test_step_of_ten_seconds_is_evaluated_without_a_warning(tmp_path: Path) -> None:
    assert measure(open_run(with_metadata(tmp_path / "run.mcap", "config", step_ns="10000000000"))).step_ms == 10_000


def test_recording_with_thousands_of_channels_is_damaged(tmp_path: Path) -> None:
    with (tmp_path / "run.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        for number in range(MAX_CHANNELS + 1):
            writer.register_channel(f"/{number}", "protobuf", 0)
        writer.finish()
    with pytest.raises(InputError, match=rf"damaged \(more than {MAX_CHANNELS} channels\)"):
        open_run(tmp_path / "run.mcap")


@pytest.mark.parametrize("wall_ns", [-(1 << 63), (1 << 63) - 1, 0])
def test_extreme_stamps_are_evaluated(tmp_path: Path, wall_ns: int) -> None:
    made = recordings.make(SCRIPT)
    for one in made:
        if one.topic in ("state", "command"):
            one.message.wall_ns = wall_ns  # type: ignore[attr-defined]
    path = recordings.write(tmp_path / "run.mcap", made, script=SCRIPT)
    assert measure(open_run(path)).samples > 0


@pytest.mark.timeout(10)
def test_steps_and_restarts_at_each_state_take_little_time() -> None:
    states, commands = np.zeros(10_000, STATE_DTYPE), np.zeros(10_000, COMMAND_DTYPE)
    states["step"] = states["incarnation"] = np.arange(10_000)
    states["sampled_ns"] = commands["wall_ns"] = 20_000_000 * np.arange(10_000)
    # The wall clock is set by a quarter of an hour at each state.
    states["wall_ns"] = states["sampled_ns"] + 10**12 * (np.arange(10_000) % 2) + 1
    timebase = Timebase()
    timebase.update(states)
    assert (len(timebase.time_ns(states)), len(timebase.time_ns(commands))) == (10_000, 10_000)


@pytest.mark.parametrize(("topic", "field"), [("state", "position"), ("command", "effort"), ("part", "x")])
@pytest.mark.parametrize("number", [float("nan"), float("inf")])
def test_infinite_number_is_refused_with_its_name(tmp_path: Path, topic: str, field: str, number: float) -> None:
    made = recordings.make(SCRIPT)
    message: Any = next(one.message for one in made if one.topic == topic.replace("part", "state"))
    if topic == "part":
        message.parts[0].x = number
    else:
        getattr(message, field)[2] = number
    path = recordings.write(tmp_path / "run.mcap", made, script=SCRIPT)
    with pytest.raises(InputError, match=rf"run\.mcap: unusable content: {field} is {number}; expected finite"):
        measure(open_run(path))


@pytest.mark.parametrize("sign", [1, -1])
def test_differences_of_impossible_times_are_bounded(tmp_path: Path, sign: int) -> None:
    made = recordings.make(SCRIPT)
    for number, one in enumerate(one for one in made if one.topic == "state"):
        state: Any = one.message
        state.sampled_ns = (-sign if number % 2 else sign) * ((1 << 63) - 1)
        state.wall_ns = -(1 << 63)
        state.step = (1 << 64) - 1 - number
    run = open_run(recordings.write(tmp_path / "run.mcap", made, script=SCRIPT))
    measure(run)
    export_tables(run, tmp_path / "tables", "csv")
    export_foxglove(run, tmp_path / "drawn.mcap")
    save_rrd(run, tmp_path / "run.rrd")


def test_impossible_loop_latency_is_plotted(tmp_path: Path) -> None:
    made = recordings.make(SCRIPT)
    for one in made:
        if one.topic == "state":
            one.message.loop_latency_ns = (1 << 63) - 1  # type: ignore[attr-defined]
    run = open_run(recordings.write(tmp_path / "run.mcap", made, script=SCRIPT))
    save_plot(measure(run), run, tmp_path / "run.png")
    assert (tmp_path / "run.png").stat().st_size > 10_000


def test_number_too_large_for_its_column_is_damage(tmp_path: Path) -> None:
    made = recordings.make(SCRIPT)
    state = next(one for one in made if one.topic == "state")
    state.message.limit_flags = 70_000  # type: ignore[attr-defined]
    path = recordings.write(tmp_path / "run.mcap", made, script=SCRIPT)
    with pytest.raises(InputError, match=r"damaged \(a message can't be decoded"):
        open_run(path)


def test_statistics_with_impossible_times_are_damage(tmp_path: Path) -> None:
    data = bytearray(recordings.record(tmp_path / "good.mcap", SCRIPT).read_bytes())
    reader = buffer_reader(bytes(data))
    (at,) = (record.offset for record in reader.summary_records(reader.summary()) if record.opcode == Opcode.STATISTICS)
    # The last message, after five counts and the time of the first message.
    struct.pack_into("<Q", data, at + 9 + 8 + 2 + 4 * 4 + 8, (1 << 64) - 1)
    data[-12:-8] = bytes(4)
    (tmp_path / "run.mcap").write_bytes(data)
    with pytest.raises(InputError, match=r"damaged \(statistics record with times"):
        open_run(tmp_path / "run.mcap")


def test_chunk_of_a_gigabyte_is_not_expanded(tmp_path: Path) -> None:
    stream = zstandard.ZstdCompressor().compressobj(size=1 << 30)
    block = bytes(1 << 20)
    packed = b"".join(stream.compress(block) for _ in range(1024)) + stream.flush()
    head = struct.pack("<QQQII4sQ", 0, 1, 1 << 30, 0, 4, b"zstd", len(packed))
    data = recordings.record(tmp_path / "good.mcap", SCRIPT).read_bytes()
    data = data[:8] + struct.pack("<BQ", 6, len(head) + len(packed)) + head + packed + data[8:]
    found = [item for _, item in scan(data)]
    assert any("1073741824 bytes uncompressed; expected" in getattr(item, "reason", "") for item in found)
    (tmp_path / "run.mcap").write_bytes(data)
    assert recover(tmp_path / "run.mcap", tmp_path / "new.mcap").messages > 0


@pytest.mark.parametrize("text", ["a" + ".a" * 20_000 + " = 1", "x = {a" + ".a" * 20_000 + " = 1}"])
def test_key_of_thousands_of_parts_is_refused(text: str) -> None:
    with pytest.raises(InputError, match="nested too deeply"):
        parse_toml(text, "lab.toml")
