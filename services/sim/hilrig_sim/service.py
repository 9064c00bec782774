"""Simulation service: a tick at each absolute deadline, and queued calls between two ticks."""

import logging
import math
from contextlib import closing

import numpy as np

from hilrig_runtime.process.mailbox import OwnerThreadExecutor
from hilrig_runtime.process.service import Service
from hilrig_runtime.timing.rate import Rate
from hilrig_runtime.timing.realtime import freeze_gc
from hilrig_sim.accuracy import accuracy_warnings
from hilrig_sim.arm.model import AUTO
from hilrig_sim.arm.stability import longest_turn
from hilrig_sim.loop import Simulation
from hilrig_sim.parameters import rig_parameters
from hilrig_sim.rig_registry import RigRegistry

logger = logging.getLogger(__name__)


def run(service: Service) -> None:
    """Simulate every rig of the lab until the service is stopped.

    Raises:
        InputError: the parameters of the lab are inconsistent.
    """
    lab = service.lab
    parameters = [rig_parameters(lab, rig) for rig in service.rigs]
    # Only the steps of a fast arm can have errors that their estimates do not show.
    fast = {
        rig.name: values
        for rig, values in zip(service.rigs, parameters, strict=True)
        if values.sim.substeps == AUTO and math.isfinite(longest_turn(values.arm, values.sim))
    }
    for warning in accuracy_warnings(fast):
        logger.warning("%s", warning)
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
