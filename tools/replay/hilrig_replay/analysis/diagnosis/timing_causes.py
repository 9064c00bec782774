"""Timing causes: rules that explain the age of the loop, each with its evidence and the expected gain.

The gain of a cause is the reduction of the mean age without it. For a delay between reading and the tick, the command
is moved to the tick at which it would have acted. For a stall or a pause of length D it is the age that grows in it,
D²/2 of the integral over time.
"""

from collections.abc import Callable
from typing import Final

import numpy as np

from hilrig_replay.analysis.diagnosis.evidence import MS, NO_PAUSE_NS, PROGRAM_NS, Evidence, Finding, Floats
from hilrig_replay.analysis.stages import CONTROLLER, INJECTED, REGISTER_WAIT, TICK_WAIT
from hilrig_replay.io.columns import Rows

Rule = Callable[[Evidence], Finding | None]

MIN_SHARE: Final = 0.05
"""Smallest share of the age that a cause explains."""
MIN_RARE_SHARE: Final = 0.01
"""The same for stalls and pauses, which hardly show in a mean."""
MIN_READ_SHARE: Final = 0.01
"""Smallest ratio of states that were read to samples: a program that reads once and then only writes is no loop."""
MIN_OPEN_LOOP_SAMPLES: Final = 100
MIN_DELAY_NS: Final = 3_000_000
"""Shortest wait or computation that is a cause."""
SLOW_CYCLE: Final = 1.15
"""Cycle, steps, from which polling is slow; up to this deviation from a step it beats."""
MAX_WAIT_SPREAD: Final = 0.02
"""Largest interquartile range of a wait, as a share of it: computations vary more."""
MAX_ROUND_WAIT_SPREAD: Final = 0.06
"""The same for a wait of a multiple of `ROUND_NS`, as programs contain it."""
MAX_EARLY_SPREAD: Final = 0.015
"""Largest difference of the 25th and the 5th percentile of a wait of a multiple of `ROUND_NS`, as a share of it: on a
busy host a sleep is often longer than requested, but never shorter. Of a computation, it is the standard deviation."""
MAX_TIMER_SPREAD: Final = 0.2
"""The same if the cycle is kept with absolute deadlines."""
MIN_CORRECTION: Final = 0.2
"""Smallest negative correlation of consecutive cycles with absolute deadlines, for which −0.5 is expected."""
MIN_DRIFT_SHARE: Final = 0.2
"""Smallest interquartile range of the time between reading and writing, as a share of the cycle, that is no constant
phase."""
ROUND_NS: Final = 5 * MS
MAX_OVERSLEPT_NS: Final = 1.2 * MS
"""Largest time by which a wait is longer than requested, with the time of the requests."""
ACK_DELAYS_NS: Final = ((39 * MS, 49 * MS), (195 * MS, 215 * MS))
"""Ranges of TCP's delayed-acknowledgment timeout: 40 ms on Linux and up to two ticks of 4 ms, 200 ms on Windows."""
MIN_RTT_NS: Final = 1 * MS
"""Smallest round-trip time of a network that is a cause."""
MAX_REPEATED_SHARE: Final = 0.75
"""Ratio of states that were read to samples below which writes repeat: of two writes of each read it is a half."""
PAUSE_RATIO: Final = 2.5
"""Ratio to the median cycle from which a cycle is a pause."""
RETRANSMISSION_WINDOW_NS: Final = 1.5e9
"""Time before a count of retransmissions in which its pause began: the counts are read once a second."""
MIN_REFUSED_WRITES: Final = 5
SERVER_BUSY: Final = 6
"""Modbus exception of a write that is refused because of another client."""
_WRITES: Final = (5, 6, 15, 16, 22, 23)


def _cause(
    evidence: Evidence,
    code: str,
    text: str,
    remedy: str,
    gain_ns: float,
    /,
    **values: float,
) -> Finding:
    """A finding with the share of the age that its gain is, which includes the age that the timestamps do not show."""
    total_ns = evidence.mean_age_ns + evidence.hidden_age_ns
    share = min(gain_ns / total_ns, 1.0) if total_ns > 0 else 0.0
    return Finding("timing", code, text, remedy, gain_ns / MS, {"share": share, **values})


