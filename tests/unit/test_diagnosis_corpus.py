"""Error rate of the diagnosis on runs with a known cause; with HILRIG_LONG set, of the complete corpus."""

from itertools import product

import pytest

from diagnosis_corpus import PARTS, RUNS, UNDISTURBED, case_of, corpus, diagnosed, table


def test_judged_laws_and_ranges_were_not_tuned_on() -> None:
    judged = PARTS["judged"]
    for other in (part for name, part in PARTS.items() if name != "judged"):
        assert not set(other.laws) & set(judged.laws)
        assert not set(other.goals) & set(judged.goals)
        assert other.ranges.keys() == judged.ranges.keys()
        for name in judged.ranges:
            for (low, high), (other_low, other_high) in product(judged.intervals(name), other.intervals(name)):
                assert high < other_low or other_high < low, name


def test_a_sample_of_forty_runs_is_diagnosed() -> None:
    # Two runs of each cause, and two undisturbed ones.
    cases = corpus("judged", 2)[4:]
    assert len(cases) == 40
    for case in cases:
        if case.code in ("open_loop", "joint_on_stop", "limit_cycle"):
            # Stops are slow to simulate, also for the other runs of the same duration.
            case.program.seconds = 8.0
        elif case.program.seconds > 20.0:
            case.program.seconds = 30.0
    results = list(diagnosed(cases))
    missed = [(one.case.code, one.timing, one.control) for one in results if not one.found or one.wrong]
    assert len(missed) <= 1, missed


def test_noise_that_drives_a_torque_to_its_limits_is_found() -> None:
    # The torque is at a limit on more than half of the steps.
    case = case_of("noise_amplification", "revision4", 3)
    case.program.seconds = 5.0
    [result] = diagnosed([case])
    assert result.control == ["saturation", "noise_amplification"]


@pytest.mark.long("takes minutes")
@pytest.mark.timeout(900)
def test_error_rate_of_the_complete_corpus() -> None:
    results = list(diagnosed(corpus("judged", RUNS), by_cause=True))
    print(table(results))
    disturbed = [one for one in results if one.case.code != UNDISTURBED]
    undisturbed = [one for one in results if one.case.code == UNDISTURBED]
    assert sum(one.wrong for one in disturbed) <= 0.02 * len(disturbed)
    assert sum(one.found for one in undisturbed) >= 0.98 * len(undisturbed)
    assert sum(one.found for one in disturbed) >= 0.9 * len(disturbed)
    for code in {one.case.code for one in disturbed}:
        ours = [one for one in disturbed if one.case.code == code]
        assert sum(one.found for one in ours) >= 0.9 * len(ours), code
