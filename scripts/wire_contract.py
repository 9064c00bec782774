"""What versions promise each other, one line each, in `schemas/contract.txt`; `make gen` adds what is new.

A promise is what a reader of another version relies on: a field's number, name and type, an enum's values, a topic's
key and message. Pure functions on descriptors, so that a test can show that each way of breaking one is found.
"""

import importlib
import pkgutil
import sys
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from google.protobuf.descriptor_pb2 import (
    DescriptorProto,
    EnumDescriptorProto,
    FieldDescriptorProto,
    FileDescriptorProto,
)

import hilrig_schemas.v1
from hilrig_schemas import topics

PATH = Path(__file__).parents[1] / "schemas/contract.txt"
HEAD = """\
# What versions of hilrig promise each other. `make gen` adds what is new; once a release has it, nothing here is
# changed or taken away (docs/adr/0042-schema-evolution.md). A field that is gone stays here, and reserved.
"""


@dataclass(frozen=True)
class Contract:
    """What holds: the promises, and what is kept from being used again."""

    lines: frozenset[str]
    messages: frozenset[str]
    reserved: frozenset[tuple[str, str]]
    """Message and number, and message and name."""


def files() -> list[FileDescriptorProto]:
    """The schemas of this version."""
    found = []
    for module in pkgutil.iter_modules(hilrig_schemas.v1.__path__, "hilrig_schemas.v1."):
        if module.name.endswith("_pb2"):
            file = FileDescriptorProto()
            importlib.import_module(module.name).DESCRIPTOR.CopyToProto(file)
            found.append(file)
    return found


def contract(schemas: Iterable[FileDescriptorProto]) -> Contract:
    """What some schemas promise."""
    lines: set[str] = set()
    messages: set[str] = set()
    reserved: set[tuple[str, str]] = set()
    for file in schemas:
        lines.update(_enums(file.package, file.enum_type))
        for name, message in _all_messages(file.package, file.message_type):
            messages.add(name)
            lines.update(f"field {name} {field.number} {field.name} {_type(field)}" for field in message.field)
            lines.update(_enums(name, message.enum_type))
            reserved.update(
                (name, str(number)) for span in message.reserved_range for number in range(span.start, span.end)
            )
            reserved.update((name, text) for text in message.reserved_name)
    return Contract(frozenset(lines), frozenset(messages), frozenset(reserved))


def topic_lines() -> Iterator[str]:
    """What the registry of topics promises."""
    for topic in topics.all_topics():
        places = ("<lab>", "<rig>") if isinstance(topic, topics.RigTopic) else ("<lab>", "<service>", "<instance>")
        channel = f" in {topic.channel}" if topic.channel else ""
        key = topic.key(*places)  # type: ignore[attr-defined]
        yield f"topic {key} {topic.message.DESCRIPTOR.full_name} {topic.traffic.value}{channel}"
    yield f"alive {topics.alive_key('<lab>', '<service>', '<instance>')}"


def broken(promised: Iterable[str], now: Contract) -> list[str]:
    """Promises that do not hold any more, each with what is wrong, for people."""
    return [f"{line}: {reason}" for line in sorted(promised) if (reason := _broken(line, now))]


def _broken(line: str, now: Contract) -> str:
    if line in now.lines:
        return ""
    kind, owner, *rest = line.split(" ")
    if kind != "field":
        return "changed or gone"
    if owner not in now.messages:
        # What is of no message that is sent: topics and fields promise those that are.
        return ""
    number, name, *_ = rest
    changed = [other for other in now.lines if other.split(" ")[:3] == [kind, owner, number]]
    if changed:
        return f"is now {changed[0]}"
    missing = [text for text in (number, f'"{name}"') if (owner, text.strip('"')) not in now.reserved]
    return f"gone: reserve {' and '.join(missing)}" if missing else ""


def promised() -> set[str]:
    """What stands in the file."""
    return {line for line in PATH.read_text().splitlines() if line and not line.startswith("#")}


def current() -> Contract:
    """What this version promises, topics included."""
    found = contract(files())
    return Contract(found.lines | frozenset(topic_lines()), found.messages, found.reserved)


def _all_messages(package: str, messages: Iterable[DescriptorProto]) -> Iterator[tuple[str, DescriptorProto]]:
    for message in messages:
        name = f"{package}.{message.name}"
        yield name, message
        yield from _all_messages(name, message.nested_type)


def _enums(owner: str, enums: Iterable[EnumDescriptorProto]) -> Iterator[str]:
    for enum in enums:
        yield from (f"enum {owner}.{enum.name} {value.number} {value.name}" for value in enum.value)


def _type(field: FieldDescriptorProto) -> str:
    repeated = "repeated " if field.label == FieldDescriptorProto.LABEL_REPEATED else ""
    plain = FieldDescriptorProto.Type.Name(field.type).removeprefix("TYPE_").lower()
    return repeated + (field.type_name.removeprefix(".") or plain)


def _order(line: str) -> tuple[str, str, int]:
    kind, owner, *rest = line.split(" ")
    return kind, owner, int(rest[0]) if rest and rest[0].isdecimal() else 0


def main() -> int:
    """Add what is new to the file; 1 where a promise is broken."""
    old, now = promised() if PATH.exists() else set(), current()
    wrong = broken(old, now)
    for text in wrong:
        print(f"{PATH.name}: {text}", file=sys.stderr)
    if not wrong:
        PATH.write_text(HEAD + "".join(f"{line}\n" for line in sorted(old | now.lines, key=_order)))
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