def open_loop(evidence: Evidence) -> Finding | None:
    """Torques that do not depend on the positions."""
    count = len(evidence.samples)
    if evidence.open_loop:
        text = "open loop: positions are read on another connection, and the torques do not follow them"
    elif count >= MIN_OPEN_LOOP_SAMPLES and evidence.bases < MIN_READ_SHARE * count:
        states = "1 state" if evidence.bases == 1 else f"{evidence.bases} states"
        text = f"open loop: {count} commands are based on {states}: the program writes without reading"
    else:
        return None
    values = {"samples": float(count), "states": float(evidence.bases), "share": 1.0}
    gain_ms = None if evidence.age is None else max(evidence.mean_age_ns - evidence.step_ns, 0.0) / MS
    return Finding("timing", "open_loop", text, "read the positions before each write", gain_ms, values)


def previous_poll(evidence: Evidence) -> Finding | None:
    """Torques that are computed from the positions of an earlier poll."""
    behind = evidence.gains.polls_behind
    if not behind:
        return None
    added_ns = evidence.hidden_age_ns
    polls = "the previous poll" if behind == 1 else f"the poll {behind} polls before"
    cycle_ns = _median(evidence.cycles()["cycle_ns"])
    periods = "one period" if behind == 1 else f"{behind} periods"
    return _cause(
        evidence,
        "previous_poll",
        f"the torques act on {polls}: add {periods} of {cycle_ns / MS:.0f} ms to the measured latency",
        "write the torques that are computed from the positions just read",
        added_ns,
        polls=float(behind),
        period_ms=cycle_ns / MS,
        added_ms=added_ns / MS,
    )


def delayed_acknowledgement(evidence: Evidence) -> Finding | None:
    """Requests in two segments, the second of which waits for an acknowledgment (Nagle's algorithm)."""
    cycles = evidence.cycles()
    if len(cycles) < 10:
        return None
    for low, high in ACK_DELAYS_NS:
        # Each request of a program waits; a program that itself waits does so between two certain requests.
        waits_ns = [cycles[name] - evidence.min_rtt_ns for name in ("held_ns", "pause_ns")]
        shares = [float(((wait_ns > low) & (wait_ns < high)).mean()) for wait_ns in waits_ns]
        if min(shares) < 0.5:
            continue
        wait_ns = float(np.median(cycles["held_ns"]))

        def earlier(rows: Rows) -> Floats:
            return np.where(rows[CONTROLLER.key] > low, low, 0.0)  # noqa: B023

        # Also the hold: both requests of a cycle wait.
        gain_ns = evidence.saved_ns(earlier) + low
        return _cause(
            evidence,
            "delayed_acknowledgement",
            f"{min(shares):.0%} of the requests are complete only after {wait_ns / MS:.0f} ms: each is sent in two "
            "segments, and the second waits for TCP's delayed acknowledgment",
            "set TCP_NODELAY in the controller, and send each request with one call",
            min(gain_ns, max(evidence.mean_age_ns - evidence.step_ns, 0.0)),
            wait_ms=wait_ns / MS,
            delayed_share=min(shares),
        )
    return None


def wait_before_write(evidence: Evidence) -> Finding | None:
    """A program that reads, waits, and then writes."""
    cycles = evidence.cycles()
    if _reads_unsynchronized(evidence, cycles):
        held_ns = float(cycles["held_ns"].mean())
        return _cause(
            evidence,
            "wait_before_write",
            f"positions wait {held_ns / MS:.0f} ms on average before the torques are written: they are read on another "
            "connection, and the times of reading and writing are not related",
            "read, compute and write in one thread, then wait",
            evidence.saved_ns(lambda rows: _computing_ns(evidence, rows)),
            wait_ms=held_ns / MS,
            cycle_ms=_median(cycles["cycle_ns"]) / MS,
        )
    wait_ms = _wait_ns(evidence, cycles) / MS
    if not wait_ms:
        return None
    gain_ns = evidence.saved_ns(lambda rows: _computing_ns(evidence, rows))
    return _cause(
        evidence,
        "wait_before_write",
        f"the program waits {wait_ms:.0f} ms between read and write",
        "read, compute, write, then wait",
        gain_ns,
        wait_ms=wait_ms,
        cycle_ms=_median(cycles["cycle_ns"]) / MS,
    )


