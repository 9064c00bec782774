"""The simulation as a service: a tick at each absolute deadline, and between two of them what people asked for."""

import numpy as np

from hilrig_runtime.process.mailbox import Turns
from hilrig_runtime.process.service import Service
from hilrig_runtime.timing.rate import Rate
from hilrig_runtime.timing.realtime import freeze_garbage
from hilrig_sim.loop import Simulation
from hilrig_sim.parameters import rig_parameters
from hilrig_sim.rig_registry import RigRegistry


def run(service: Service) -> None:
    """Simulate every rig of the lab until the service is to stop.

    Raises:
        InputError: the lab's parameters do not fit together.
    """
    lab = service.lab
    parameters = [rig_parameters(lab, rig) for rig in service.rigs]
    simulation = Simulation(service, parameters)
    step_ns = lab.sim.step_ns
    turns = Turns()
    with RigRegistry(service, simulation, turns):
        rate = Rate(step_ns, service.clock)
        freeze_garbage()
        service.ready()
        stopping = service.stopping
        # What can't be computed is dealt with where it shows, not warned of.
        with np.errstate(all="ignore"):
            while not stopping.is_set():
                simulation.pre_encode(rate.next_ns)
                tick = rate.wait()
                simulation.tick(tick)
                turns.run_waiting()
                service.beat(service.clock.monotonic_ns())
