"""Order of the messages of a run: duplicates are dropped, misplaced messages are put in order, restarts are kept."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Channel, Message, Schema
from mcap.writer import Writer

from hilrig_replay.analysis.latency import measure
from hilrig_replay.io.run import open_run
from hilrig_replay.io.sequence_order import Repairs
from support.recordings import Script, make, record, write

SCRIPT = Script(seconds=20.0, poll_ms=20.0)
Messages = list[tuple[Schema | None, Channel, Message]]
Edit = Callable[[Messages], None]


def rewritten(source: Path, path: Path, edit: Edit) -> Path:
    """Copy a recording message by message with the stock writer, after `edit` of the list of messages."""
    with source.open("rb") as stream:
        reader = make_reader(stream)
        messages = list(reader.iter_messages(log_time_order=False))
        metadata, attachments = list(reader.iter_metadata()), list(reader.iter_attachments())
    edit(messages)
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for one in metadata:
            writer.add_metadata(one.name, one.metadata)
        for file in attachments:
            writer.add_attachment(file.create_time, file.log_time, file.name, file.media_type, file.data)
        channels: dict[int, int] = {}
        for schema, channel, message in messages:
            if channel.id not in channels:
                assert schema is not None
                schema_id = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, schema_id)
            writer.add_message(
                channels[channel.id], message.log_time, message.data, message.publish_time, message.sequence
            )
        writer.finish()
    return path


def states_of(messages: Messages) -> list[int]:
    return [number for number, (_, channel, _) in enumerate(messages) if channel.topic == "/state"]


def repeat(messages: Messages) -> None:
    messages.insert(states_of(messages)[300] + 5, messages[states_of(messages)[300]])


def swap(messages: Messages) -> None:
    first, second = states_of(messages)[300:302]
    messages[first], messages[second] = messages[second], messages[first]


def move_back(messages: Messages) -> None:
    place = states_of(messages)[100]
    messages.insert(place + 2000, messages.pop(place))


def move_forward(messages: Messages) -> None:
    place = states_of(messages)[900]
    messages.insert(place - 2000, messages.pop(place))


@pytest.mark.parametrize(
    ("edit", "repairs"),
    [
        (repeat, Repairs(duplicates=1)),
        (swap, Repairs(reordered=1)),
        (move_back, Repairs(reordered=1)),
        (move_forward, Repairs(reordered=1)),
    ],
)
def test_repairs_the_order_and_measures_the_same(tmp_path: Path, edit: Edit, repairs: Repairs) -> None:
    source = record(tmp_path / "run.mcap", SCRIPT)
    expected = measure(open_run(source))
    changed = open_run(rewritten(source, tmp_path / "changed.mcap", edit))
    report = measure(changed)
    assert report.repaired == repairs
    assert (report.samples, report.loop_ms, report.age_ms) == (expected.samples, expected.loop_ms, expected.age_ms)
    assert report.lost.total == 0
    assert report.fit
    assert np.array_equal(changed.states["step"], open_run(source).states["step"])
    assert any("duplicate" in note or "in order" in note for note in report.notes())


def test_repairs_the_order_across_blocks(tmp_path: Path) -> None:
    source = record(tmp_path / "run.mcap", SCRIPT)
    run = open_run(rewritten(source, tmp_path / "changed.mcap", swap))
    expected = open_run(source).states["step"]
    for rows in (3, 10, 100):
        repairs = Repairs()
        steps = np.concatenate([block.states["step"] for block in run.blocks(rows=rows, repairs=repairs)])
        assert np.array_equal(steps, expected), rows
        assert repairs == Repairs(reordered=1), rows


def test_repairs_the_order_of_commands(tmp_path: Path) -> None:
    def edit(messages: Messages) -> None:
        places = [number for number, (_, channel, _) in enumerate(messages) if channel.topic == "/command"]
        messages.insert(places[200], messages.pop(places[100]))
        messages.insert(places[300], messages[places[300]])

    source = record(tmp_path / "run.mcap", SCRIPT)
    repairs = Repairs()
    run = open_run(rewritten(source, tmp_path / "changed.mcap", edit))
    seqs = np.concatenate([block.commands["seq"] for block in run.blocks(repairs=repairs)])
    assert np.array_equal(seqs, open_run(source).commands["seq"])
    assert repairs == Repairs(duplicates=1, reordered=1)


def test_numbers_of_a_restarted_sender_keep_their_place(tmp_path: Path) -> None:
    made = make(Script(seconds=4.0))
    path = write(tmp_path / "run.mcap", made)

    def restart(messages: Messages) -> None:
        for number, place in enumerate(states_of(messages)[100:]):
            messages[place][2].sequence = number + 1

    repairs = Repairs()
    run = open_run(rewritten(path, tmp_path / "restarted.mcap", restart))
    steps = np.concatenate([block.states["step"] for block in run.blocks(repairs=repairs)])
    assert np.array_equal(steps, open_run(path).states["step"])
    assert repairs == Repairs()
