"""The compatibility contract holds, and each kind of violation is detected."""

from collections.abc import Callable

import pytest
from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto, FileDescriptorProto

import wire_contract

STATE = "hilrig.v1.JointState"


def joint_state(files: list[FileDescriptorProto]) -> DescriptorProto:
    return next(message for file in files for message in file.message_type if message.name == "JointState")


def field(message: DescriptorProto, name: str) -> FieldDescriptorProto:
    return next(field for field in message.field if field.name == name)


def test_contract_holds() -> None:
    assert wire_contract.violations(wire_contract.recorded_entries(), wire_contract.current()) == []


def test_contract_is_complete() -> None:
    assert wire_contract.current().lines - wire_contract.recorded_entries() == set(), (
        "run `make gen` and commit the result"
    )


def remove_field(message: DescriptorProto) -> None:
    message.field.remove(field(message, "magnet"))


def remove_and_reserve(message: DescriptorProto) -> None:
    remove_field(message)
    message.reserved_range.add(start=15, end=16)
    message.reserved_name.append("magnet")


def reuse_number(message: DescriptorProto) -> None:
    field(message, "magnet").name = "gripper"


def change_type(message: DescriptorProto) -> None:
    field(message, "step").type = FieldDescriptorProto.TYPE_SFIXED64


def make_repeated(message: DescriptorProto) -> None:
    field(message, "session").label = FieldDescriptorProto.LABEL_REPEATED


def change_number(message: DescriptorProto) -> None:
    field(message, "safe").number = 99


def add_field(message: DescriptorProto) -> None:
    message.field.add(name="new", number=99, type=FieldDescriptorProto.TYPE_BOOL)


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (add_field, []),
        (remove_and_reserve, []),
        (remove_field, [f'field {STATE} 15 magnet bool: removed: reserve 15 and "magnet"']),
        (reuse_number, [f"field {STATE} 15 magnet bool: is now field {STATE} 15 gripper bool"]),
        (change_type, [f"field {STATE} 4 step uint64: is now field {STATE} 4 step sfixed64"]),
        (make_repeated, [f"field {STATE} 2 session string: is now field {STATE} 2 session repeated string"]),
        (change_number, [f'field {STATE} 20 safe bool: removed: reserve 20 and "safe"']),
    ],
)
def test_violation_is_reported(change: Callable[[DescriptorProto], None], found: list[str]) -> None:
    files = wire_contract.files()
    before = wire_contract.contract(files)
    change(joint_state(files))
    assert wire_contract.violations(before.lines, wire_contract.contract(files)) == found


def test_change_of_enum_value_is_reported() -> None:
    files = wire_contract.files()
    before = wire_contract.contract(files)
    kinds = next(enum for file in files for message in file.message_type for enum in message.enum_type)
    assert (kinds.name, kinds.value[1].name) == ("Kind", "SESSION_START")
    kinds.value[1].number = 99
    assert wire_contract.violations(before.lines, wire_contract.contract(files)) == [
        'enum hilrig.v1.Event.Kind 1 SESSION_START: removed: reserve 1 and "SESSION_START"'
    ]


def test_removed_enum_value_must_be_reserved() -> None:
    files = wire_contract.files()
    before = wire_contract.contract(files)
    kinds = next(enum for file in files for message in file.message_type for enum in message.enum_type)
    del kinds.value[1]
    assert len(wire_contract.violations(before.lines, wire_contract.contract(files))) == 1
    kinds.reserved_name.append("SESSION_START")
    kinds.reserved_range.add(start=1, end=1)
    assert wire_contract.violations(before.lines, wire_contract.contract(files)) == []


def test_change_of_topic_key_is_reported() -> None:
    entry = "topic hil/<lab>/<rig>/pose hilrig.v1.JointState control"
    assert wire_contract.violations([entry], wire_contract.current()) == [f"{entry}: changed or removed"]


def test_removed_field_stays_in_contract() -> None:
    assert "field hilrig.v1.LogBatch 4 entries repeated hilrig.v1.LogEntry" in wire_contract.recorded_entries()


def test_removed_event_kind_stays_in_contract() -> None:
    assert "enum hilrig.v1.Event.Kind 12 SATURATION" in wire_contract.recorded_entries()
    assert "field hilrig.v1.Event 22 saturation_data hilrig.v1.SaturationData" in wire_contract.recorded_entries()
