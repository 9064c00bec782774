"""Recordings read by third-party tools: the Foxglove reader for Node.js, pymcap-cli, and the rerun loader."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from mcap.reader import make_reader

from hilrig_recorder.mcap_format.channels import CHANNEL_OF_TOPIC
from hilrig_recorder.mcap_format.records import encode_message
from hilrig_recorder.mcap_format.recover import recover
from hilrig_recorder.mcap_format.writer import RecordingWriter
from hilrig_replay.export.export import export_foxglove
from hilrig_replay.io.run import open_run
from support import recordings

NODE = """
import {McapIndexedReader, McapStreamReader} from "@mcap/core";
import {FileHandleReadable} from "@mcap/nodejs";
import {loadDecompressHandlers} from "@mcap/support";
import {open, readFile} from "node:fs/promises";
const decompressHandlers = await loadDecompressHandlers();
const found = [];
for (const path of process.argv.slice(2)) {
  const file = await open(path, "r");
  const reader = await McapIndexedReader.Initialize({readable: new FileHandleReadable(file), decompressHandlers});
  const topics = {}, metadata = [], attachments = [];
  let bytes = 0;
  for await (const message of reader.readMessages()) {
    const topic = reader.channelsById.get(message.channelId).topic;
    topics[topic] = (topics[topic] ?? 0) + 1;
    bytes += message.data.length;
  }
  for await (const record of reader.readMetadata()) metadata.push(record.name);
  for await (const item of reader.readAttachments()) attachments.push(item.name);
  await file.close();
  const stream = new McapStreamReader({decompressHandlers, validateCrcs: true});
  stream.append(await readFile(path));
  let streamed = 0;
  for (let record; (record = stream.nextRecord()); ) if (record.type === "Message") streamed++;
  found.push({topics, bytes, metadata, attachments, streamed, done: stream.done()});
}
console.log(JSON.stringify(found));
"""


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """A recording, the file recovered from its truncated copy, and its Foxglove export."""
    folder = tmp_path_factory.mktemp("foreign")
    made = recordings.record(folder / "made.mcap", recordings.Script(seconds=5))
    complete, truncated = folder / "complete.mcap", folder / "truncated.mcap"
    writer = RecordingWriter(complete)
    run = open_run(made)
    for name, values in run.metadata.items():
        writer.add_metadata(name, values)
    for number, message in enumerate(run.file.messages(frozenset(CHANNEL_OF_TOPIC))):
        channel_id = CHANNEL_OF_TOPIC[run.file.topics[message.channel_id]]
        writer.add(encode_message(channel_id, *message[1:]))
        if number % 300 == 299:
            writer.close_chunk()
    for name, data in run.file.attachments.items():
        writer.add_attachment(name, "application/xml", data, log_time=run.file.start_ns)
    writer.finish()
    writer.publish()
    truncated.write_bytes(complete.read_bytes()[: complete.stat().st_size * 6 // 10])
    recover(truncated, folder / "recovered.mcap")
    return [complete, folder / "recovered.mcap", export_foxglove(open_run(complete), folder / "foxglove.mcap")]


def counted(path: Path) -> dict[str, int]:
    """Number of messages per topic, read with the mcap library."""
    counts: dict[str, int] = {}
    with path.open("rb") as stream:
        for _, channel, _ in make_reader(stream, validate_crcs=True).iter_messages():
            counts[channel.topic] = counts.get(channel.topic, 0) + 1
    return counts


def install(command: list[str], tool: str) -> None:
    """Install a tool for this test; skip with the reason if it is unavailable."""
    if shutil.which(command[0]) is None:
        pytest.skip(f"needs {command[0]}")
    try:
        done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=100)
    except subprocess.TimeoutExpired:
        pytest.skip(f"{tool} can't be installed here: no package registry is reachable")
    if done.returncode:
        pytest.skip(f"{tool} can't be installed here: {done.stderr.strip()[-200:]}")


def test_foxglove_reader_for_node_agrees(files: list[Path], tmp_path: Path) -> None:
    packages = ["@mcap/core", "@mcap/nodejs", "@mcap/support"]
    install(["npm", "install", "--no-audit", "--no-fund", "--prefix", str(tmp_path), *packages], "@mcap/core")
    script = tmp_path / "read.mjs"
    script.write_text(NODE)
    output = subprocess.run(["node", str(script), *map(str, files)], check=True, capture_output=True, text=True).stdout
    for path, found in zip(files, json.loads(output), strict=True):
        assert found["topics"] == counted(path)
        assert found["streamed"] == sum(counted(path).values())
        assert found["done"]
        assert "hilrig.session" in found["metadata"]
    complete, recovered, exported = json.loads(output)
    assert complete["attachments"] == exported["attachments"] == ["rig1.urdf"]
    assert "hilrig.recovered" in recovered["metadata"]


@pytest.mark.long("takes 10 s")
def test_pymcap_doctor_finds_no_errors(files: list[Path], tmp_path: Path) -> None:
    target = tmp_path / "packages"
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", "--no-compile"]
    install([*pip, "--target", str(target), "pymcap-cli"], "pymcap-cli")
    for path in files:
        done = subprocess.run(
            [sys.executable, str(target / "bin" / "pymcap-cli"), "doctor", str(path)],
            check=False,
            capture_output=True,
            text=True,
            env={"PYTHONPATH": str(target), "PATH": "/usr/bin:/bin"},
        )
        assert done.returncode == 0, done.stdout + done.stderr
        output = " ".join(done.stdout.split())
        assert "0 errors, 0 warnings" in output or "passed MCAP doctor checks" in output, done.stdout


def test_rerun_loader_finds_the_arm_in_an_export(files: list[Path], tmp_path: Path) -> None:
    rerun = Path(sys.executable).with_name("rerun")
    out = tmp_path / "out.rrd"
    done = subprocess.run(
        [str(rerun), "mcap", "convert", str(files[2]), "-o", str(out)], check=False, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    output = subprocess.run(
        [str(rerun), "rrd", "print", "-v", str(out)], check=True, capture_output=True, text=True
    ).stdout
    assert "Transform3D" in output
    assert "Points3D" in output
    for link in ("link1", "link2"):
        assert f"/points/{link}" in output
