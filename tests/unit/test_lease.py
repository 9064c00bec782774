from dataclasses import dataclass

from hilrig_modbus_edge.device.write_access import Lease


@dataclass(eq=False)
class Writer:
    last_request_ns: int = 0


def test_first_client_acquires_the_lease() -> None:
    lease, one, other = Lease[Writer](100), Writer(), Writer()
    assert lease.acquire(one)
    assert not lease.acquire(other)
    assert lease.acquire(one)
    assert lease.holder is one


def test_released_lease_is_free() -> None:
    lease, one, other = Lease[Writer](100), Writer(), Writer()
    lease.acquire(one)
    assert lease.release() is one
    assert lease.release() is None
    assert lease.acquire(other)


def test_lease_expires_without_requests_of_its_holder() -> None:
    lease, one = Lease[Writer](100), Writer(last_request_ns=1000)
    assert not lease.expired(10_000)
    lease.acquire(one)
    assert not lease.expired(1099)
    assert lease.expired(1100)
    one.last_request_ns = 1050
    assert not lease.expired(1100)
