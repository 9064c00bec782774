"""Unit tests of the request log, from the edge to the rows of a recording."""

import numpy as np
import pytest
from google.protobuf.message import DecodeError
from hypothesis import given
from hypothesis import strategies as st

from hilrig_modbus_edge.request_log import RequestLog
from hilrig_replay.io.columns import CONNECTION_DTYPE, TRAFFIC_DTYPE, RowBuffer, Rows, StringTable
from hilrig_replay.io.traffic import traffic_decoder
from hilrig_schemas import ModbusKind, ModbusRequest, ModbusTraffic

READ, WRITE = bytes.fromhex("03 0004 0004"), bytes.fromhex("10 0000 0004 08 0001 0002 0003 0004")


def rows_of(message: ModbusTraffic, names: StringTable | None = None) -> Rows:
    table = RowBuffer(TRAFFIC_DTYPE)
    decode = traffic_decoder(table, RowBuffer(CONNECTION_DTYPE), names or StringTable())
    decode(message.SerializeToString(), 1, 0)
    return table.drain()


_REQUESTS = st.lists(
    st.tuples(
        st.binary(min_size=1, max_size=12) | st.sampled_from([READ, WRITE]),
        st.integers(0, 2**60),
        st.integers(0, 10**12),
        st.sampled_from([0, 1, 2, 3, 4, 6, 11]),
        st.sampled_from(["10.0.0.1:1", "10.0.0.2:1"]),
    ),
    max_size=40,
)


@given(_REQUESTS)
def test_recorded_requests_are_read_in_order(requests: list[tuple[bytes, int, int, int, str]]) -> None:
    log = RequestLog("rig1")
    for pdu, arrived_ns, took_ns, exception, controller in requests:
        log.record(pdu, arrived_ns, arrived_ns + took_ns, exception, controller)
    assert log.count == len(requests)
    names = StringTable()
    rows = rows_of(log.drain(5_000, 7_000), names)
    assert log.count == 0
    assert len(rows) == len(requests)
    for row, (pdu, arrived_ns, took_ns, exception, controller) in zip(rows, requests, strict=True):
        assert (row["function"], row["exception"], names[row["controller"]]) == (pdu[0], exception, controller)
        assert (row["arrived_ns"], row["answered_ns"]) == (arrived_ns, arrived_ns + took_ns)
        assert row["wall_ns"] == arrived_ns + 2_000


@pytest.mark.parametrize("pdu", ["63 0001 0002", "03 00", "05 00"])
def test_unknown_and_short_requests_have_no_address(pdu: str) -> None:
    log = RequestLog("rig1")
    log.record(bytes.fromhex(pdu), 1, 2, 0, "10.0.0.1:1")
    [row] = rows_of(log.drain(0, 0))
    assert (row["function"], row["address"], row["count"]) == (int(pdu[:2], 16), 0, 0)


def test_repeated_requests_share_a_kind() -> None:
    log = RequestLog("rig1")
    for number in range(100):
        log.record(READ, number, number, 0, "10.0.0.1:1")
        log.record(bytes((6, 0, 0, number, 7)), number, number, 0, "10.0.0.1:1")
    message = log.drain(0, 0)
    assert len(message.kinds) == 2
    assert list(message.kind_indexes) == [0, 1] * 100


def test_old_recordings_have_one_record_per_request() -> None:
    one = ModbusRequest(function=16, address=1, count=2, arrived_ns=50, answered_ns=60, exception=6, controller="a:1")
    names = StringTable()
    [row] = rows_of(ModbusTraffic(wall_ns=1_000, closed_ns=100, requests=[one]), names)
    assert [row[name] for name in ("function", "address", "count", "exception")] == [16, 1, 2, 6]
    assert (row["wall_ns"], row["arrived_ns"], row["answered_ns"], names[row["controller"]]) == (950, 50, 60, "a:1")


@pytest.mark.parametrize(
    ("indexes", "arrived", "after"), [([0, 0], [1], [1, 1]), ([1], [1], [1]), ([0], [1], [2**64 - 1])]
)
def test_inconsistent_columns_are_rejected(indexes: list[int], arrived: list[int], after: list[int]) -> None:
    message = ModbusTraffic(
        kinds=[ModbusKind(function=3)], kind_indexes=indexes, arrived_ns=arrived, answered_after_ns=after
    )
    with pytest.raises(DecodeError, match="inconsistent request columns"):
        rows_of(message)


def test_batch_of_many_requests_is_small() -> None:
    log = RequestLog("rig1")
    for now_ns in np.arange(10**15, 10**15 + 256 * 20_000, 20_000).tolist():
        log.record(READ, now_ns, now_ns + 15_000, 0, "192.168.100.100:50000")
    assert len(log.drain(10**15, 10**18).SerializeToString()) < 256 * 12 + 100


def test_reads_the_tcp_figures_of_connections() -> None:
    message = ModbusTraffic(rig="rig1", wall_ns=7_000)
    message.connections.add(controller="10.0.0.1:1", min_rtt_us=8_400, retransmissions=3)
    table, names = RowBuffer(CONNECTION_DTYPE), StringTable()
    traffic_decoder(RowBuffer(TRAFFIC_DTYPE), table, names)(message.SerializeToString(), 1, 0)
    (row,) = table.drain()
    assert (row["wall_ns"], row["min_rtt_us"], row["retransmissions"]) == (7_000, 8_400, 3)
    assert names[int(row["controller"])] == "10.0.0.1:1"
