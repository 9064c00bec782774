"""The schemas: generated code is up to date, every field has its unit, the registry of topics is consistent."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from hilrig_schemas import Event, topics
from hilrig_schemas.topics import RigKey, RigTopic, Traffic

ROOT = Path(__file__).parents[2]
PROTOS = sorted((ROOT / "schemas/hilrig_schemas/v1").glob("*.proto"))


def test_generated_code_is_up_to_date(tmp_path: Path) -> None:
    command = [
        sys.executable,
        "-m",
        "grpc_tools.protoc",
        "-I",
        "schemas",
        f"--python_out={tmp_path}",
        f"--pyi_out={tmp_path}",
    ]
    subprocess.run([*command, *[str(proto.relative_to(ROOT)) for proto in PROTOS]], cwd=ROOT, check=True, timeout=60)
    fresh = {path.relative_to(tmp_path): path.read_text() for path in tmp_path.rglob("*_pb2.py*")}
    committed = {
        path.relative_to(ROOT / "schemas"): path.read_text()
        for path in (ROOT / "schemas").rglob("*_pb2.py*")
        if path.suffix != ".pyc"
    }
    assert committed == fresh, "run `make gen` and commit the result"


@pytest.mark.parametrize("proto", PROTOS, ids=lambda path: path.stem)
def test_every_field_has_a_comment_and_numbers_a_unit(proto: Path) -> None:
    field = re.compile(r"^\s*(repeated )?(?P<type>\w+) (?P<name>\w+) = \d+;(?P<comment>.*)$")
    unit = re.compile(r"\b(rad|m|mm|degrees|N|N·m|kg|ns|s|count|bytes|bit|1/s|no unit)\b")
    numeric = {"double", "float", "int32", "int64", "uint32", "uint64"}
    fields = [match for line in proto.read_text().splitlines() if (match := field.match(line))]
    assert fields
    for match in fields:
        if re.match(r"[a-z]", match["type"]):
            assert match["comment"].strip().startswith("//"), f"{match['name']} has no comment"
        if match["type"] in numeric:
            assert unit.search(match["comment"]), f"{match['name']}: its comment names no unit: {match['comment']}"


def test_topic_names_and_channels_are_unique() -> None:
    names = [topic.name for topic in topics.all_topics()]
    assert len(names) == len(set(names))
    channels = [topic.channel for topic in topics.all_topics() if topic.channel]
    assert len(channels) == len(set(channels))
    assert set(channels) == {"/state", "/command", "/event", "/traffic"}


def test_every_topic_is_in_the_registry() -> None:
    assert {topic.name for topic in vars(topics).values() if isinstance(topic, topics.Topic)} == {
        topic.name for topic in topics.all_topics()
    }


@pytest.mark.parametrize("topic", topics.RIG_TOPICS, ids=lambda topic: topic.name)
def test_rig_key_can_be_parsed(topic: RigTopic) -> None:  # type: ignore[type-arg]
    assert topics.parse_rig_key(topic.key("lab", "rig1")) == RigKey("lab", "rig1", topic)


@pytest.mark.parametrize("topic", list(topics.all_topics()), ids=lambda topic: topic.name)
def test_messages_of_every_topic_round_trip(topic: topics.Topic) -> None:  # type: ignore[type-arg]
    message = topic.message()
    first = message.DESCRIPTOR.fields[0]
    setattr(message, first.name, "rig1")
    assert topic.decode(message.SerializeToString()) == message


@pytest.mark.parametrize(
    "key", ["hil/lab/rig1/none", "hil/lab/log/sim/1", "other/lab/rig1/state", "hil/lab/health/state", ""]
)
def test_invalid_rig_key_is_rejected(key: str) -> None:
    with pytest.raises(ValueError, match="invalid key of a rig topic"):
        topics.parse_rig_key(key)


def test_control_topics_close_the_loop() -> None:
    assert {topic.name for topic in topics.all_topics() if topic.traffic is Traffic.CONTROL} == {
        "state",
        "states",
        "command",
        "commands",
    }


def test_keys_are_only_in_the_registry() -> None:
    sources = [path for folder in ("runtime", "services", "tools") for path in (ROOT / folder).rglob("*.py")]
    offenders = [str(path) for path in sources if re.search(r"""["']hil/""", path.read_text())]
    assert offenders == []


def test_every_event_kind_is_emitted_by_a_service() -> None:
    sources = "".join(path.read_text() for path in (ROOT / "services").rglob("*.py"))
    kinds = [kind for kind in Event.Kind.keys() if kind != "KIND_UNSPECIFIED"]  # noqa: SIM118 (not a mapping)
    assert [kind for kind in kinds if not re.search(rf"\bEvent\.{kind}\b", sources)] == []
