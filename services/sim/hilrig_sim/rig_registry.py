"""Which rigs a simulation has: those that it began with, and those that are added and taken away while it runs.

A request comes on a thread of the bus. There the new plant is made, which takes a while; the simulation's own thread
then moves every rig's state into it between two ticks, which does not, so that no other rig feels it. What is changed
so holds until the simulation ends: the next one begins with the lab's file again.
"""

import json
from dataclasses import asdict, dataclass
from importlib.metadata import version
from types import TracebackType
from typing import Self

from google.protobuf.message import DecodeError

from hilrig_runtime.bus.api import Handle
from hilrig_runtime.config.lab import RigSettings, read_rig
from hilrig_runtime.errors import OperationError
from hilrig_runtime.process.mailbox import OwnerThreadExecutor
from hilrig_runtime.process.service import Service
from hilrig_schemas import Event, RigConfig, topics
from hilrig_sim.arm.model import RigParameters
from hilrig_sim.arm.urdf import urdf
from hilrig_sim.loop import Simulation
from hilrig_sim.parameters import rig_parameters
from hilrig_sim.plant.plant import Plant
from hilrig_sim.platform_fingerprint import machine_name


@dataclass(frozen=True, slots=True)
class Constant:
    """Answers every question alike."""

    payload: bytes

    def __call__(self, question: bytes) -> bytes:
        """The answer, whatever is asked."""
        del question
        return self.payload


class Membership:
    """Answers for each rig what it is, and changes which there are; a context manager."""

    def __init__(self, service: Service, simulation: Simulation, turns: OwnerThreadExecutor) -> None:
        self._service = service
        self._simulation = simulation
        self._turns = turns
        self._served: dict[str, Handle] = {}
        for rig, parameters in zip(service.rigs, simulation.parameters, strict=True):
            self._serve(rig.name, parameters)
            self._tell(rig.name, parameters)
        key = topics.CONTROL.key(service.lab.name, service.name, service.instance)
        self._control = service.bus.declare_queryable(key, self._answer)
        service.counters.rigs = len(service.rigs)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._control.close()
        for handle in self._served.values():
            handle.close()

    def _serve(self, rig: str, parameters: RigParameters) -> None:
        answer = Constant(configuration(self._service, rig, parameters).SerializeToString())
        key = topics.CONFIG.key(self._service.lab.name, rig)
        self._served[rig] = self._service.bus.declare_queryable(key, answer)

    def _tell(self, rig: str, parameters: RigParameters) -> None:
        """Say that a simulation begins, and how it steps; a session that was going on records where it was replaced."""
        sim = parameters.sim
        event = Event(kind=Event.CONFIGURATION, severity=Event.INFO, rig=rig)
        steps = f", {sim.substeps} sub-steps" if sim.substeps > 1 else ""
        event.text = f"simulated from now on: step {sim.step * 1e3:g} ms, {sim.integrator}{steps}"
        event.configuration_data.text = json.dumps(asdict(sim))
        self._service.emit(event)

    def _answer(self, payload: bytes) -> bytes:
        try:
            request = Event.FromString(payload)
        except DecodeError as error:
            raise OperationError("a request that can't be decoded") from error
        with self._turns.exclusive:
            if request.kind == Event.RIG_ADDED:
                text = self._add(read_rig(request.configuration_data.text))
            elif request.kind == Event.RIG_REMOVED:
                text = self._remove(request.rig)
            else:
                raise OperationError("a request that the simulation does not know")
        answer = Event(kind=request.kind, severity=Event.INFO, rig=request.rig, text=text)
        answer.configuration_data.text = request.configuration_data.text
        self._turns.call(lambda: self._service.emit(answer))
        return answer.SerializeToString()

    def _add(self, rig: RigSettings) -> str:
        service, simulation = self._service, self._simulation
        if rig.name in self._served:
            raise OperationError(f"{rig.name!r} is simulated already")
        parameters = rig_parameters(service.lab, rig)
        plant = Plant([*simulation.parameters, parameters])
        self._turns.call(lambda: simulation.add(rig.name, plant))
        self._serve(rig.name, parameters)
        self._changed((*service.rigs, rig))
        return f"{rig.name} is simulated"

    def _remove(self, name: str) -> str:
        service, simulation = self._service, self._simulation
        names = [rig.name for rig in service.rigs]
        if name not in names:
            raise OperationError(f"{name!r} is not simulated here")
        if len(names) == 1:
            raise OperationError(f"{name!r} is the only rig: end the simulation instead")
        index = names.index(name)
        others = [parameters for number, parameters in enumerate(simulation.parameters) if number != index]
        plant = Plant(others)
        self._turns.call(lambda: simulation.remove(index, plant))
        self._served.pop(name).close()
        self._changed(tuple(rig for rig in service.rigs if rig.name != name))
        return f"{name} is simulated no more"

    def _changed(self, rigs: tuple[RigSettings, ...]) -> None:
        self._service.rigs = rigs
        self._service.counters.rigs = len(rigs)


def configuration(service: Service, rig: str, parameters: RigParameters) -> RigConfig:
    """What a rig is, for whoever asks."""
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
