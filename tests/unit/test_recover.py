"""Recovery of truncated and damaged files: complete chunks are kept, damaged ones are not, and nothing crashes."""

import errno
import json
import os
import random
import shutil
import struct
from dataclasses import replace
from itertools import count
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.records import Attachment, Metadata
from mcap.writer import CompressionType, Writer

from hilrig_recorder.mcap_format.channels import CHANNEL_OF_TOPIC
from hilrig_recorder.mcap_format.file_names import recovered_path
from hilrig_recorder.mcap_format.fsutil import lock_file
from hilrig_recorder.mcap_format.records import Chunk, Message, encode_message
from hilrig_recorder.mcap_format.recover import read_session_metadata, read_tail, recover
from hilrig_recorder.mcap_format.scan import SEARCH_BYTES, is_complete, read_chunk, scan
from hilrig_recorder.mcap_format.writer import RecordingWriter
from hilrig_replay.io.run import open_run
from hilrig_runtime.errors import InputError, OperationError
from support import recordings
from support.labs import hilrig
from support.recordings import Script, make

START = 1_767_225_600_000_000_000
HEADER_BYTES = 31
"""Minimum length of a file with a complete MCAP header."""
Found = tuple[int, int, int, bytes]


def good_file(path: Path, chunks: int = 40) -> list[list[Found]]:
    """Write a recording of many small chunks; returns the messages of each chunk."""
    rng = random.Random(1)
    writer = RecordingWriter(path)
    writer.add_metadata("hilrig.session", {"session": "s1", "rig": "rig1"})
    written = []
    number = 0
    for chunk in range(chunks):
        content = []
        for _ in range(rng.randrange(1, 30)):
            number += 1
            channel, log_time = rng.choice((1, 2, 3)), START + number * 1_000_000
            data = bytes(rng.randrange(4) for _ in range(rng.randrange(200)))
            writer.add(encode_message(channel, number, log_time, log_time, data))
            content.append((channel, number, log_time, data))
        writer.close_chunk()
        written.append(content)
        if chunk == chunks // 2:
            writer.add_attachment("a.txt", "text/plain", b"hello" * 100, log_time=START)
    writer.finish(lambda: {"hilrig.summary": {"ended": "ended"}})
    writer.publish()
    return written


def read(path: Path) -> list[Found]:
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        found = [(m.channel_id, m.sequence, m.log_time, m.data) for _, _, m in reader.iter_messages()]
        assert summary.statistics.message_count == len(found)
        list(reader.iter_attachments())
        list(reader.iter_metadata())
    return found


def metadata_of(path: Path) -> dict[str, dict[str, str]]:
    """Metadata records of a file, by name."""
    with path.open("rb") as stream:
        return {record.name: record.metadata for record in make_reader(stream).iter_metadata()}


def chunk_ends(path: Path) -> list[int]:
    """End offset of each chunk of a file."""
    data = path.read_bytes()
    return [
        offset + 9 + struct.unpack_from("<Q", data, offset + 1)[0]
        for offset, item in scan(data)
        if isinstance(item, Chunk)
    ]