def _wait_ns(evidence: Evidence, cycles: Rows) -> float:
    """Wait between reading and writing, ns: constant, without another one after the write; 0: it is not a wait.

    Without the time of the requests, if the wait is a multiple of `ROUND_NS`.
    """
    if len(cycles) < 3:
        return 0.0
    shortest, low, held, high = (np.percentile(cycles["held_ns"], (5, 25, 50, 75)) - evidence.min_rtt_ns).tolist()
    if held < MIN_DELAY_NS or _median(cycles["pause_ns"]) - evidence.min_rtt_ns > max(NO_PAUSE_NS, 0.1 * held):
        return 0.0
    if _is_round(shortest) and low - shortest < MAX_EARLY_SPREAD * held:
        return float(shortest - shortest % ROUND_NS)
    if _keeps_deadlines(cycles["cycle_ns"]):
        largest = MAX_TIMER_SPREAD
    else:
        largest = MAX_ROUND_WAIT_SPREAD if _is_round(held) else MAX_WAIT_SPREAD
    if high - low >= largest * held:
        return 0.0
    return float(held - held % ROUND_NS if _is_round(held) else held)


def _keeps_deadlines(cycle_ns: Floats) -> bool:
    """Whether cycles are kept with absolute deadlines: after a long one, the next is shorter."""
    moved = np.minimum(cycle_ns, PAUSE_RATIO * _median(cycle_ns))
    moved = moved - moved.mean()
    return bool((moved[1:] * moved[:-1]).sum() < -MIN_CORRECTION * (moved**2).sum())


def _reads_unsynchronized(evidence: Evidence, cycles: Rows) -> bool:
    """Whether one thread reads and another one writes, so that the time between them drifts."""
    if not evidence.other_connection or len(cycles) < 10:
        return False
    low, high = np.percentile(cycles["held_ns"], (25, 75))
    return bool(high - low >= MIN_DRIFT_SHARE * _median(cycles["cycle_ns"]))


def _is_round(wait_ns: float) -> bool:
    """Whether a wait is a multiple of `ROUND_NS`, beside the time of the requests."""
    return wait_ns > ROUND_NS and wait_ns % ROUND_NS < MAX_OVERSLEPT_NS


def _computing_ns(evidence: Evidence, rows: Rows) -> Floats:
    """Time between reading and writing that is not of the network, nor of a small program, of samples."""
    spent_ns = rows[CONTROLLER.key] - evidence.min_rtt_ns
    return np.where(spent_ns > MIN_DELAY_NS, spent_ns - PROGRAM_NS, 0.0)


def _writes_without_reading(evidence: Evidence) -> bool:
    """Whether a program writes several times for each read."""
    return evidence.bases < MAX_REPEATED_SHARE * len(evidence.samples)


def computing_time(evidence: Evidence) -> Finding | None:
    """A long time between reading and writing."""
    gain_ns, cycles = evidence.saved_ns(lambda rows: _computing_ns(evidence, rows)), evidence.cycles()
    if not gain_ns or _writes_without_reading(evidence):
        return None
    spent_ns = (cycles["held_ns"] if len(cycles) else evidence.samples[CONTROLLER.key]) - evidence.min_rtt_ns
    spent_ns = spent_ns[spent_ns > MIN_DELAY_NS]
    if not len(spent_ns):
        return None
    typical_ms = float(np.median(spent_ns)) / MS
    cause = "the time that the program computes" + ("" if evidence.min_rtt_ns else ", or a slow network")
    return _cause(
        evidence,
        "computing_time",
        f"{typical_ms:.0f} ms pass between reading the positions and writing the torques: {cause}",
        "faster code, or a faster computer",
        gain_ns,
        computing_ms=typical_ms,
        cycle_ms=_median(cycles["cycle_ns"]) / MS,
    )


def slow_polling(evidence: Evidence) -> Finding | None:
    """A controller that waits after the write for longer than the step permits."""
    cycles, step_ns = evidence.cycles(), evidence.step_ns
    if len(cycles) < 3:
        return None
    cycle_ns = _median(cycles["cycle_ns"])
    pause_ns = _median(cycles["pause_ns"]) - evidence.min_rtt_ns
    if cycle_ns < SLOW_CYCLE * step_ns or pause_ns < max(NO_PAUSE_NS, 0.1 * cycle_ns):
        return None
    # A torque is held for a cycle: on average it is half of the additional steps older.
    gain_ns = (cycle_ns - max(cycle_ns - pause_ns, step_ns)) / 2
    age = f", the mean age {evidence.mean_age_ns / MS:.0f} ms" if evidence.age else ""
    repeats = ", and writes again without reading" if _writes_without_reading(evidence) else ""
    return _cause(
        evidence,
        "slow_polling",
        f"the program polls every {cycle_ns / MS:.0f} ms{repeats}; the step is {step_ns / MS:g} ms{age}",
        f"poll at least every {step_ns / MS:g} ms",
        gain_ns,
        cycle_ms=cycle_ns / MS,
        step_ms=step_ns / MS,
        pause_ms=pause_ns / MS,
    )


