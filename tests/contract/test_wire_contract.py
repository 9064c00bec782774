"""The compatibility contract holds, and each kind of violation is detected."""

import hashlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from google.protobuf.descriptor_pb2 import DescriptorProto, FieldDescriptorProto, FileDescriptorProto

import wire_contract
from hilrig_modbus_edge.registers.map import MAP
from hilrig_recorder.ingest.recording import Recording
from hilrig_recorder.mcap_format.ending import Ending
from hilrig_recorder.mcap_format.recover import recover
from hilrig_recorder.storage.store import FileStore
from hilrig_recorder.storage.sync_worker import SyncWorker
from hilrig_runtime.config.lab import RecorderConfig
from hilrig_runtime.timing.clock import SYSTEM_CLOCK
from hilrig_schemas import RigConfig
from support.recorder_rig import metadata
from wire_contract import Contract

FROZEN_0_2_0 = "dab871750ad259517a019de0169ba8bb90cd6c01795b601c152a1ddec6f9a0bb"
STATE = "hilrig.v1.JointState"


def joint_state(files: list[FileDescriptorProto]) -> DescriptorProto:
    return next(message for file in files for message in file.message_type if message.name == "JointState")


def field(message: DescriptorProto, name: str) -> FieldDescriptorProto:
    return next(field for field in message.field if field.name == name)


def frozen() -> set[str]:
    return wire_contract.recorded_entries()[0]


def test_frozen_entries_are_those_of_the_release() -> None:
    # A frozen entry that is edited, added or removed changes this sum; a new release freezes the entries added since.
    text = "\n".join(sorted(frozen()))
    assert hashlib.sha256(text.encode()).hexdigest() == FROZEN_0_2_0


def test_contract_holds() -> None:
    entries = {line for line in frozen() if not wire_contract.is_metadata(line)}
    assert wire_contract.violations(entries, wire_contract.current()) == []


def test_contract_is_complete() -> None:
    entries, added = wire_contract.recorded_entries()
    assert added == wire_contract.current().lines - entries, "run `make gen` and commit the result"


def test_recordings_have_the_metadata_of_the_contract(tmp_path: Path) -> None:
    finished: list[OSError | None] = []
    worker = SyncWorker(SYSTEM_CLOCK, lambda _, error: finished.append(error), lambda _, error: finished.append(error))
    config = RecorderConfig(folder=tmp_path, min_free_mib=0)
    (tmp_path / "lab").mkdir()
    store = FileStore(
        "lab",
        config,
        SYSTEM_CLOCK,
        worker,
        instance="1",
        repeated_ns=0,
        emit=lambda *_: None,
        request_config=lambda _: None,
        on_failed=lambda _: None,
    )
    recording = Recording("rig1", "20260101T000000Z-rig1-abcd", "", "edge/1", 1, 0, student="s1")
    assert store.open(recording)
    store.record_source(recording, "sim/1", 1)
    store.record_loss(recording, "sim/1", "hil/lab/rig1/state", 1, 0)
    store.configure(RigConfig(rig="rig1", incarnation=1, step_ns=20_000_000, urdf="<robot/>"))
    store.close(recording, Ending.ENDED, "")
    assert worker.close(60.0)
    store.release()
    assert finished == [None]
    [path] = (tmp_path / "lab/rig1").iterdir()
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(path.read_bytes()[:-100])
    recover(damaged, tmp_path / "recovered.mcap")
    found = metadata(path) | metadata(tmp_path / "recovered.mcap")
    keys = {f"metadata {name} {key}" for name, values in found.items() for key in values}
    assert {line for line in frozen() if wire_contract.is_metadata(line)} - keys == set()


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
        (remove_and_reserve, [f"field {STATE} 15 magnet bool: removed"]),
        (remove_field, [f"field {STATE} 15 magnet bool: removed"]),
        (reuse_number, [f"field {STATE} 15 magnet bool: is now field {STATE} 15 gripper bool"]),
        (change_type, [f"field {STATE} 4 step uint64: is now field {STATE} 4 step sfixed64"]),
        (make_repeated, [f"field {STATE} 2 session string: is now field {STATE} 2 session repeated string"]),
        (change_number, [f"field {STATE} 20 safe bool: removed"]),
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
        "enum hilrig.v1.Event.Kind 1 SESSION_START: removed"
    ]


def test_reserved_number_and_name_stay_reserved() -> None:
    files = wire_contract.files()
    before = wire_contract.contract(files)
    events = next(message for file in files for message in file.message_type if message.name == "Event")
    assert {"reserved hilrig.v1.Event 22", "reserved hilrig.v1.Event saturation_data"} <= before.reserved & frozen()
    events.ClearField("reserved_range")
    assert wire_contract.violations(before.reserved, wire_contract.contract(files)) == [
        "reserved hilrig.v1.Event 22: removed"
    ]


def test_change_of_topic_key_is_reported() -> None:
    entry = "topic hil/<lab>/<rig>/pose hilrig.v1.JointState control"
    assert wire_contract.violations([entry], wire_contract.current()) == [f"{entry}: removed"]


@pytest.mark.parametrize("change", [{"number": 3}, {"scale": 100}, {"name": "torque1"}, {"writable": False}])
def test_change_of_a_register_is_reported(change: dict[str, Any]) -> None:
    entry = "register holding_register 1 tau1 int16 N·m 1000 writable"
    assert entry in frozen()
    first, *others = MAP
    changed = Contract(frozenset(wire_contract.register_lines([replace(first, **change), *others])), frozenset())
    assert len(wire_contract.violations([entry], changed)) == 1
