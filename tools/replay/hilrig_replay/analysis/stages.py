"""Stages of the loop latency: the one table for samples, statistics, plots, viewer, reports and docs/timing.md."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.io.columns import Rows


@dataclass(frozen=True, slots=True)
class Stage:
    """One stage of a loop: a sum of recorded times, or the remainder of the loop."""

    key: str
    """Name in Python and JSON."""
    title: str
    """Name in tables, plots and the viewer."""
    color: str
    span: str
    """Start and end, as in docs/timing.md."""
    clock: str
    added: tuple[str, ...] = ()
    """Fields of the state (`STATE_DTYPE`) or of its command (`COMMAND_DTYPE`), ns; empty: the remainder of the loop."""
    subtracted: tuple[str, ...] = ()

    @property
    def formula(self) -> str:
        """Sum of the fields, as in docs/export.md."""
        return " − ".join((" + ".join(self.added), *self.subtracted))


REGISTER_WAIT: Final = Stage(
    key="register_wait",
    title="register wait",
    color="#4c78a8",
    span="state arrived at the edge → served to the controller",
    clock="edge",
    added=("state_served_ns",),
    subtracted=("state_arrived_ns", "state_injected_ns"),
)
CONTROLLER: Final = Stage(
    key="controller",
    title="controller",
    color="#f58518",
    span="served → write received: network round trip and computation of the controller",
    clock="edge",
    added=("write_received_ns",),
    subtracted=("state_served_ns",),
)
POSITION_WRITE: Final = Stage(
    key="position_write",
    title="position write",
    color="#eeca3b",
    span="positions sent to the controller → acknowledged",
    clock="edge",
    added=("positions_acknowledged_ns",),
    subtracted=("state_served_ns",),
)
DEVICE: Final = Stage(
    key="device",
    title="device",
    color="#f58518",
    span="acknowledged → read sent: scan of the controller's program, and the wait for the read before the tick",
    clock="edge",
    added=("read_sent_ns",),
    subtracted=("positions_acknowledged_ns",),
)
TORQUE_READ: Final = Stage(
    key="torque_read",
    title="torque read",
    color="#ff9da6",
    span="read sent → torques received",
    clock="edge",
    added=("write_received_ns",),
    subtracted=("read_sent_ns",),
)
EDGE: Final = Stage(
    key="edge",
    title="edge",
    color="#54a24b",
    span="write received → command sent",
    clock="edge",
    added=("sent_ns",),
    subtracted=("write_received_ns", "command_injected_ns"),
)
INJECTED: Final = Stage(
    key="injected",
    title="injected",
    color="#b279a2",
    span="emulated delay of the state link and of the command link",
    clock="edge",
    added=("state_injected_ns", "command_injected_ns"),
)
TICK_WAIT: Final = Stage(
    key="tick_wait",
    title="tick wait",
    color="#72b7b2",
    span="command arrived at the simulation → tick that applies it",
    clock="simulation",
    added=("sampled_ns",),
    subtracted=("command_arrived_ns",),
)
TRANSPORT: Final = Stage(
    key="transport",
    title="transport",
    color="#e45756",
    span="remainder: simulation → edge and edge → simulation, over the bus",
    clock="difference",
)

LOOP_STAGES: Final = (REGISTER_WAIT, CONTROLLER, EDGE, INJECTED, TICK_WAIT, TRANSPORT)
"""Stages of the loop in the order of the data flow; the last is the remainder."""

STAGES: Final = tuple(stage.key for stage in LOOP_STAGES)
"""Names of the stages of the loop."""

_POLLED_STAGES: Final = (POSITION_WRITE, DEVICE, TORQUE_READ)
"""The parts of *controller* if the edge is the client of the controller."""

CLIENT_STAGES: Final = (REGISTER_WAIT, *_POLLED_STAGES, EDGE, INJECTED, TICK_WAIT, TRANSPORT)
"""Stages of the loop in the client role."""

ALL_STAGES: Final = (*LOOP_STAGES, *_POLLED_STAGES)
"""The stages of both roles."""


def stages_of_role(client_role: bool) -> tuple[Stage, ...]:
    """Return the stages in a role of the edge: as the client of the controller, or as its server."""
    return CLIENT_STAGES if client_role else LOOP_STAGES


def fill_stages(samples: NDArray[np.void], stages: Sequence[Stage], states: Rows, commands: Rows) -> None:
    """Compute the stages of samples whose `loop` is set, from their states and commands, row by row.

    The parts of *controller* are 0 if the edge was no client.
    """
    remainder = samples["loop"].copy()
    for stage in stages[:-1]:
        samples[stage.key] = _total(stage.added, states, commands) - _total(stage.subtracted, states, commands)
        remainder -= samples[stage.key]
    samples[stages[-1].key] = remainder
    polled = commands["read_sent_ns"] > 0
    for stage in _POLLED_STAGES:
        duration_ns = _total(stage.added, states, commands) - _total(stage.subtracted, states, commands)
        samples[stage.key] = np.where(polled, duration_ns, 0)


def _total(names: Sequence[str], states: Rows, commands: Rows) -> NDArray[np.int64]:
    total = np.zeros(len(states), np.int64)
    for name in names:
        total += (states if name in (states.dtype.names or ()) else commands)[name]
    return total