def network(evidence: Evidence) -> Finding | None:
    """A network whose smallest round-trip time delays the commands."""
    rtt_ns = evidence.min_rtt_ns
    if rtt_ns < MIN_RTT_NS:
        return None
    return _cause(
        evidence,
        "network",
        f"the network takes at least {rtt_ns / MS:.1f} ms between reading and writing (the smallest round-trip time "
        "of TCP)",
        "a shorter way to the rig: a cable instead of a radio link, a nearer host",
        evidence.saved_ns(lambda rows: np.full(len(rows), rtt_ns)),
        min_rtt_ms=rtt_ns / MS,
    )


def retransmissions(evidence: Evidence) -> Finding | None:
    """Pauses in which TCP segments were lost and sent again."""
    lost, area, longest_ns, duration_ns = 0, 0.0, 0.0, 0.0
    for window in evidence.windows:
        commands, tcp = window.commands, window.connections
        commands = commands[~commands["safe"] & (commands["write_arrived_ns"] > 0)]
        if len(commands) < 3:
            continue
        apart_ns = np.diff(commands["wall_ns"]).astype(np.float64)
        duration_ns += float(np.maximum(apart_ns, 0).sum())
        paused = apart_ns > PAUSE_RATIO * max(float(np.median(apart_ns)), 1.0)
        near = np.zeros(len(apart_ns), np.bool_)
        for code in np.unique(tcp["controller"]):
            rows = tcp[tcp["controller"] == code]
            more = np.diff(rows["retransmissions"].astype(np.int64))
            for at_ns, count in zip(rows["wall_ns"][1:][more > 0], more[more > 0], strict=True):
                lost += int(count)
                near |= np.abs(commands["wall_ns"][1:] - at_ns) < RETRANSMISSION_WINDOW_NS
        pauses_ns = apart_ns[paused & near]
        area += float((pauses_ns**2).sum()) / 2
        longest_ns = max(longest_ns, float(pauses_ns.max(initial=0.0)))
    if not lost or not duration_ns or not longest_ns:
        return None
    return _cause(
        evidence,
        "retransmissions",
        f"the network loses packets: {_times(lost)} a response was sent again, and the controller paused for up to "
        f"{longest_ns / MS:.0f} ms",
        "a network without losses: a cable instead of a radio link",
        area / duration_ns,
        retransmissions=float(lost),
        longest_ms=longest_ns / MS,
    )


def edge_stall(evidence: Evidence) -> Finding | None:
    """Stalls of the Modbus edge."""
    stalls = evidence.edge_stalls
    if not stalls.count or stalls.starved:
        return None
    longest_ms, at_s = stalls.longest_ns / MS, stalls.at_ns / 1e9
    return _cause(
        evidence,
        "edge_stall",
        f"the Modbus edge stalled {stalls} (at {at_s:.1f} s), and delayed the requests: its host was overloaded",
        "a host with less load",
        _per_time(evidence, stalls.area_ns2),
        stalls=float(stalls.count),
        longest_ms=longest_ms,
        at_s=at_s,
    )


def simulation_stall(evidence: Evidence) -> Finding | None:
    """Ticks that were more than one step late."""
    stalls = evidence.stalls
    if not stalls.count or stalls.starved:
        return None
    longest_ms, at_s = stalls.longest_ns / MS, stalls.at_ns / 1e9
    return _cause(
        evidence,
        "simulation_stall",
        f"the simulation stalled {_times(stalls.count)}, longest {longest_ms:.0f} ms at {at_s:.1f} s: its host was "
        "overloaded or suspended",
        "a host with less load",
        _per_time(evidence, stalls.area_ns2),
        stalls=float(stalls.count),
        longest_ms=longest_ms,
        at_s=at_s,
    )


