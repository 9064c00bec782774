"""Pending connections: beyond a limit an old one is closed, never the newest one of a host with few."""

from hilrig_runtime.pending_connections import PendingConnections


def test_oldest_one_of_a_crowded_host_is_closed() -> None:
    pending: PendingConnections[int] = PendingConnections(10, 2)
    assert [pending.add(number, "east") for number in range(4)] == [None, None, 0, 1]
    assert pending.add(9, "west") is None
    assert list(pending) == [2, 3, 9]


def test_total_is_limited_at_the_host_with_the_most() -> None:
    pending: PendingConnections[int] = PendingConnections(4, 3)
    assert pending.add(0, "owner") is None
    for number in (1, 2, 3):
        assert pending.add(number, "attacker") is None
    assert pending.add(4, "other") == 1
    assert list(pending) == [0, 2, 3, 4]


def test_oldest_one_is_closed_if_every_host_has_one() -> None:
    pending: PendingConnections[int] = PendingConnections(2, 2)
    assert [pending.add(number, f"host{number}") for number in range(4)] == [None, None, 0, 1]


def test_discarded_connections_leave_room() -> None:
    pending: PendingConnections[int] = PendingConnections(2, 1)
    pending.add(1, "east")
    pending.discard(1)
    pending.discard(1)
    assert pending.add(2, "east") is None
    assert len(pending) == 1


def test_added_again_counts_as_the_newest() -> None:
    pending: PendingConnections[int] = PendingConnections(2, 2)
    pending.add(1, "east")
    pending.add(2, "east")
    assert pending.add(1, "east") is None
    assert pending.add(3, "east") == 2
