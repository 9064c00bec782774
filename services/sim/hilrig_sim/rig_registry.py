"""Rigs of a simulation: serves their configuration, and adds and removes rigs at run time.

A request arrives on a thread of the bus, which creates the new plant, a slow operation. The thread of the simulation
then copies the state of every rig into it between two ticks, which is fast, so that other rigs are not disturbed. The
changes are active until the simulation stops; the next one starts with the rigs of lab.toml.
"""

import json
import threading
from dataclasses import asdict, dataclass
from functools import partial
from importlib.metadata import version

from hilrig_runtime.bus.api import Handle
from hilrig_runtime.config.lab import read_rig
from hilrig_runtime.errors import OperationError
from hilrig_runtime.process.control import Handlers, handle_control_request
from hilrig_runtime.process.mailbox import OwnerThreadExecutor
from hilrig_runtime.process.service import Service
from hilrig_schemas import AddRig, ControlReply, Event, RemoveRig, RigConfig, topics
from hilrig_sim.arm.model import RigParameters, describe_substeps
from hilrig_sim.arm.urdf import urdf
from hilrig_sim.loop import Simulation
from hilrig_sim.parameters import rig_parameters
from hilrig_sim.plant.plant import Plant
from hilrig_sim.platform_fingerprint import machine_name


@dataclass(frozen=True, slots=True)
class StaticReply:
    """Answers every query with the same payload."""

    payload: bytes

    def __call__(self, query: bytes) -> bytes:
        """Return the payload."""
        del query
        return self.payload


class RigRegistry:
    """Registry of the simulated rigs."""

    def __init__(self, service: Service, simulation: Simulation, executor: OwnerThreadExecutor) -> None:
        self._service = service
        self._simulation = simulation
        self._executor = executor
        self._changing = threading.Lock()
        """Serializes the threads of the bus: a change takes more than one call of the simulation's thread."""
        self._served: dict[str, Handle] = {}
        for rig, parameters in zip(service.rigs, simulation.parameters, strict=True):
            self._serve(rig.name, parameters)
            self._emit_start(rig.name, parameters)
        key = topics.CONTROL.key(service.lab.name, service.name, service.instance)
        handlers: Handlers = {"add_rig": self._add_rig, "remove_rig": self._remove_rig}
        self._control = service.bus.declare_queryable(key, partial(handle_control_request, handlers))
        service.counters.rigs = len(service.rigs)

    def close(self) -> None:
        """Withdraw the queries."""
        self._control.close()
        for handle in self._served.values():
            handle.close()

    def _serve(self, rig: str, parameters: RigParameters) -> None:
        reply = StaticReply(configuration(self._service, rig, parameters).SerializeToString())
        key = topics.CONFIG.key(self._service.lab.name, rig)
        self._served[rig] = self._service.bus.declare_queryable(key, reply)

    def _emit_start(self, rig: str, parameters: RigParameters) -> None:
        """Emit that a simulation starts, with its step: an open session then records that it was replaced."""
        sim = parameters.sim
        event = Event(kind=Event.CONFIGURATION, severity=Event.INFO, rig=rig)
        steps = "" if sim.substeps == 1 else f", {describe_substeps(sim.substeps)}"
        event.text = f"simulation started: step {sim.step * 1e3:g} ms, {sim.integrator}{steps}"
        event.configuration_data.text = json.dumps(asdict(sim))
        self._service.emit(event)

    def _add_rig(self, request: AddRig) -> ControlReply:
        service, simulation, rig = self._service, self._simulation, read_rig(request.settings_json)
        with self._changing:
            if rig.name in self._served:
                raise OperationError(f"rig {rig.name!r} is already simulated here; choose another name")
            parameters = rig_parameters(service.lab, rig)
            plant = Plant([*simulation.parameters, parameters])
            self._executor.call(lambda: simulation.add(rig.name, plant))
            self._serve(rig.name, parameters)
            service.set_rigs((*service.rigs, rig))
        return self._emit_result(Event.RIG_ADDED, rig.name, f"{rig.name} is simulated", request.settings_json)

    def _remove_rig(self, request: RemoveRig) -> ControlReply:
        service, simulation, name = self._service, self._simulation, request.rig
        with self._changing:
            names = [rig.name for rig in service.rigs]
            if name not in names:
                raise OperationError(f"rig {name!r} is not simulated here; hilrig rig list shows all rigs")
            if len(names) == 1:
                raise OperationError(
                    f"rig {name!r} is the only rig of this simulation, and can't be removed; stop the simulation "
                    "instead"
                )
            index = names.index(name)
            plant = Plant([parameters for number, parameters in enumerate(simulation.parameters) if number != index])
            self._executor.call(lambda: simulation.remove(index, plant))
            self._served.pop(name).close()
            service.set_rigs(tuple(rig for rig in service.rigs if rig.name != name))
        return self._emit_result(Event.RIG_REMOVED, name, f"{name} is no longer simulated")

    def _emit_result(self, kind: Event.Kind, rig: str, text: str, settings_json: str = "") -> ControlReply:
        event = Event(kind=kind, severity=Event.INFO, rig=rig, text=text)
        event.configuration_data.text = settings_json
        self._executor.call(lambda: self._service.emit(event))
        return ControlReply(text=text)


def configuration(service: Service, rig: str, parameters: RigParameters) -> RigConfig:
    """Return the configuration of a rig, as published on the bus."""
    return RigConfig(
        rig=rig,
        incarnation=service.incarnation,
        step_ns=parameters.sim.step_ns,
        parameters_json=parameters.to_json(),
        urdf=urdf(parameters, rig),
        lab_toml=service.lab.source,
        software_version=version("hilrig"),
        machine=machine_name(),
    )
