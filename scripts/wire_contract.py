"""The compatibility contract between versions, in `schemas/contract.txt`; `make gen` adds new entries.

An entry is a property on which a reader of another version relies: a field's number, name and type, an enum's values,
a topic's key and message. Pure functions on descriptors, so that tests can check that each violation is detected.
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
# Compatibility contract between versions of hilrig. `make gen` adds new entries; a released entry must not be changed
# or removed (docs/adr/0042-schema-evolution.md). A removed field stays here and is reserved in its message.
"""


@dataclass(frozen=True)
class Contract:
    """The entries of a set of schemas, and their reserved numbers and names."""

    lines: frozenset[str]
    messages: frozenset[str]
    reserved: frozenset[tuple[str, str]]
    """Pairs of message or enum and number, and of message or enum and name."""


def files() -> list[FileDescriptorProto]:
    """Return the schemas of this version."""
    found = []
    for module in pkgutil.iter_modules(hilrig_schemas.v1.__path__, "hilrig_schemas.v1."):
        if module.name.endswith("_pb2"):
            file = FileDescriptorProto()
            importlib.import_module(module.name).DESCRIPTOR.CopyToProto(file)
            found.append(file)
    return found


def contract(schemas: Iterable[FileDescriptorProto]) -> Contract:
    """Return the contract of some schemas."""
    lines: set[str] = set()
    messages: set[str] = set()
    reserved: set[tuple[str, str]] = set()
    for file in schemas:
        enums = list(_all_enums(file.package, file.enum_type))
        for name, message in _all_messages(file.package, file.message_type):
            messages.add(name)
            lines.update(f"field {name} {field.number} {field.name} {_type(field)}" for field in message.field)
            enums += _all_enums(name, message.enum_type)
            reserved.update(
                (name, str(number)) for span in message.reserved_range for number in range(span.start, span.end)
            )
            reserved.update((name, text) for text in message.reserved_name)
        for name, enum in enums:
            lines.update(f"enum {name} {value.number} {value.name}" for value in enum.value)
            # The last number of an enum's range is inclusive, unlike that of a message.
            reserved.update(
                (name, str(number)) for span in enum.reserved_range for number in range(span.start, span.end + 1)
            )
            reserved.update((name, text) for text in enum.reserved_name)
    return Contract(frozenset(lines), frozenset(messages), frozenset(reserved))


def topic_lines() -> Iterator[str]:
    """Yield the entries of the registry of topics."""
    for topic in topics.all_topics():
        parts = ("<lab>", "<rig>") if isinstance(topic, topics.RigTopic) else ("<lab>", "<service>", "<instance>")
        channel = f" in {topic.channel}" if topic.channel else ""
        key = topic.key(*parts)  # type: ignore[attr-defined]
        yield f"topic {key} {topic.message.DESCRIPTOR.full_name} {topic.traffic.value}{channel}"
        if topic.request is not None:
            yield f"request {key} {topic.request.DESCRIPTOR.full_name}"
    yield f"alive {topics.alive_key('<lab>', '<service>', '<instance>')}"


def violations(entries: Iterable[str], now: Contract) -> list[str]:
    """Return the violated entries, each with a human-readable reason."""
    return [f"{line}: {reason}" for line in sorted(entries) if (reason := _violation(line, now))]


def _violation(line: str, now: Contract) -> str:
    if line in now.lines:
        return ""
    kind, owner, *rest = line.split(" ")
    if kind not in ("field", "enum"):
        return "changed or removed"
    if kind == "field" and owner not in now.messages:
        # Messages that are used are covered by the entries of topics and fields.
        return ""
    number, name, *_ = rest
    changed = [other for other in now.lines if other.split(" ")[:3] == [kind, owner, number]]
    if changed:
        return f"is now {changed[0]}"
    missing = [text for text in (number, f'"{name}"') if (owner, text.strip('"')) not in now.reserved]
    return f"removed: reserve {' and '.join(missing)}" if missing else ""


def recorded_entries() -> set[str]:
    """Return the entries of the file."""
    return {line for line in PATH.read_text().splitlines() if line and not line.startswith("#")}


def current() -> Contract:
    """Return the contract of this version, including topics."""
    found = contract(files())
    return Contract(found.lines | frozenset(topic_lines()), found.messages, found.reserved)


def _all_messages(package: str, messages: Iterable[DescriptorProto]) -> Iterator[tuple[str, DescriptorProto]]:
    for message in messages:
        name = f"{package}.{message.name}"
        yield name, message
        yield from _all_messages(name, message.nested_type)


def _all_enums(owner: str, enums: Iterable[EnumDescriptorProto]) -> Iterator[tuple[str, EnumDescriptorProto]]:
    for enum in enums:
        yield f"{owner}.{enum.name}", enum


def _type(field: FieldDescriptorProto) -> str:
    repeated = "repeated " if field.label == FieldDescriptorProto.LABEL_REPEATED else ""
    plain = FieldDescriptorProto.Type.Name(field.type).removeprefix("TYPE_").lower()
    return repeated + (field.type_name.removeprefix(".") or plain)


def _order(line: str) -> tuple[str, str, int]:
    kind, owner, *rest = line.split(" ")
    return kind, owner, int(rest[0]) if rest and rest[0].isdecimal() else 0


def main() -> int:
    """Add new entries to the file; exit code 1: an entry is violated."""
    old, now = recorded_entries() if PATH.exists() else set(), current()
    violated = violations(old, now)
    for text in violated:
        print(f"{PATH.name}: {text}", file=sys.stderr)
    if not violated:
        PATH.write_text(HEAD + "".join(f"{line}\n" for line in sorted(old | now.lines, key=_order)))
    return 1 if violated else 0


if __name__ == "__main__":
    sys.exit(main())