def cpu_steal(evidence: Evidence) -> Finding | None:
    """Stalls in which a service was ready to run, and the host gave its processors to other programs."""
    services = (("simulation", evidence.stalls), ("Modbus edge", evidence.edge_stalls))
    starved = [(name, stalls) for name, stalls in services if stalls.starved]
    if not starved:
        return None
    name, longest = max(starved, key=lambda one: one[1].longest_ns)
    count, names = sum(stalls.count for _, stalls in starved), " and ".join(f"the {name}" for name, _ in starved)
    longest_ms, waited_ms = longest.longest_ns / MS, min(longest.run_delay_ns, longest.longest_ns) / MS
    return _cause(
        evidence,
        "cpu_steal",
        f"other programs of the host took the processor of {names} {_times(count)}: the {name} was ready to run for "
        f"{waited_ms:.0f} of the {longest_ms:.0f} ms of its longest stall",
        "end the other programs, or run the services with real-time priority (hilrig doctor)",
        _per_time(evidence, sum(stalls.area_ns2 for _, stalls in starved)),
        stalls=float(count),
        longest_ms=longest_ms,
        run_delay_ms=waited_ms,
        at_s=longest.at_ns / 1e9,
    )


def injected_delay(evidence: Evidence) -> Finding | None:
    """Delay that was injected by a configured impairment."""
    total_ns, largest_ns = 0.0, 0.0
    for values in evidence.samples.column(INJECTED.key)():
        total_ns += float(values.sum())
        largest_ns = max(largest_ns, float(values.max(initial=0)))
    if largest_ns <= 0:
        return None
    mean_ms = total_ns / len(evidence.samples) / MS
    return _cause(
        evidence,
        "injected_delay",
        f"the configured impairment adds {mean_ms:.1f} ms to the loop on average, up to {largest_ns / MS:.1f} ms "
        "(state link and command link together)",
        "none: it is intended",
        evidence.saved_ns(lambda rows: rows[INJECTED.key].astype(np.float64)),
        mean_ms=mean_ms,
        max_ms=largest_ns / MS,
    )


def beating(evidence: Evidence) -> Finding | None:
    """A cycle of about one step: reads and writes drift past the ticks, or stay at an unfavorable phase."""
    cycles, step_ns = evidence.cycles(), evidence.step_ns
    if len(cycles) < 10:
        return None
    regular = cycles["cycle_ns"][cycles["cycle_ns"] < PAUSE_RATIO * _median(cycles["cycle_ns"])]
    cycle_ns = float(regular.mean())
    if abs(cycle_ns - step_ns) > (SLOW_CYCLE - 1) * step_ns:
        return None
    late = count = 0
    for rows in evidence.samples.blocks("loop", REGISTER_WAIT.key, TICK_WAIT.key):
        # Steps that the loop takes without waiting for the next poll and the next tick.
        loop_ns, register_ns, tick_ns = rows["loop"], rows[REGISTER_WAIT.key], rows[TICK_WAIT.key]
        needed = np.ceil((loop_ns - register_ns - tick_ns) / step_ns)
        late += int((np.rint(loop_ns / step_ns) > np.maximum(needed, 1)).sum())
        count += len(rows)
    if not late:
        return None
    off_ns = abs(cycle_ns - step_ns)
    # A cycle longer than the step also holds a torque for a step more, once a period.
    gain_ns = late / count * step_ns + (off_ns if cycle_ns > step_ns else 0.0)
    gain_ns = min(gain_ns, max(evidence.mean_age_ns - step_ns, 0.0))
    values = {"cycle_ms": cycle_ns / MS, "late_share": late / count}
    missed = f"{late / count:.0%} of the commands miss a tick"
    if off_ns > 1e-4 * step_ns:
        values["period_s"] = step_ns / off_ns * cycle_ns / 1e9
        text = (
            f"the cycle of the controller ({cycle_ns / MS:.2f} ms) beats with the step ({step_ns / MS:g} ms), with a "
            f"period of {values['period_s']:.1f} s: {missed}"
        )
    else:
        text = f"the controller polls once a step ({step_ns / MS:g} ms), at an unfavorable phase: {missed}"
    return _cause(
        evidence,
        "beating",
        text,
        f"use a cycle that is clearly shorter than the step, such as {step_ns / 2 / MS:g} ms",
        gain_ns,
        **values,
    )


def watchdog_gaps(evidence: Evidence) -> Finding | None:
    """Pauses of the controller in which the watchdog set the torques to zero."""
    if not evidence.watchdog_gaps:
        return None
    share = 0.0 if evidence.age is None else evidence.age.uncontrolled_share
    text = (
        f"the controller paused {_times(evidence.watchdog_gaps)} for longer than the time of the watchdog: on "
        f"{share:.1%} of the steps no torque of the controller acted"
    )
    remedy = "write in each cycle, also if the torques do not change"
    values = {"share": share, "gaps": float(evidence.watchdog_gaps), "uncontrolled_share": share}
    return Finding("timing", "watchdog_gaps", text, remedy, None, values)


