from dataclasses import dataclass

from hilrig_modbus_edge.device.lease import Lease


@dataclass(eq=False)
class Writer:
    last_request_ns: int = 0


def test_the_first_to_write_holds_the_rig_and_the_others_do_not() -> None:
    lease, one, other = Lease[Writer](100), Writer(), Writer()
    assert lease.take(one)
    assert not lease.take(other)
    assert lease.take(one)
    assert lease.holder is one


def test_a_released_rig_is_free() -> None:
    lease, one, other = Lease[Writer](100), Writer(), Writer()
    lease.take(one)
    assert lease.release() is one
    assert lease.release() is None
    assert lease.take(other)


def test_a_lease_expires_with_its_holders_silence() -> None:
    lease, one = Lease[Writer](100), Writer(last_request_ns=1000)
    assert not lease.expired(10_000)
    lease.take(one)
    assert not lease.expired(1099)
    assert lease.expired(1100)
    one.last_request_ns = 1050
    assert not lease.expired(1100)
