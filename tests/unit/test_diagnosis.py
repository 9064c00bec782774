"""Diagnosis: each rule finds its cause in a recording, and finds nothing without the cause."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hilrig_replay.analysis.age import LoopAge
from hilrig_replay.analysis.data_quality import Stalls
from hilrig_replay.analysis.diagnosis import control_observations, timing_causes
from hilrig_replay.analysis.diagnosis.diagnose import MAX_FINDINGS, diagnose
from hilrig_replay.analysis.diagnosis.evidence import Evidence, Finding, sections
from hilrig_replay.analysis.distribution import Statistics
from hilrig_replay.analysis.feedback import rounding_gains
from hilrig_replay.analysis.latency import measure
from hilrig_replay.analysis.samples import SAMPLE_DTYPE
from hilrig_replay.io.columns import COMMAND_DTYPE, CONNECTION_DTYPE, PART_DTYPE, STATE_DTYPE, TRAFFIC_DTYPE, Rows
from hilrig_replay.io.disk_table import DiskTable
from hilrig_replay.io.records import EVENT_DTYPE, Records
from hilrig_replay.io.run import open_run
from hilrig_runtime.config.task import PoseConfig
from hilrig_schemas import JointState, TorqueCommand
from support.recordings import Script, make, record, write
from support.virtual_loop import Program, virtual_runs

MS = 1_000_000
DATA = Path(__file__).parents[1] / "data"


def findings(folder: Path, script: Script) -> dict[str, Finding]:
    report = measure(open_run(record(folder / "run.mcap", script)))
    return {finding.code: finding for finding in report.findings if finding.list == "timing"}


def test_fast_controller_has_no_findings(tmp_path: Path) -> None:
    report = measure(open_run(record(tmp_path / "run.mcap", Script(seconds=12.0, poll_ms=5.0))))
    assert report.findings == ()
    assert sections(report.findings) == [("Timing causes", ["no cause found"]), ("Control observations", ["none"])]


def test_finds_a_simulation_stall(tmp_path: Path) -> None:
    found = findings(tmp_path, Script(seconds=8.0, stalls={200: 130.0}))["simulation_stall"]
    assert found.evidence["stalls"] == 1
    assert found.evidence["longest_ms"] == pytest.approx(130, abs=1)
    assert found.evidence["at_s"] == pytest.approx(4.1, abs=0.05)
    # The age grows to 130 ms once in 8 s.
    assert found.gain_ms == pytest.approx(130**2 / 2 / 8000, rel=0.05)


def test_finds_an_edge_stall(tmp_path: Path) -> None:
    found = findings(tmp_path, Script(seconds=8.0, edge_stalls={3.0: 90.0}))["edge_stall"]
    assert found.evidence["longest_ms"] == pytest.approx(90, abs=6)
    assert found.evidence["at_s"] == pytest.approx(3.0, abs=0.1)


def test_finds_an_injected_delay(tmp_path: Path) -> None:
    found = findings(tmp_path, Script(seconds=8.0, injected_state_ms=12.0, injected_command_ms=18.0))["injected_delay"]
    assert found.evidence["mean_ms"] == pytest.approx(30.0)


@pytest.mark.parametrize("poll_ms", [33.0, 40.5, 100.0])
def test_finds_polling_slower_than_the_step(tmp_path: Path, poll_ms: float) -> None:
    found = findings(tmp_path, Script(seconds=8.0, poll_ms=poll_ms))
    assert set(found) == {"slow_polling"}
    assert found["slow_polling"].evidence["cycle_ms"] == pytest.approx(poll_ms, abs=0.5)
    assert found["slow_polling"].gain_ms == pytest.approx((poll_ms - 20) / 2, abs=1)


def test_constant_time_before_the_write_is_a_wait(tmp_path: Path) -> None:
    found = findings(tmp_path, Script(seconds=8.0, poll_ms=0, delay_ms=60.0))
    assert set(found) == {"wait_before_write"}
    assert found["wait_before_write"].evidence["wait_ms"] == 60.0


def test_time_before_a_wait_is_of_computing(tmp_path: Path) -> None:
    found = findings(tmp_path, Script(seconds=8.0, poll_ms=70.0, delay_ms=50.0))
    assert list(found) == ["computing_time", "slow_polling"]
    assert found["computing_time"].evidence["computing_ms"] == pytest.approx(50.8, abs=1)


def test_controller_with_a_small_share_is_no_cause(tmp_path: Path) -> None:
    assert findings(tmp_path, Script(seconds=8.0, delay_ms=6.0)) == {}


def test_finds_a_controller_that_reads_after_writing(tmp_path: Path) -> None:
    found = findings(tmp_path, Script(seconds=12.0, poll_ms=100.0, order="write-read"))
    assert set(found) == {"wait_before_write"}
    assert found["wait_before_write"].evidence["wait_ms"] == pytest.approx(99, abs=1)


@pytest.mark.parametrize("poll_ms", [19.6, 20.3])
def test_finds_a_cycle_that_beats_with_the_step(tmp_path: Path, poll_ms: float) -> None:
    script = Script(seconds=12.0, poll_ms=poll_ms, delay_ms=1.0)
    found = findings(tmp_path, script)["beating"]
    expected_s = 0.02 / abs(poll_ms - 20.0) * poll_ms
    assert found.evidence["period_s"] == pytest.approx(expected_s, rel=0.1)


@pytest.mark.parametrize("poll_ms", [5.0, 10.0, 33.0])
def test_other_cycles_do_not_beat(tmp_path: Path, poll_ms: float) -> None:
    assert "beating" not in findings(tmp_path, Script(seconds=12.0, poll_ms=poll_ms))


@pytest.mark.parametrize("wait_ms", [40.5, 204.0])
def test_finds_delayed_acknowledgments(tmp_path: Path, wait_ms: float) -> None:
    script = Script(seconds=12.0, poll_ms=0, delay_ms=wait_ms, delayed_ack_ms=wait_ms)
    found = findings(tmp_path, script)
    assert set(found) == {"delayed_acknowledgement"}
    assert found["delayed_acknowledgement"].evidence["wait_ms"] == pytest.approx(wait_ms, abs=2)
    assert "TCP_NODELAY" in found["delayed_acknowledgement"].remedy


@pytest.mark.parametrize("poll_ms", [20.0, 40.0, 100.0])
def test_finds_torques_based_on_the_previous_poll(tmp_path: Path, poll_ms: float) -> None:
    found = findings(tmp_path, Script(seconds=20.0, poll_ms=poll_ms, law="feedback", feedback_delay_polls=1))
    assert found["previous_poll"].evidence["added_ms"] == pytest.approx(poll_ms, rel=0.05)
    assert f"add one period of {poll_ms:.0f} ms" in found["previous_poll"].text


def test_finds_torques_two_polls_behind(tmp_path: Path) -> None:
    found = findings(tmp_path, Script(seconds=20.0, poll_ms=20.0, law="feedback", feedback_delay_polls=2))
    assert found["previous_poll"].gain_ms == pytest.approx(40, rel=0.05)


@pytest.mark.parametrize("poll_ms", [5.0, 20.0, 40.0, 100.0])
def test_torques_based_on_the_newest_poll_are_not_found(tmp_path: Path, poll_ms: float) -> None:
    assert "previous_poll" not in findings(tmp_path, Script(seconds=20.0, poll_ms=poll_ms, law="feedback"))


@pytest.mark.parametrize("basis_step", [0, 1, 5], ids=["never reads", "unknown step", "reads once"])
def test_accepts_commands_without_a_known_basis(tmp_path: Path, basis_step: int) -> None:
    script = Script(seconds=30.0, poll_ms=20.0, law="feedback")
    made = make(script)
    for item in made:
        message = item.message
        if isinstance(message, TorqueCommand) or (isinstance(message, JointState) and message.basis_step):
            message.basis_step = basis_step
    report = measure(open_run(write(tmp_path / "run.mcap", made, script=script)))
    codes = [finding.code for finding in report.findings if finding.list == "timing"]
    assert codes == (["open_loop"] if basis_step else [])


def test_recorded_limit_cycle_is_saturated_and_oscillates() -> None:
    report = measure(open_run(DATA / "limit-cycle.mcap"))
    observed = {one.code: one for one in report.findings if one.list == "control"}
    saturated, cycle = observed["saturation"], observed["limit_cycle"]
    assert saturated.text.startswith("joint 1 is saturated at ±32 N·m for 6")
    assert saturated.evidence["saturated_share"] > 0.5
    assert cycle.evidence["frequency_hz"] == pytest.approx(1.1, abs=0.2)
    assert cycle.evidence["amplitude"] == pytest.approx(65, abs=15)


def test_recorded_open_loop_has_one_timing_cause() -> None:
    report = measure(open_run(DATA / "read-once-then-write.mcap"))
    [cause] = [one for one in report.findings if one.list == "timing"]
    assert cause.code == "open_loop"
    assert "1183 commands are based on 1 state" in cause.text


def lossy(count: int, rtt_us: int) -> Evidence:
    """Cycles of 20 ms with two pauses of 300 ms; `count` retransmissions are recorded at the first pause."""
    commands = np.zeros(200, COMMAND_DTYPE)
    at_ns = np.arange(200) * 20 * MS + np.where(np.arange(200) >= 50, 300 * MS, 0)
    commands["wall_ns"] = commands["write_arrived_ns"] = commands["write_received_ns"] = at_ns + 1_000 * MS
    commands["state_served_ns"] = commands["write_arrived_ns"] - 1 * MS
    commands["basis_step"], commands["session"] = np.arange(1, 201), 1
    tcp = np.zeros(4, CONNECTION_DTYPE)
    tcp["wall_ns"], tcp["min_rtt_us"] = (np.arange(4) + 1) * 1_000 * MS, rtt_us
    tcp["retransmissions"] = (0, count, count, count)
    window = replace(EMPTY, commands=commands, connections=tcp)
    return replace(evidence([window]), min_rtt_ns=rtt_us * 1e3)


def test_finds_retransmissions_with_pauses() -> None:
    found = timing_causes.retransmissions(lossy(3, 200))
    assert found is not None
    assert (found.evidence["retransmissions"], found.evidence["longest_ms"]) == (3, 320)
    assert timing_causes.retransmissions(lossy(0, 200)) is None


def test_pauses_far_from_a_retransmission_are_not_of_the_network() -> None:
    apart = lossy(3, 200)
    apart.windows[0].connections["wall_ns"] += 4_000 * MS
    assert timing_causes.retransmissions(apart) is None


def test_smallest_round_trip_time_is_the_network() -> None:
    samples = rows_of_samples(held_ms=41.0)
    far = replace(evidence([], samples), min_rtt_ns=39.0 * MS, age=AGE, bases=300)
    found = {one.code: one for one in diagnose(far)}
    assert found["network"].evidence["min_rtt_ms"] == 39
    # Without it, each command acts two steps earlier; the 2 ms that remain are no computing time.
    assert found["network"].gain_ms == 40
    assert set(found) == {"network"}
    assert "network" not in {one.code for one in diagnose(replace(far, min_rtt_ns=0.0))}


AGE = LoopAge(Statistics(60.0, 60.0, 60.0, 60.0, 60.0, 60.0, 0.0), 20.0, 60.0, 0.0, {})


def rows_of_samples(held_ms: float) -> Rows:
    """Samples with a loop of 60 ms and a time between reading and writing."""
    samples = np.zeros(300, SAMPLE_DTYPE)
    samples["loop"], samples["controller"], samples["tick_wait"] = 60 * MS, held_ms * MS, 2 * MS
    return samples


def test_refused_writes_are_of_competing_clients() -> None:
    traffic = np.zeros(100, TRAFFIC_DTYPE)
    traffic["function"], traffic["controller"] = 16, np.arange(100) % 2
    traffic["exception"][1:20:2] = 6
    found = timing_causes.competing_clients(evidence([replace(EMPTY, traffic=traffic)]))
    assert found is not None
    assert (found.evidence["refused"], found.evidence["refused_share"], found.evidence["clients"]) == (10, 0.1, 1)
    assert found.evidence["share"] == 1
    traffic["arrived_ns"] = np.arange(100) * 100 * MS
    found = timing_causes.competing_clients(evidence([replace(EMPTY, traffic=traffic)]))
    assert found is not None
    assert found.evidence["share"] == 0.2
    traffic["exception"] = np.where(np.arange(100) < 4, 6, 2)
    assert timing_causes.competing_clients(evidence([replace(EMPTY, traffic=traffic)])) is None


def test_refused_client_precedes_the_age_of_the_other() -> None:
    traffic = np.zeros(500, TRAFFIC_DTYPE)
    traffic["function"], traffic["arrived_ns"] = 16, np.arange(500) * 10 * MS
    traffic["exception"][:400:2] = 6
    stalled = replace(evidence([replace(EMPTY, traffic=traffic)], rows_of_samples(1.0)), age=AGE, bases=300)
    stalled = replace(stalled, stalls=Stalls(10, 300 * MS, area_ns2=10 * (300.0 * MS) ** 2 / 2))
    shares = [(one.code, one.evidence["share"]) for one in diagnose(stalled)]
    assert shares == [("competing_clients", 0.8), ("simulation_stall", 0.75)]


def test_share_includes_the_age_that_timestamps_hide() -> None:
    # Each command misses a tick because of its phase, and acts on the previous poll: 20 ms of 60 ms each.
    def law(t: float, q: np.ndarray) -> np.ndarray:
        return np.asarray(0.2 * (np.array([40, 30, 20, 10]) * np.sin(t) - q) * (1, 0.6, 0.1, 0.02))

    [run] = virtual_runs([Program(law, phase_ms=19.5, behind=1)])
    found = {one.code: one for one in measure(run).findings if one.list == "timing"}
    assert list(found) == ["previous_poll", "beating"]
    assert [one.evidence["share"] for one in found.values()] == pytest.approx([20 / 60] * 2, rel=0.05)


@pytest.mark.parametrize("kind", ["edge", "simulation"])
def test_stall_without_a_processor_is_cpu_steal(kind: str) -> None:
    stalls = {3.0: 200.0, 5.0: 220.0}
    of_edge, of_simulation = (stalls, {}) if kind == "edge" else ({}, stalls)

    def found(starved_share: float) -> dict[str, Finding]:
        program = Program(
            lambda _, q: -0.1 * q,
            seconds=8.0,
            starved_share=starved_share,
            stalls=of_simulation,
            edge_stalls=of_edge,
        )
        [run] = virtual_runs([program])
        return {one.code: one for one in measure(run).findings if one.list == "timing"}

    steal = found(0.8)
    assert set(steal) == {"cpu_steal"}
    assert steal["cpu_steal"].evidence["run_delay_ms"] == pytest.approx(0.8 * 220, abs=1)
    assert steal["cpu_steal"].evidence["at_s"] == pytest.approx(5.0, abs=0.3)
    assert set(found(0.3)) == {f"{kind}_stall"}


def cycles_of(held_ns: np.ndarray, cycle_ns: np.ndarray) -> Records:
    """Commands that answer reads after a time, in cycles of a length, (n,) each."""
    commands = np.zeros(len(held_ns), COMMAND_DTYPE)
    commands["write_received_ns"] = commands["write_arrived_ns"] = 1_000 * MS + np.cumsum(cycle_ns)
    commands["state_served_ns"] = commands["write_arrived_ns"] - held_ns
    commands["basis_step"], commands["session"] = np.arange(1, len(held_ns) + 1), 1
    return replace(EMPTY, commands=commands)


def test_pauses_of_a_controller_are_found_unless_explained() -> None:
    cycle_ns = np.where(np.arange(400) % 40 == 39, 300, 20) * MS
    paused = replace(evidence([cycles_of(np.full(400, MS), cycle_ns)], rows_of_samples(1.0)), age=AGE, bases=300)
    [found] = [one for one in diagnose(paused) if one.list == "timing"]
    assert found.code == "controller_pauses"
    assert (found.evidence["pauses"], found.evidence["longest_ms"]) == (10, 300)
    assert found.gain_ms == pytest.approx(300**2 / 2 / (39 * 20 + 300), rel=0.02)
    stalled = replace(paused, edge_stalls=Stalls(10, 300 * MS, area_ns2=10 * (300.0 * MS) ** 2 / 2))
    assert {one.code for one in diagnose(stalled) if one.list == "timing"} == {"edge_stall"}
    regular = [cycles_of(np.full(400, MS), np.full(400, 20 * MS))]
    assert diagnose(replace(paused, windows=regular)) == ()


@pytest.mark.parametrize(("rtt_ms", "code"), [(0.1, "delayed_acknowledgement"), (43.0, "network")])
def test_network_of_the_acknowledgment_time_is_a_network(rtt_ms: float, code: str) -> None:
    cycles = [cycles_of(np.full(100, 43.5 * MS), np.full(100, 87 * MS))]
    far = replace(evidence(cycles, rows_of_samples(43.5)), age=AGE, bases=300, min_rtt_ns=rtt_ms * MS)
    assert [one.code for one in diagnose(far) if one.list == "timing"] == [code]


def test_drifting_phase_of_two_connections_is_a_wait() -> None:
    samples, held_ns = rows_of_samples(19.0), (4 + np.arange(400) % 18) * MS
    drifting = replace(evidence([cycles_of(held_ns, np.full(400, 21 * MS))], samples), age=AGE, bases=300)
    two = replace(drifting, other_connection=True)
    assert [one.code for one in diagnose(two) if one.list == "timing"] == ["wait_before_write"]
    assert [one.code for one in diagnose(drifting) if one.list == "timing"] == ["computing_time"]


@pytest.mark.parametrize(("deadlines", "code"), [(True, "wait_before_write"), (False, "computing_time")])
def test_hold_of_a_timer_may_vary_more_than_a_sleep(deadlines: bool, code: str) -> None:
    late_ns = np.random.default_rng(1).normal(1.0, 1.0, 400) * MS
    cycle_ns = 22 * MS + (np.diff(late_ns, prepend=MS) if deadlines else late_ns)
    varying = replace(evidence([cycles_of(cycle_ns - 0.3 * MS, cycle_ns)], rows_of_samples(22.0)), age=AGE, bases=300)
    assert [one.code for one in diagnose(varying) if one.list == "timing"] == [code]


@pytest.mark.parametrize(("sleeps", "code"), [(True, "wait_before_write"), (False, "computing_time")])
def test_sleep_on_a_busy_host_is_a_wait(sleeps: bool, code: str) -> None:
    random = np.random.default_rng(2)
    # Half of the sleeps are late, by up to 20 ms; a computation of the same time varies to both sides.
    late_ms = 0.1 + random.gamma(1.0, 0.05, 400) + random.choice((0.0, 1.0), 400) * random.exponential(4.0, 400)
    held_ns = (30.0 + (late_ms if sleeps else random.normal(1.0, 1.5, 400))) * MS
    assert np.subtract(*np.percentile(held_ns, (75, 25))) > 0.06 * 30 * MS
    busy = replace(evidence([cycles_of(held_ns, held_ns + 0.3 * MS)], rows_of_samples(32.0)), age=AGE, bases=300)
    [found] = [one for one in diagnose(busy) if one.list == "timing"]
    assert found.code == code
    assert not sleeps or found.evidence["wait_ms"] == 30


@pytest.mark.parametrize(("decay_s", "found"), [(1.6, False), (60.0, True)])
def test_oscillation_that_decays_is_no_limit_cycle(decay_s: float, found: bool) -> None:
    time_s = np.arange(1000) * 0.02
    since_s = time_s % 2.0
    states = np.zeros(1000, STATE_DTYPE)
    states["step"], states["session"], states["command_seq"] = np.arange(1000), 1, np.arange(1, 1001)
    states["effort"][:, 0] = 1.0
    angle = np.exp(-since_s / decay_s) * np.cos(2 * np.pi * 1.5 * since_s)
    states["position"][:, 0] = 0.3 * angle
    states["velocity"][:, 0] = np.gradient(0.3 * angle, 0.02)
    observed = control_observations.limit_cycle(evidence([replace(EMPTY, states=states)]), [])
    assert [one.code for one in observed] == ["limit_cycle"] * found


@pytest.mark.parametrize("on_stop", [True, False])
def test_rests_on_the_stops_are_of_an_oscillation(on_stop: bool) -> None:
    time_s = np.arange(1000) * 0.02
    states = np.zeros(1000, STATE_DTYPE)
    states["step"], states["session"], states["command_seq"] = np.arange(1000), 1, np.arange(1, 1001)
    states["effort"][:, 3] = 1.0
    states["position"][:, 3] = np.clip(1.2 * np.sin(2 * np.pi * 1.5 * time_s), -1.0, 1.0)
    states["velocity"][:, 3] = np.gradient(states["position"][:, 3], 0.02)
    if on_stop:
        states["limit_flags"] = 8 * (states["position"][:, 3] <= -1.0) + 128 * (states["position"][:, 3] >= 1.0)
    observed = control_observations.limit_cycle(evidence([replace(EMPTY, states=states)]), [])
    assert [one.code for one in observed] == ["limit_cycle"] * on_stop


def test_writes_after_the_first_one_are_no_wait() -> None:
    commands = np.zeros(400, COMMAND_DTYPE)
    # A read every 100 ms, and a write 1 ms later and again every 20 ms.
    number = np.arange(400)
    commands["state_served_ns"] = 1_000 * MS + number // 5 * 100 * MS
    commands["write_arrived_ns"] = commands["state_served_ns"] + 1 * MS + number % 5 * 20 * MS
    commands["write_received_ns"] = commands["write_arrived_ns"]
    commands["basis_step"], commands["session"] = number // 5 * 5 + 1, 1
    samples = rows_of_samples(0.0)
    samples["controller"] = (1 + np.arange(300) % 5 * 20) * MS
    repeated = replace(evidence([replace(EMPTY, commands=commands)], samples), age=AGE, bases=60)
    [found] = [one for one in diagnose(repeated) if one.list == "timing"]
    assert found.code == "slow_polling"
    assert found.text.startswith("the program polls every 100 ms, and writes again without reading;")
    # A few writes without a read, such as the last one, are no repetition.
    [found] = [one for one in diagnose(replace(repeated, bases=295)) if one.code == "slow_polling"]
    assert "writes again" not in found.text
    # One write a register is one answer.
    commands["write_arrived_ns"] = commands["state_served_ns"] + (1 + number % 5) * MS
    cycles = replace(repeated, windows=[replace(EMPTY, commands=commands)]).cycles()
    assert np.median(cycles["pause_ns"]) == 95 * MS


EMPTY = Records(
    np.empty(0, STATE_DTYPE),
    np.empty(0, COMMAND_DTYPE),
    np.empty(0, EVENT_DTYPE),
    np.empty(0, TRAFFIC_DTYPE),
    np.empty(0, PART_DTYPE),
    np.empty(0, CONNECTION_DTYPE),
)


def evidence(windows: list[Records], samples: Rows | None = None) -> Evidence:
    table = DiskTable(SAMPLE_DTYPE)
    table.add(np.empty(0, SAMPLE_DTYPE) if samples is None else samples)
    gains = rounding_gains((window.states, window.commands) for window in windows)
    return Evidence(20 * MS, table, windows, 10.0, gains=gains)


SIZES = st.sampled_from((0, 1, 2, 3, 17, 40, 300))
SCALES: dict[str, Callable[[np.random.Generator, int], np.ndarray]] = {
    "regular": lambda random, size: np.arange(size) * 20 * MS + random.integers(0, MS, size),
    "equal": lambda random, size: np.full(size, random.integers(0, 1 << 40)),
    "any order": lambda random, size: random.integers(-(1 << 50), 1 << 50, size),
    "small": lambda random, size: random.integers(0, 3, size),
}


def rows(dtype: np.dtype, size: int, random: np.random.Generator, scale: str) -> Rows:
    """Rows with random values of a kind in each field."""
    made = np.zeros(size, dtype)
    for name in dtype.names or ():
        values = SCALES[scale](random, size)
        field = dtype[name].base
        if field == np.float64:
            shape = made[name].shape
            made[name] = random.choice((0.0, 1.0, 32.767)) * random.normal(size=shape) + random.choice((0.0, 5.0))
        elif field == np.bool_:
            made[name] = random.random(size) < random.choice((0.0, 0.5, 1.0))
        else:
            made[name] = values.astype(field) if field.kind == "i" else np.abs(values).astype(field)
    return made


@given(
    sizes=st.tuples(SIZES, SIZES, SIZES, SIZES),
    count=st.integers(0, 2),
    samples=SIZES,
    seed=st.integers(0, 2**32),
    scale=st.sampled_from(sorted(SCALES)),
)
@settings(max_examples=120)
def test_each_rule_is_a_total_function_of_rows(
    sizes: tuple[int, ...], count: int, samples: int, seed: int, scale: str
) -> None:
    random = np.random.default_rng(seed)
    dtypes = (STATE_DTYPE, COMMAND_DTYPE, TRAFFIC_DTYPE, CONNECTION_DTYPE)
    windows = []
    for _ in range(count):
        states, commands, traffic, connections = (
            rows(dtype, size, random, scale) for dtype, size in zip(dtypes, sizes, strict=True)
        )
        windows.append(replace(EMPTY, states=states, commands=commands, traffic=traffic, connections=connections))
    poses = (PoseConfig(name="p", position_mm=(300.0, 0.0, 50.0)),)
    given_rows = replace(evidence(windows, rows(SAMPLE_DTYPE, samples, random, scale)), poses=poses, watchdog_gaps=1)
    found = [finding for rule in timing_causes.RULES if (finding := rule(given_rows)) is not None]
    for observe in control_observations.OBSERVATIONS:
        found += observe(given_rows, found)
    for finding in found:
        assert finding.sentence()
        assert np.isfinite([*finding.evidence.values(), finding.gain_ms or 0.0]).all(), finding
        assert finding.list == "control" or 0.0 <= finding.evidence["share"] <= 1.0, finding
    chosen = diagnose(given_rows)
    for name in ("timing", "control"):
        assert sum(finding.list == name for finding in chosen) <= MAX_FINDINGS


def test_names_and_suppressions_are_rules() -> None:
    names = {rule.__name__ for rule in timing_causes.RULES}
    assert set(timing_causes.SUPPRESSED) <= names
    assert frozenset().union(*timing_causes.SUPPRESSED.values()) <= names
    assert names >= timing_causes.RARE
