"""Request rates: independent of the block size, with a bounded number of controllers."""

import numpy as np
import pytest

from hilrig_replay.io.columns import TRAFFIC_DTYPE, Rows, StringTable
from hilrig_replay.rerun_view.request_rates import BIN_NS, MAX_CLIENTS, OTHER_CLIENTS, RequestRates


def requests(names: StringTable, at_ms: list[float], *, controller: str = "a:1", **values: int) -> Rows:
    rows = np.zeros(len(at_ms), TRAFFIC_DTYPE)
    rows["wall_ns"] = np.array(at_ms) * 1e6
    rows["controller"] = names.code(controller)
    for name, value in ({"function": 3} | values).items():
        rows[name] = value
    return rows


def counted(pieces: list[Rows], names: StringTable) -> dict[tuple[str, str], dict[int, int]]:
    rates = RequestRates(names)
    found: dict[tuple[str, str], dict[int, int]] = {}
    given = [rate for piece in pieces for rate in rates.add(piece)] + list(rates.end())
    for client, kind, begins_ns, counts in given:
        bins = found.setdefault((client, kind), {})
        for begin_ns, count in zip(begins_ns.tolist(), counts.tolist(), strict=True):
            assert begin_ns // BIN_NS not in bins, "a bin is returned once"
            bins[begin_ns // BIN_NS] = count
    return found


def test_counts_requests_by_controller_and_kind() -> None:
    names = StringTable()
    rows = np.concatenate(
        (
            requests(names, [0, 50, 99, 100, 350]),
            requests(names, [10], function=16),
            requests(names, [20], controller="b:2"),
        )
    )
    assert counted([rows], names) == {
        ("a:1", "reads"): {0: 3, 1: 1, 2: 0, 3: 1},
        ("a:1", "writes"): {0: 1},
        ("b:2", "reads"): {0: 1},
    }


@pytest.mark.parametrize("function", [1, 2, 3, 4, 43])
def test_reads_are_counted_as_reads(function: int) -> None:
    names = StringTable()
    assert counted([requests(names, [0], function=function)], names) == {("a:1", "reads"): {0: 1}}


@pytest.mark.parametrize("function", [5, 6, 15, 16, 22, 23])
def test_writes_are_counted_as_writes(function: int) -> None:
    """Function 23 writes torques: a controller that uses nothing else must not be shown as a reader."""
    names = StringTable()
    assert counted([requests(names, [0], function=function)], names) == {("a:1", "writes"): {0: 1}}


@pytest.mark.parametrize(("function", "exception"), [(8, 1), (17, 1), (8, 0), (3, 2), (16, 6), (23, 4)])
def test_refused_and_unknown_requests_are_errors(function: int, exception: int) -> None:
    names = StringTable()
    rows = requests(names, [0], function=function, exception=exception)
    assert counted([rows], names) == {("a:1", "errors"): {0: 1}}


def test_counts_do_not_depend_on_the_block_size() -> None:
    names = StringTable()
    at_ms = np.sort(np.random.default_rng(2).uniform(0, 5000, 700)).tolist()
    whole = counted([requests(names, at_ms)], names)
    assert sum(whole["a:1", "reads"].values()) == 700
    for size in (1, 7, 100):
        pieces = [requests(names, at_ms[start : start + size]) for start in range(0, len(at_ms), size)]
        assert counted(pieces, names) == whole


def test_a_long_gap_has_two_points() -> None:
    names = StringTable()
    hour_ms = 3_600_000.0
    bins = counted([requests(names, [0, hour_ms])], names)["a:1", "reads"]
    assert bins == {0: 1, 1: 0, 35_999: 0, 36_000: 1}


def test_counts_controllers_beyond_the_limit_together() -> None:
    names = StringTable()
    rows = [requests(names, [10], controller=f"10.0.0.1:{number}") for number in range(MAX_CLIENTS + 50)]
    found = counted([np.concatenate(rows)], names)
    assert len(found) == MAX_CLIENTS + 1
    assert found[OTHER_CLIENTS, "reads"] == {0: 50}


def test_texts_beyond_the_code_range_share_the_last_code() -> None:
    names = StringTable()
    codes = [names.code(f"192.0.2.7:{port}") for port in range(70_000)]
    assert codes[:3] == [1, 2, 3]
    assert max(codes) == 0xFFFF
    assert (names[codes[65_533]], names[codes[65_534]]) == ("192.0.2.7:65533", StringTable.OVERFLOW_TEXT)
    assert names.code("192.0.2.7:5") == codes[5]
    assert codes[65_534:] == [0xFFFF] * (70_000 - 65_534)
