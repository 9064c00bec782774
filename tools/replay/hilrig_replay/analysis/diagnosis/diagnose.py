"""Selects the findings of a run: relevant, not explained by another one, and at most three of each list."""

from typing import Final

from hilrig_replay.analysis.diagnosis.control_observations import OBSERVATIONS
from hilrig_replay.analysis.diagnosis.evidence import Evidence, Finding
from hilrig_replay.analysis.diagnosis.timing_causes import OF_A_POLLING_PROGRAM, RULES, SUPPRESSED, is_relevant

MAX_FINDINGS: Final = 3
"""Largest number of findings in each list."""


def diagnose(evidence: Evidence) -> tuple[Finding, ...]:
    """Timing causes, those that explain most of the age first, then control observations; empty: no cause was found."""
    rules = [rule for rule in RULES if not (evidence.client_role and rule in OF_A_POLLING_PROGRAM)]
    causes = [finding for rule in rules if (finding := rule(evidence)) is not None and is_relevant(finding)]
    explained = frozenset[str]().union(*(SUPPRESSED.get(cause.code, frozenset()) for cause in causes))
    causes = [cause for cause in causes if cause.code not in explained]
    # Of causes that explain the same, the one of the earlier, more specific rule.
    causes.sort(key=lambda cause: -round(cause.evidence["share"], 2))
    observations: list[Finding] = []
    for observe in OBSERVATIONS:
        observations += observe(evidence, observations)
    return (*causes[:MAX_FINDINGS], *observations[:MAX_FINDINGS])
