"""Simulation service: a tick at each absolute deadline, and queued calls between two ticks."""

from contextlib import closing

import numpy as np

from hilrig_runtime.process.mailbox import OwnerThreadExecutor
from hilrig_runtime.process.service import Service
from hilrig_runtime.timing.rate import Rate
from hilrig_runtime.timing.realtime import freeze_gc
from hilrig_sim.loop import Simulation
from hilrig_sim.parameters import rig_parameters
from hilrig_sim.rig_registry import RigRegistry


def run(service: Service) -> None:
    """Simulate every rig of the lab until the service is stopped.

    Raises:
        InputError: the parameters of the lab are inconsistent.
    """
    lab = service.lab
    parameters = [rig_parameters(lab, rig) for rig in service.rigs]
    simulation = Simulation(service, parameters)
    executor = OwnerThreadExecutor()
    with closing(RigRegistry(service, simulation, executor)):
        freeze_gc()
        service.ready()
        rate, stopping = Rate(lab.sim.step_ns, service.clock), service.stopping
        # Non-finite numbers are detected and handled by the simulation, without warnings.
        with np.errstate(all="ignore"):
            while not stopping.is_set():
                simulation.pre_encode(rate.next_ns)
                tick = rate.wait()
                simulation.tick(tick)
                executor.run_pending()
                service.beat(service.clock.monotonic_ns())
