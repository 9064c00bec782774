"""The compatibility contract between versions, in `schemas/contract.txt`: frozen entries, then those added since.

An entry is a property on which another version, a controller or a reader of recordings relies: a field's number, name
and type, an enum's values, a topic's key and message, a register's number and type, a metadata record's key. Frozen
entries are part of a release. Pure functions on descriptors, so that tests can check that each violation is detected.
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
from hilrig_modbus_edge.registers.map import MAP, Register, Status
from hilrig_schemas import topics

PATH = Path(__file__).parents[1] / "schemas/contract.txt"
HEAD = """\
# Compatibility contract between versions of hilrig (docs/adr/0042-schema-evolution.md). The entries of a release are
# frozen: no version 0.2.x changes or removes one. `reserved`: removed before the release, never to be used again.
"""
SINCE = "# Added since version 0.2.0; written by `make gen`\n"


@dataclass(frozen=True)
class Contract:
    """The entries of a set of schemas, and their reserved numbers and names."""

    lines: frozenset[str]
    reserved: frozenset[str]


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
    reserved: set[tuple[str, int | str]] = set()
    for file in schemas:
        enums = list(_all_enums(file.package, file.enum_type))
        for name, message in _all_messages(file.package, file.message_type):
            lines.update(f"field {name} {field.number} {field.name} {_type(field)}" for field in message.field)
            enums += _all_enums(name, message.enum_type)
            reserved.update((name, number) for span in message.reserved_range for number in range(span.start, span.end))
            reserved.update((name, text) for text in message.reserved_name)
        for name, enum in enums:
            lines.update(f"enum {name} {value.number} {value.name}" for value in enum.value)
            # The last number of an enum's range is inclusive, unlike that of a message.
            spans = [range(span.start, span.end + 1) for span in enum.reserved_range]
            reserved.update((name, number) for span in spans for number in span)
            reserved.update((name, text) for text in enum.reserved_name)
    return Contract(frozenset(lines), frozenset(f"reserved {name} {what}" for name, what in reserved))


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


def register_lines(registers: Iterable[Register] = MAP) -> Iterator[str]:
    """Yield the entries of the register map."""
    for one in registers:
        access = "writable" if one.writable else "read-only"
        table = one.table.name.lower()
        yield f"register {table} {one.number} {one.name} {one.type.name.lower()} {one.unit or '-'} {one.scale} {access}"
    for flag in Status:
        yield f"status {flag.bit_length() - 1} {flag.name}"


def violations(entries: Iterable[str], now: Contract) -> list[str]:
    """Return the violated entries, each with a human-readable reason."""
    return [f"{line}: {_reason(line, now)}" for line in sorted(entries) if line not in now.lines | now.reserved]


def _reason(line: str, now: Contract) -> str:
    number_of = {"field": 3, "enum": 3, "register": 3, "status": 2}
    same = line.split(" ")[: number_of.get(line.split(" ")[0], 0)]
    changed = [other for other in now.lines if same and other.split(" ")[: len(same)] == same]
    return f"is now {changed[0]}" if changed else "removed"


def recorded_entries() -> tuple[set[str], set[str]]:
    """Return the frozen entries of the file, and those added since."""
    frozen, _, added = PATH.read_text(encoding="utf-8").partition(SINCE)
    return _entries(frozen), _entries(added)


def _entries(text: str) -> set[str]:
    return {line for line in text.splitlines() if line and not line.startswith("#")}


def is_metadata(line: str) -> bool:
    """Return whether an entry is the key of a metadata record, which only a recording shows."""
    return line.startswith("metadata ")


def current() -> Contract:
    """Return the contract of this version without the metadata of recordings."""
    found = contract(files())
    return Contract(found.lines | {*topic_lines(), *register_lines()}, found.reserved)


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


def _order(line: str) -> tuple[str, str, int, str]:
    kind, owner, *rest = line.split(" ")
    return kind, owner, int(rest[0]) if rest and rest[0].isdecimal() else 0, line


def main() -> int:
    """Write the entries added since the release to the file; exit code 1: a frozen entry is violated."""
    frozen, _ = recorded_entries()
    now = current()
    violated = violations((line for line in frozen if not is_metadata(line)), now)
    for text in violated:
        print(f"{PATH.name}: {text}", file=sys.stderr)
    if violated:
        return 1
    parts = [HEAD, *(f"{line}\n" for line in sorted(frozen, key=_order)), SINCE]
    PATH.write_text("".join([*parts, *(f"{line}\n" for line in sorted(now.lines - frozen, key=_order))]), "utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
