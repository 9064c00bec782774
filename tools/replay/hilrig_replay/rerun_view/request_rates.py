"""Modbus request rates: reads, writes and errors of each controller, counted in bins of 0.1 s.

Each request has one kind. A request that was answered with an exception response is an error, and so is an unknown
function; function 23, which reads and writes, is a write.

Requests are added in blocks whose ends can be within a bin, so a bin is returned when a later bin has begun. Only the
current bin of each controller and kind is kept, and controllers beyond the first `MAX_CLIENTS` are counted together.
"""

from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_modbus_edge.protocol.functions import FunctionCode
from hilrig_replay.io.columns import Rows, StringTable

BIN_NS: Final = 100_000_000
MAX_CLIENTS: Final = 32
OTHER_CLIENTS: Final = "others"
KINDS: Final = ("reads", "writes", "errors")
_WRITES: Final = [function for function in FunctionCode if function.is_write]
_READS: Final = [function for function in FunctionCode if not function.is_write]
_MAX_GAP_BINS: Final = 20
"""Gaps of up to this number of bins are returned as empty bins; of longer gaps only the first and last bin."""

Rate = tuple[str, str, NDArray[np.int64], NDArray[np.int64]]
"""Controller, kind of request, start times of the bins (wall clock, ns, shape (n,)), requests per bin (shape (n,))."""


class RequestRates:
    """Counts the requests of one rig."""

    def __init__(self, names: StringTable) -> None:
        self._names = names
        self._clients: dict[int, str] = {}
        self._pending: dict[tuple[str, str], tuple[int, int]] = {}

    def add(self, traffic: Rows) -> Iterator[Rate]:
        """Add requests, fields as `columns.TRAFFIC_DTYPE`; returns the bins that are complete."""
        executed = traffic["exception"] == 0
        reads, writes = (executed & np.isin(traffic["function"], functions) for functions in (_READS, _WRITES))
        clients = np.array([self._client(int(code)) for code in traffic["controller"]], dtype=object)
        for client in dict.fromkeys(clients):
            for kind, chosen in zip(KINDS, (reads, writes, ~(reads | writes)), strict=True):
                bins = traffic["wall_ns"][(clients == client) & chosen] // BIN_NS
                if len(bins):
                    yield from self._count(client, kind, bins)

    def end(self) -> Iterator[Rate]:
        """Return the last bin of each controller and kind."""
        for (client, kind), (number, count) in self._pending.items():
            yield client, kind, np.array([number]) * BIN_NS, np.array([count])
        self._pending.clear()

    def _client(self, code: int) -> str:
        client = self._clients.get(code)
        if client is None:
            client = self._names[code] or "unknown"
            if len(self._clients) >= MAX_CLIENTS:
                return OTHER_CLIENTS
            self._clients[code] = client
        return client

    def _count(self, client: str, kind: str, bins: NDArray[np.int64]) -> Iterator[Rate]:
        numbers, counts = np.unique(bins, return_counts=True)
        before = self._pending.get((client, kind))
        if before is not None:
            numbers, where = np.unique(np.append(numbers, before[0]), return_inverse=True)
            counts = np.bincount(where, weights=np.append(counts, before[1])).astype(np.int64)
        self._pending[client, kind] = (int(numbers[-1]), int(counts[-1]))
        if len(numbers) == 1:
            return
        # A short gap is filled with empty bins, a long gap with an empty bin at each end.
        empty = [
            at
            for one, following in zip(numbers[:-1].tolist(), numbers[1:].tolist(), strict=True)
            for at in (range(one + 1, following) if following - one <= _MAX_GAP_BINS else (one + 1, following - 1))
        ]
        complete = np.concatenate((numbers[:-1], np.array(empty, np.int64)))
        counts = np.concatenate((counts[:-1], np.zeros(len(empty), np.int64)))
        order = np.argsort(complete)
        yield client, kind, complete[order] * BIN_NS, counts[order]