def test_complete_file_is_not_changed(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    good_file(path)
    before = path.read_bytes()
    recovery = recover(path, tmp_path / "new.mcap")
    assert recovery.path is None
    assert path.read_bytes() == before
    assert not (tmp_path / "new.mcap").exists()


def test_all_complete_chunks_of_a_truncated_file_are_kept(tmp_path: Path) -> None:
    path, truncated, new = (tmp_path / name for name in ("run.mcap", "truncated.mcap", "new.mcap"))
    written = good_file(path)
    good, ends = path.read_bytes(), chunk_ends(path)
    seed = random.randrange(1 << 30)
    rng = random.Random(seed)
    for length in sorted({0, 1, 8, 9, *ends[:3], *(rng.randrange(len(good)) for _ in range(200))}):
        truncated.write_bytes(good[:length])
        expected = [message for end, content in zip(ends, written, strict=True) if end <= length for message in content]
        if length < HEADER_BYTES:
            with pytest.raises(InputError, match=r"not an MCAP file|without a complete record"):
                recover(truncated, new)
            continue
        recovery = recover(truncated, new)
        assert read(new) == expected, f"seed {seed}, truncated at {length}"
        assert recovery.messages == len(expected)
        assert truncated.read_bytes() == good[:length]
        new.unlink()


def test_only_intact_chunks_of_a_corrupted_file_are_kept(tmp_path: Path) -> None:
    path, damaged, new = (tmp_path / name for name in ("run.mcap", "damaged.mcap.part", "new.mcap"))
    written = good_file(path)
    good = path.read_bytes()
    starts = [offset for offset, item in scan(good) if isinstance(item, Chunk)]
    ends = chunk_ends(path)
    seed = random.randrange(1 << 30)
    rng = random.Random(seed)
    for _ in range(150):
        # The end is truncated too. Otherwise the file is complete.
        data = bytearray(good[: -rng.randrange(1, 50)])
        places = [rng.randrange(len(data)) for _ in range(rng.choice((1, 1, 3)))]
        for place in places:
            data[place] ^= rng.randrange(1, 256)
        damaged.write_bytes(data)
        try:
            recover(damaged, new)
        except InputError:
            pytest.fail(f"seed {seed}: nothing recovered, flipped at {places}")
        complete = [
            content
            for start, end, content in zip(starts, ends, written, strict=True)
            if not any(start <= place < end for place in places)
        ]
        allowed = {message for content in written for message in content}
        found = read(new)
        assert set(found) <= allowed, f"seed {seed}, flipped at {places}"
        # Before the first chunk are the schemas and channels. Without them messages have no channel.
        if all(place > starts[0] for place in places):
            assert set(found) >= {message for content in complete for message in content}, f"seed {seed}, {places}"
        new.unlink()


def test_finished_file_with_a_damaged_chunk_is_recovered(tmp_path: Path) -> None:
    path, new = tmp_path / "run.mcap", tmp_path / "new.mcap"
    written = good_file(path)
    starts = [offset for offset, item in scan(path.read_bytes()) if isinstance(item, Chunk)]
    data = bytearray(path.read_bytes())
    within = starts[1] + 60
    data[within : within + 40] = bytes(40)
    path.write_bytes(data)
    assert is_complete(bytes(data))
    recovery = recover(path, new)
    assert recovery.damaged_chunks == 1
    assert read(new) == [message for number, content in enumerate(written) if number != 1 for message in content]
    # The new file is complete.
    assert recover(new, tmp_path / "again.mcap").path is None


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("chunked", [True, False])
def test_foreign_file_is_recovered(tmp_path: Path, compression: CompressionType, chunked: bool) -> None:
    source, new = tmp_path / "foreign.mcap", tmp_path / "new.mcap"
    with source.open("wb") as stream:
        writer = Writer(stream, chunk_size=1_000, compression=compression, use_chunking=chunked)
        writer.start(profile="ros2", library="foreign")
        for number in range(3):
            schema = writer.register_schema(f"pkg/Type{number}", "ros2msg", b"int32 x")
            channel = writer.register_channel(f"/topic{number}", "cdr", schema, {"qos": "1"})
            for sequence in range(100):
                writer.add_message(channel, START + sequence, b"%d" % sequence, START, sequence)
        writer.flush()
    recovery = recover(source, new)
    assert recovery.messages == 300
    with new.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert reader.get_header().profile == "ros2"
        found = [
            (schema and schema.name, channel.topic, m.data)
            for schema, channel, m in reader.iter_messages(log_time_order=False)
        ]
        assert {record.name for record in reader.iter_metadata()} == {"hilrig.recovered"}
    assert sorted(found) == sorted(
        (f"pkg/Type{number}", f"/topic{number}", b"%d" % sequence) for number in range(3) for sequence in range(100)
    )


def test_recovered_recording_has_session_and_recovery_metadata(tmp_path: Path) -> None:
    source = tmp_path / "run.mcap.part"
    recordings.write(source, recordings.make(recordings.Script(seconds=1)), finish=False)
    data = bytearray(source.read_bytes())
    source.write_bytes(data)
    recover(source, tmp_path / "run.mcap")
    found = metadata_of(tmp_path / "run.mcap")
    assert "hilrig.session" in found
    assert found["hilrig.recovered"]["damaged_bytes"] == "0"


def test_recovered_summary_contains_recorded_losses(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "run.mcap")
    for transport, recorder in ((3, 0), (0, 4)):
        writer.add_metadata("hilrig.loss", {"transport": str(transport), "recorder": str(recorder)})
    writer.close()
    recover(writer.temporary_path, writer.path)
    found = metadata_of(writer.path)
    assert found["hilrig.summary"]["ended"] == "recovered"
    assert "was not finished" in found["hilrig.summary"]["reason"]
    assert (found["hilrig.summary"]["lost_transport"], found["hilrig.summary"]["lost_recorder"]) == ("3", "4")


def test_damaged_summary_is_not_reported_as_unfinished_file(tmp_path: Path) -> None:
    path, new = tmp_path / "run.mcap", tmp_path / "new.mcap"
    good_file(path)
    data = bytearray(path.read_bytes())
    summary_at = next(
        at for at, item in scan(bytes(data)) if isinstance(item, Metadata) and item.name == "hilrig.summary"
    )
    data[summary_at + 9 : summary_at + 40] = bytes(31)
    path.write_bytes(data)
    assert is_complete(bytes(data))
    recover(path, new)
    assert metadata_of(new)["hilrig.summary"]["reason"] == "the summary of the file was damaged"


def test_damaged_loss_count_is_ignored(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "run.mcap")
    writer.add_metadata("hilrig.loss", {"transport": "3", "recorder": "-4\x00"})
    writer.close()
    recover(writer.temporary_path, writer.path)
    assert metadata_of(writer.path)["hilrig.summary"]["lost_transport"] == "3"
    assert metadata_of(writer.path)["hilrig.summary"]["lost_recorder"] == "0"


@pytest.mark.parametrize("truncated", [False, True])
def test_truncated_bytes_are_counted_separately_from_damage(tmp_path: Path, truncated: bool) -> None:
    path, new = tmp_path / "run.mcap", tmp_path / "new.mcap"
    good_file(path)
    ends = chunk_ends(path)
    data = bytearray(path.read_bytes())
    if truncated:
        del data[ends[-1] - 10 :]
    else:
        data[ends[3] - 10 : ends[3]] = bytes(10)
    path.write_bytes(data)
    recovery = recover(path, new)
    assert recovery.damaged_bytes > 0
    assert recovery.torn_bytes == (recovery.damaged_bytes if truncated else 0)
    assert metadata_of(new)["hilrig.recovered"]["torn_bytes"] == str(recovery.torn_bytes)


def test_file_being_written_is_refused(tmp_path: Path) -> None:
    writer = RecordingWriter(tmp_path / "run.mcap")
    with pytest.raises(InputError, match="a recorder is writing it"):
        recover(writer.temporary_path, tmp_path / "new.mcap")
    writer.close()
    recover(writer.temporary_path, tmp_path / "new.mcap")


def test_existing_file_is_not_overwritten(tmp_path: Path) -> None:
    source = tmp_path / "run.mcap.part"
    good_file(tmp_path / "run.mcap")
    source.write_bytes((tmp_path / "run.mcap").read_bytes()[:-10])
    before = (tmp_path / "run.mcap").read_bytes()
    with pytest.raises(InputError, match="exists"):
        recover(source, tmp_path / "run.mcap")
    assert (tmp_path / "run.mcap").read_bytes() == before


def test_interrupted_recovery_leaves_no_new_file(tmp_path: Path) -> None:
    good_file(tmp_path / "run.mcap")
    source = tmp_path / "truncated.mcap"
    source.write_bytes((tmp_path / "run.mcap").read_bytes()[:-10])
    answers = iter([True, True, False])
    with pytest.raises(OperationError, match="interrupted"):
        recover(source, tmp_path / "new.mcap", should_continue=lambda: next(answers))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run.mcap", "truncated.mcap"]


def test_recovery_pauses_while_it_searches_a_damaged_range(tmp_path: Path) -> None:
    good_file(tmp_path / "run.mcap")
    data = (tmp_path / "run.mcap").read_bytes()
    source = tmp_path / "damaged.mcap"
    source.write_bytes(data[: len(data) // 2] + bytes(20 * SEARCH_BYTES))
    pauses = count()
    recover(source, tmp_path / "new.mcap", should_continue=lambda: next(pauses) >= 0)
    assert next(pauses) > 20


@pytest.mark.timeout(20)
def test_tail_is_read_without_searching_a_large_range(tmp_path: Path) -> None:
    good_file(tmp_path / "run.mcap")
    data = (tmp_path / "run.mcap").read_bytes()
    source = tmp_path / "damaged.mcap"
    with source.open("wb") as file:
        file.write(data[: len(data) // 2])
        file.truncate(1 << 40)
    # A range of 1 TiB: reading all of it takes minutes.
    assert read_tail(source, 1 << 60).keys


@pytest.mark.parametrize("step_s", [-3600, 3600])
def test_tail_is_that_after_a_clock_step(tmp_path: Path, step_s: int) -> None:
    script = Script(seconds=10.0)
    # No message arrives before the time at which a generated run begins.
    made = [replace(one, publish_wall_ns=one.publish_wall_ns + 7200 * 10**9) for one in make(script)]
    path = recordings.write(tmp_path / "run.mcap", made, script=script, arrival_lag_ns=step_s * 10**9)
    found, whole = read_tail(path, 35 * 10**9), read_tail(path, 1 << 60)
    assert found.last == whole.last
    assert found.last_ns == whole.last_ns
    assert len(found.keys) > len(whole.keys) / 4


def test_default_path_of_a_recovered_file(tmp_path: Path) -> None:
    assert recovered_path(tmp_path / "a.mcap.part") == tmp_path / "a.mcap"
    assert recovered_path(tmp_path / "a.mcap") == tmp_path / "a.recovered.mcap"


def test_session_metadata_of_a_truncated_file_is_read(tmp_path: Path) -> None:
    good_file(tmp_path / "run.mcap")
    truncated = tmp_path / "truncated.mcap"
    truncated.write_bytes((tmp_path / "run.mcap").read_bytes()[:14_000])
    assert read_session_metadata(truncated) == {"session": "s1", "rig": "rig1"}


def test_scan_agrees_with_the_mcap_library(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    written = good_file(path)
    data = path.read_bytes()
    assert is_complete(bytes(data))
    found = [
        (message.channel_id, message.sequence, message.log_time, message.data)
        for _, item in scan(data)
        if isinstance(item, Chunk)
        for message in read_chunk(item)
        if isinstance(message, Message)
    ]
    assert found == [message for content in written for message in content] == read(path)


def test_command_recovers_and_reports_losses(tmp_path: Path) -> None:
    good_file(tmp_path / "run.mcap")
    part = tmp_path / "truncated.mcap.part"
    part.write_bytes((tmp_path / "run.mcap").read_bytes()[:15_000])
    answer = hilrig("recover", part)
    assert answer.returncode == 1
    assert "messages in" in answer.stdout
    assert "lost: " in answer.stdout
    assert not part.exists()
    assert read(tmp_path / "truncated.mcap")
    complete = hilrig("recover", tmp_path / "run.mcap")
    assert complete.returncode == 0
    assert "nothing to do" in complete.stdout
    (row,) = json.loads(hilrig("recover", tmp_path / "run.mcap", "--json").stdout)
    assert row["path"] is None


@pytest.mark.parametrize("content", [b"", b"x" * 1000])
def test_other_file_is_reported_in_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "notes.mcap"
    path.write_bytes(content)
    answer = hilrig("recover", path)
    assert answer.returncode == 2
    assert answer.stderr.count("\n") == 1
    assert "notes.mcap" in answer.stderr
    assert path.read_bytes() == content


def test_full_disk_leaves_the_original(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    good_file(tmp_path / "run.mcap")
    source = tmp_path / "truncated.mcap"
    shutil.copyfile(tmp_path / "run.mcap", source)
    source.write_bytes(source.read_bytes()[:-10])
    before = source.read_bytes()

    def refuse(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(RecordingWriter, "publish", refuse)
    with pytest.raises(OperationError, match="No space left"):
        recover(source, tmp_path / "new.mcap")
    assert source.read_bytes() == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run.mcap", "truncated.mcap"]


def test_folder_is_refused_with_a_hint(tmp_path: Path) -> None:
    answer = hilrig("recover", tmp_path)
    assert answer.returncode == 2
    assert "is a folder; give the MCAP files in it" in answer.stderr
    assert "Traceback" not in answer.stderr


def test_write_errors_are_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    good_file(tmp_path / "run.mcap")
    source = tmp_path / "truncated.mcap"
    source.write_bytes((tmp_path / "run.mcap").read_bytes()[:-10])

    def refuse(*_: object, **__: object) -> None:
        raise OSError(errno.EROFS, "Read-only file system")

    for owner, method in ((Path, "unlink"), (os, "open")):
        with monkeypatch.context() as patch:
            patch.setattr(owner, method, refuse)
            if method == "unlink":
                with pytest.raises(OperationError, match="can't be written: Read-only file system"):
                    recover(source, tmp_path / "new.mcap")
            else:
                with pytest.raises(InputError, match="can't be read"):
                    recover(source, tmp_path / "new.mcap")


def test_file_on_a_read_only_disk_is_recovered_elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    good_file(tmp_path / "run.mcap")
    source = tmp_path / "truncated.mcap"
    source.write_bytes((tmp_path / "run.mcap").read_bytes()[:-10])
    open_original = os.open

    def read_only(path: Path, flags: int, *mode: int) -> int:
        if path == source and flags & os.O_RDWR:
            raise OSError(errno.EROFS, "Read-only file system")
        return open_original(path, flags, *mode)

    monkeypatch.setattr(os, "open", read_only)
    assert recover(source, tmp_path / "new.mcap").messages > 0


def test_open_file_can_be_locked_once(tmp_path: Path) -> None:
    with (tmp_path / "file").open("w") as one, (tmp_path / "file").open("r+") as two:
        assert lock_file(one.fileno())
        assert not lock_file(two.fileno())


def two_copies(path: Path, seconds: float = 2.0) -> bytes:
    """A recording as the recorder writes it: session and configuration at the beginning and at the end."""
    script = recordings.Script(seconds=seconds)
    plain = path.with_suffix(".plain")
    recordings.write(plain, recordings.make(script), script=script)
    items = list(scan(plain.read_bytes()))
    session, config = (
        item
        for name in ("hilrig.session", "hilrig.config")
        for _, item in items
        if isinstance(item, Metadata) and item.name == name
    )
    writer = RecordingWriter(path, metadata=(session,))
    writer.add_metadata(config.name, config.metadata, is_repeated=True)
    for _, item in items:
        if isinstance(item, Attachment):
            writer.add_attachment(item.name, item.media_type, item.data, log_time=item.log_time)
    file = open_run(plain).file
    for channel_id, sequence, log_ns, publish_ns, data in file.messages(frozenset(file.topics.values())):
        channel = CHANNEL_OF_TOPIC[file.topics[channel_id]]
        writer.add(encode_message(channel, sequence, log_ns, publish_ns, data))
    writer.finish(lambda: {"hilrig.summary": {"ended": "ended", "lost_transport": "0", "lost_recorder": "0"}})
    writer.publish()
    plain.unlink()
    return path.read_bytes()


@pytest.mark.parametrize("end", ["4 KiB", "first chunk", "all but the last chunk"])
def test_damaged_beginning_is_recovered_from_the_end(tmp_path: Path, end: str) -> None:
    data = two_copies(tmp_path / "good.mcap")
    good = open_run(tmp_path / "good.mcap")
    chunks = [item.offset for _, item in scan(bytes(data)) if isinstance(item, Chunk)]
    until = {"4 KiB": 4096, "first chunk": chunks[1], "all but the last chunk": chunks[-1]}[end]
    kept = sum(
        isinstance(message, Message)
        for _, item in scan(data)
        if isinstance(item, Chunk) and item.offset >= until
        for message in read_chunk(item)
    )
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(data[:8] + bytes(until - 8) + data[until:])
    recovery = recover(damaged, tmp_path / "new.mcap")
    assert recovery.messages == kept > 0
    new = open_run(tmp_path / "new.mcap")
    for name in ("hilrig.session", "hilrig.config"):
        assert new.metadata[name] == good.metadata[name]
    assert recover(tmp_path / "new.mcap", tmp_path / "newer.mcap").path is None


def test_records_in_a_damaged_range_are_found_by_the_index(tmp_path: Path) -> None:
    data = two_copies(tmp_path / "good.mcap")
    offset = next(at for at, item in scan(bytes(data)) if isinstance(item, Attachment) and item.name.endswith(".urdf"))
    # The head of the record before is damaged, so reading in order continues at the next chunk.
    config = next(at for at, item in scan(bytes(data)) if isinstance(item, Metadata) and item.name == "hilrig.config")
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(data[:config] + bytes(9) + data[config + 9 :])
    recovery = recover(damaged, tmp_path / "new.mcap")
    assert config < offset
    assert open_run(tmp_path / "new.mcap").urdf == open_run(tmp_path / "good.mcap").urdf
    assert 0 < recovery.damaged_bytes < offset - config + 9


def test_difference_of_the_two_copies_is_damage(tmp_path: Path) -> None:
    data = bytearray(two_copies(tmp_path / "good.mcap"))
    first = data.index(b"parameters_json")
    second = data.index(b"parameters_json", first + 1)
    at = data.index(b"0.", second) + 2
    data[at] ^= 1
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(data)
    with pytest.raises(InputError, match=r"damaged \(metadata hilrig\.config\.copy differs from its first copy"):
        open_run(damaged)
    recovery = recover(damaged, tmp_path / "new.mcap")
    assert any("differs from its first copy" in reason for reason in recovery.reasons)
    good = open_run(tmp_path / "good.mcap")
    assert open_run(tmp_path / "new.mcap").parameters_json == good.parameters_json
