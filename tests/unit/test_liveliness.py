"""Who is gone is told once it lasts, and once that he is back."""

from hilrig_runtime.process.liveliness import LASTS_NS, Absences


def test_who_is_gone_for_long_is_told_once() -> None:
    absences = Absences()
    assert absences.due_ns is None
    absences.went("sim/1", 1_000)
    assert absences.due_ns == 1_000 + LASTS_NS
    assert absences.lasting(999 + LASTS_NS) == []
    assert absences.lasting(1_000 + LASTS_NS) == ["sim/1"]
    assert absences.lasting(9_000 + LASTS_NS) == []
    assert absences.due_ns is None


def test_who_comes_back_soon_is_not_told_at_all() -> None:
    absences = Absences()
    absences.went("sim/1", 0)
    assert not absences.came("sim/1")
    assert absences.lasting(10 * LASTS_NS) == []


def test_who_comes_back_after_he_was_told_is_told_again() -> None:
    absences = Absences()
    absences.went("sim/1", 0)
    absences.lasting(LASTS_NS)
    assert absences.came("sim/1")
    assert not absences.came("sim/1")


def test_those_who_go_together_are_told_together() -> None:
    absences = Absences()
    absences.went("sim/1", 5)
    absences.went("recorder/1", 0)
    absences.went("recorder/1", 3)
    assert absences.due_ns == LASTS_NS
    assert absences.lasting(LASTS_NS + 5) == ["recorder/1", "sim/1"]
