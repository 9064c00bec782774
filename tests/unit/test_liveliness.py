"""Who is gone is told once it lasts, and once that he is back."""

from hilrig_runtime.process.liveliness import PEER_DOWN_GRACE_NS, PeerDownTracker


def test_who_is_gone_for_long_is_told_once() -> None:
    tracker = PeerDownTracker()
    assert tracker.due_ns is None
    tracker.mark_down("sim/1", 1_000)
    assert tracker.due_ns == 1_000 + PEER_DOWN_GRACE_NS
    assert tracker.overdue(999 + PEER_DOWN_GRACE_NS) == []
    assert tracker.overdue(1_000 + PEER_DOWN_GRACE_NS) == ["sim/1"]
    assert tracker.overdue(9_000 + PEER_DOWN_GRACE_NS) == []
    assert tracker.due_ns is None


def test_who_comes_back_soon_is_not_told_at_all() -> None:
    tracker = PeerDownTracker()
    tracker.mark_down("sim/1", 0)
    assert not tracker.mark_up("sim/1")
    assert tracker.overdue(10 * PEER_DOWN_GRACE_NS) == []


def test_who_comes_back_after_he_was_told_is_told_again() -> None:
    tracker = PeerDownTracker()
    tracker.mark_down("sim/1", 0)
    tracker.overdue(PEER_DOWN_GRACE_NS)
    assert tracker.mark_up("sim/1")
    assert not tracker.mark_up("sim/1")


def test_those_who_go_together_are_told_together() -> None:
    tracker = PeerDownTracker()
    tracker.mark_down("sim/1", 5)
    tracker.mark_down("recorder/1", 0)
    tracker.mark_down("recorder/1", 3)
    assert tracker.due_ns == PEER_DOWN_GRACE_NS
    assert tracker.overdue(PEER_DOWN_GRACE_NS + 5) == ["recorder/1", "sim/1"]
