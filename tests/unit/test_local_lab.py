"""Readiness of a lab on one host."""

from hilrig_cli.local.local_lab import unrecorded
from hilrig_cli.local.supervisor import DEFAULT_PROCESSES, lab_processes
from hilrig_runtime.bus.memory_bus import MemoryBus, MemoryHub
from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.process.service import Service


def test_lab_is_ready_when_its_recorders_receive_all() -> None:
    hub, lab = MemoryHub(), LabConfig()
    bus = MemoryBus(hub)
    assert unrecorded(bus, lab, DEFAULT_PROCESSES) == "a recorder does not reply"
    with Service("recorder", lab, MemoryBus(hub)) as recorder:
        assert unrecorded(bus, lab, DEFAULT_PROCESSES) == "recorder/1 receives nothing from edge/1, sim/1"
        recorder.last_received = lambda: {"sim/1": 1}
        assert unrecorded(bus, lab, DEFAULT_PROCESSES) == "recorder/1 receives nothing from edge/1"
        recorder.last_received = lambda: {"sim/1": 1, "edge/1": 1, "edge/2": 1}
        assert unrecorded(bus, lab, DEFAULT_PROCESSES) == ""
        assert unrecorded(bus, lab, lab_processes(["a", "b"], edges=2, recorders=2)) == "a recorder does not reply"
