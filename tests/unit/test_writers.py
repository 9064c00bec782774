from hilrig_modbus_edge.device.client import Client
from hilrig_modbus_edge.device.writers import Writers


def test_partly_replaced_write_is_not_repeated() -> None:
    writers, one, other = Writers(), Client("10.0.0.1", "10.0.0.1:1000"), Client("10.0.0.1", "10.0.0.1:1001")
    assert not writers.rewrite(one, 0, 4, 1)
    writers.record(one, 0, 4, 1)
    assert writers.rewrite(one, 0, 4, 2)
    assert not writers.rewrite(one, 0, 2, 2)
    assert not writers.rewrite(other, 0, 4, 2)
    writers.record(other, 1, 2, 3)
    assert not writers.rewrite(one, 0, 4, 4)
    assert writers.other(one, 0, 4, 2) is other
    # The other items keep their writer, and the time of its last write.
    assert writers.other(other, 0, 4, 1) is one
    assert writers.other(other, 0, 4, 2) is None
    writers.remove(one)
    assert writers.other(other, 0, 4, 0) is None
