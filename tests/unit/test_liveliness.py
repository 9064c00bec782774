"""Lost peers are reported after a grace time, and their return too."""

from hilrig_runtime.process.liveliness import MAX_PEERS, PEER_DOWN_GRACE_NS, PeerDownTracker


def test_lost_peer_is_reported_once() -> None:
    tracker = PeerDownTracker()
    assert tracker.due_ns is None
    tracker.mark_down("sim/1", 1_000)
    assert tracker.due_ns == 1_000 + PEER_DOWN_GRACE_NS
    assert tracker.overdue(999 + PEER_DOWN_GRACE_NS) == []
    assert tracker.overdue(1_000 + PEER_DOWN_GRACE_NS) == ["sim/1"]
    assert tracker.overdue(9_000 + PEER_DOWN_GRACE_NS) == []
    assert tracker.due_ns is None


def test_short_outage_is_not_reported() -> None:
    tracker = PeerDownTracker()
    tracker.mark_down("sim/1", 0)
    assert not tracker.mark_up("sim/1")
    assert tracker.overdue(10 * PEER_DOWN_GRACE_NS) == []


def test_return_of_reported_peer_is_reported() -> None:
    tracker = PeerDownTracker()
    tracker.mark_down("sim/1", 0)
    tracker.overdue(PEER_DOWN_GRACE_NS)
    assert tracker.mark_up("sim/1")
    assert not tracker.mark_up("sim/1")


def test_peers_lost_together_are_reported_together() -> None:
    tracker = PeerDownTracker()
    tracker.mark_down("sim/1", 5)
    tracker.mark_down("recorder/1", 0)
    tracker.mark_down("recorder/1", 3)
    assert tracker.due_ns == PEER_DOWN_GRACE_NS
    assert tracker.overdue(PEER_DOWN_GRACE_NS + 5) == ["recorder/1", "sim/1"]


def test_tracked_peers_are_bounded() -> None:
    tracker = PeerDownTracker()
    for number in range(2 * MAX_PEERS):
        tracker.mark_down(f"sim/{number}", number)
        tracker.overdue(PEER_DOWN_GRACE_NS + number // 2)
    assert len(tracker._down_since_ns) + len(tracker._reported) == MAX_PEERS
