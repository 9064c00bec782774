"""The delays of a recorded session as a trace that another loop can be impaired with.

Of each sample of the loop latency it takes what came from outside the rig: the stages *controller* (both network ways
and the controller's own time) and *injected*. Register wait, tick wait, edge and transport arise anew in the rig that
is impaired; with them in the trace they would count twice.
"""

from typing import Final

import numpy as np

from hilrig_replay.analysis.latency import measure
from hilrig_replay.io.records import Records
from hilrig_replay.io.run import Run
from hilrig_runtime.config.impairment import LONGEST_MS, TraceDelay
from hilrig_runtime.errors import InputError

ENOUGH: Final = 100
"""Samples below which a trace says little of a distribution."""


def delay_trace(run: Run) -> TraceDelay:
    """The delays of a run in their order, ms.

    Raises:
        InputError: the run has gaps (messages that are lost, a pause of 10 s or more), stamps that contradict each
            other, or fewer than 100 samples.
    """
    effective = 0

    def count(block: Records) -> None:
        nonlocal effective
        effective += int((block.states["basis_step"] != 0).sum())

    report = measure(run, count)
    # A command that was lost is missed twice: in its sender's numbers, and behind its sample.
    missing = max(report.lost.total, effective - report.samples)
    if missing:
        raise InputError(f"{run.path}: no trace of delays: it has gaps, {missing} messages are missing")
    if report.samples < ENOUGH:
        raise InputError(
            f"{run.path}: no trace of delays: it has {report.samples} samples of the loop, {ENOUGH} are needed"
        )
    delays_ms = (report.table["controller"] + report.table["injected"]) / 1e6
    if (delays_ms < 0).any():
        raise InputError(f"{run.path}: no trace of delays: its stamps contradict each other")
    longest = int(np.argmax(delays_ms))
    if delays_ms[longest] > LONGEST_MS:
        raise InputError(
            f"{run.path}: no trace of delays: it has gaps, the controller was silent for "
            f"{delays_ms[longest] / 1e3:.0f} s before sample {longest + 1} of {report.samples}"
        )
    return TraceDelay(delays_ms=tuple(delays_ms.tolist()))
