"""What versions promise each other: nothing of it is broken, and each way of breaking it is found."""

from collections.abc import Callable

import pytest
from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto, FileDescriptorProto

import wire_contract

STATE = "hilrig.v1.JointState"


def joint_state(files: list[FileDescriptorProto]) -> DescriptorProto:
    return next(message for file in files for message in file.message_type if message.name == "JointState")


def field(message: DescriptorProto, name: str) -> FieldDescriptorProto:
    return next(field for field in message.field if field.name == name)


def test_every_promise_holds() -> None:
    assert wire_contract.broken(wire_contract.promised(), wire_contract.current()) == []


def test_all_that_is_sent_is_promised() -> None:
    assert wire_contract.current().lines - wire_contract.promised() == set(), "run `make gen` and commit the result"


def take_away(message: DescriptorProto) -> None:
    message.field.remove(field(message, "magnet"))


def take_away_in_order(message: DescriptorProto) -> None:
    take_away(message)
    message.reserved_range.add(start=15, end=16)
    message.reserved_name.append("magnet")


def use_a_number_again(message: DescriptorProto) -> None:
    field(message, "magnet").name = "gripper"


def change_a_type(message: DescriptorProto) -> None:
    field(message, "step").type = FieldDescriptorProto.TYPE_SFIXED64


def make_many_of_one(message: DescriptorProto) -> None:
    field(message, "session").label = FieldDescriptorProto.LABEL_REPEATED


def change_a_number(message: DescriptorProto) -> None:
    field(message, "safe").number = 99


def add_a_field(message: DescriptorProto) -> None:
    message.field.add(name="new", number=99, type=FieldDescriptorProto.TYPE_BOOL)


@pytest.mark.parametrize(
    ("change", "found"),
    [
        (add_a_field, []),
        (take_away_in_order, []),
        (take_away, [f'field {STATE} 15 magnet bool: gone: reserve 15 and "magnet"']),
        (use_a_number_again, [f"field {STATE} 15 magnet bool: is now field {STATE} 15 gripper bool"]),
        (change_a_type, [f"field {STATE} 4 step uint64: is now field {STATE} 4 step sfixed64"]),
        (make_many_of_one, [f"field {STATE} 2 session string: is now field {STATE} 2 session repeated string"]),
        (change_a_number, [f'field {STATE} 20 safe bool: gone: reserve 20 and "safe"']),
    ],
)
def test_a_broken_promise_is_named(change: Callable[[DescriptorProto], None], found: list[str]) -> None:
    files = wire_contract.files()
    before = wire_contract.contract(files)
    change(joint_state(files))
    assert wire_contract.broken(before.lines, wire_contract.contract(files)) == found


def test_an_enums_value_stays() -> None:
    files = wire_contract.files()
    before = wire_contract.contract(files)
    kinds = next(enum for file in files for message in file.message_type for enum in message.enum_type)
    assert (kinds.name, kinds.value[1].name) == ("Kind", "SESSION_START")
    kinds.value[1].number = 99
    assert wire_contract.broken(before.lines, wire_contract.contract(files)) == [
        "enum hilrig.v1.Event.Kind 1 SESSION_START: changed or gone"
    ]


def test_a_topics_key_stays() -> None:
    promised = "topic hil/<lab>/<rig>/pose hilrig.v1.JointState control"
    assert wire_contract.broken([promised], wire_contract.current()) == [f"{promised}: changed or gone"]


def test_what_is_gone_stays_reserved() -> None:
    assert "field hilrig.v1.LogBatch 4 entries repeated hilrig.v1.LogEntry" in wire_contract.promised()
