"""Extracts the delays of a recorded session as a delay trace for network impairment emulation.

The delay of each loop latency sample is the sum of `TRACE_STAGES`. The trace excludes the other stages, because the
impaired rig adds its own; they would be counted twice.
"""

from typing import Final

import numpy as np

from hilrig_replay.analysis.data_quality import OPEN_LOOP
from hilrig_replay.analysis.latency import measure
from hilrig_replay.analysis.stages import CONTROLLER, INJECTED
from hilrig_replay.io.records import Records
from hilrig_replay.io.run import Run
from hilrig_runtime.config.impairment import MAX_DELAY_MS, TraceDelay
from hilrig_runtime.errors import InputError

MIN_SAMPLES: Final = 100
"""Smallest number of samples of a usable delay distribution."""
TRACE_STAGES: Final = (CONTROLLER, INJECTED)
"""Stages outside the rig: both network directions, and the computing time of the controller."""


def delay_trace(run: Run) -> TraceDelay:
    """Delays of a run in chronological order, ms.

    Raises:
        InputError: the run is an open loop, or has gaps (lost messages, a pause of 10 s or more), inconsistent time
            stamps, or fewer than 100 samples.
    """
    effective = 0

    def count(block: Records) -> None:
        nonlocal effective
        effective += int((block.states["basis_step"] != 0).sum())

    report = measure(run, count)
    if OPEN_LOOP in report.reasons:
        raise InputError(f"{run.path}: unusable as a delay trace: {OPEN_LOOP.text}")
    # A lost command shows both as a gap in the sequence numbers and as a state without a sample.
    missing = max(report.lost.total, effective - report.samples)
    if missing:
        raise InputError(f"{run.path}: unusable as a delay trace: gaps, {missing} messages are missing")
    if report.samples < MIN_SAMPLES:
        raise InputError(
            f"{run.path}: unusable as a delay trace: {report.samples} loop latency samples, "
            f"at least {MIN_SAMPLES} are required"
        )
    delays_ms = np.sum([report.table[stage.key] for stage in TRACE_STAGES], axis=0) / 1e6
    if (delays_ms < 0).any():
        raise InputError(f"{run.path}: unusable as a delay trace: inconsistent time stamps, a delay is negative")
    longest = int(np.argmax(delays_ms))
    if delays_ms[longest] > MAX_DELAY_MS:
        raise InputError(
            f"{run.path}: unusable as a delay trace: gaps, the controller was silent for "
            f"{delays_ms[longest] / 1e3:.0f} s before sample {longest + 1} of {report.samples}"
        )
    return TraceDelay(delays_ms=tuple(delays_ms.tolist()))