def controller_pauses(evidence: Evidence) -> Finding | None:
    """Times without a write that are much longer than the cycle."""
    cycles = evidence.cycles()["cycle_ns"]
    paused = cycles[cycles > max(PAUSE_RATIO * _median(cycles), PAUSE_RATIO * evidence.step_ns)]
    if not len(paused):
        return None
    longest_ms = float(paused.max()) / MS
    return _cause(
        evidence,
        "controller_pauses",
        f"the controller did not write for up to {longest_ms:.0f} ms: {len(paused)} of {len(cycles)} cycles were more "
        f"than {PAUSE_RATIO:g} times as long as usual",
        "write in each cycle; without waiting for other connections, files or the garbage collection",
        float((paused**2).sum()) / 2 / float(cycles.sum()),
        pauses=float(len(paused)),
        longest_ms=longest_ms,
    )


def competing_clients(evidence: Evidence) -> Finding | None:
    """Writes that are refused because another client writes the same.

    No torque of the refused client acts, whatever its age. The cause explains the part of the run in which this occurs,
    in whole seconds.
    """
    refused = total = clients = competing_s = written_s = 0
    for window in evidence.windows:
        writes = window.traffic[np.isin(window.traffic["function"], _WRITES)]
        busy = writes[writes["exception"] == SERVER_BUSY]
        refused += len(busy)
        total += len(writes)
        competing_s += len(np.unique(busy["arrived_ns"] // 1_000_000_000))
        written_s += len(np.unique(writes["arrived_ns"] // 1_000_000_000))
        clients = max(clients, len(np.unique(busy["controller"])))
    if refused < MIN_REFUSED_WRITES:
        return None
    share = competing_s / written_s
    values = {"share": share, "refused": float(refused), "refused_share": refused / total, "clients": float(clients)}
    text = f"clients compete for the rig: {refused} writes ({refused / total:.0%}) were refused, because another wrote"
    return Finding("timing", "competing_clients", text, "let one program write to the rig", None, values)


RULES: Final[tuple[Rule, ...]] = (
    open_loop,
    previous_poll,
    delayed_acknowledgement,
    wait_before_write,
    slow_polling,
    computing_time,
    network,
    retransmissions,
    edge_stall,
    simulation_stall,
    cpu_steal,
    injected_delay,
    beating,
    watchdog_gaps,
    controller_pauses,
    competing_clients,
)
OF_A_POLLING_PROGRAM: Final[frozenset[Rule]] = frozenset(
    {
        previous_poll,
        delayed_acknowledgement,
        wait_before_write,
        slow_polling,
        computing_time,
        beating,
        controller_pauses,
    }
)
"""Rules about a program that polls the rig; in the client role the edge itself polls."""
RARE: Final = frozenset(
    {"retransmissions", "edge_stall", "simulation_stall", "cpu_steal", "watchdog_gaps", "competing_clients"}
)
SUPPRESSED: Final = {
    "open_loop": frozenset(rule.__name__ for rule in RULES[1:]),
    "delayed_acknowledgement": frozenset({"wait_before_write", "slow_polling", "computing_time", "network", "beating"}),
    "wait_before_write": frozenset({"slow_polling", "computing_time", "beating"}),
    "computing_time": frozenset({"beating"}),
    "slow_polling": frozenset({"beating"}),
    "network": frozenset({"beating"}),
    **dict.fromkeys(
        ("edge_stall", "simulation_stall", "cpu_steal", "retransmissions"),
        frozenset({"watchdog_gaps", "controller_pauses"}),
    ),
    "watchdog_gaps": frozenset({"controller_pauses"}),
    "competing_clients": frozenset({"controller_pauses"}),
}
"""By cause: the generic causes that it explains."""


def is_relevant(finding: Finding) -> bool:
    """Whether a cause explains enough of the age to be reported."""
    return finding.evidence["share"] >= (MIN_RARE_SHARE if finding.code in RARE else MIN_SHARE)


def _per_time(evidence: Evidence, area_ns2: float) -> float:
    return area_ns2 / (evidence.duration_s * 1e9) if evidence.duration_s > 0 else 0.0


def _median(values: Floats) -> float:
    return float(np.median(values)) if len(values) else 0.0


def _times(count: int) -> str:
    return "once" if count == 1 else f"{count} times"
