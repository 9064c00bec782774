"""How often each controller reads and writes: requests counted in bins of a tenth of a second.

Requests come in pieces whose ends fall within a bin: a bin is given when a later one has begun. What is kept is one
bin a controller and kind, and controllers beyond the first `MOST` are counted together.
"""

from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from hilrig_replay.io.columns import Names, Rows

BIN_NS: Final = 100_000_000
MOST: Final = 32
OTHERS: Final = "others"
KINDS: Final = ("reads", "writes")
_READS: Final = (1, 2, 3, 4, 23, 43)
_LONG_GAP: Final = 20
"""A longer silence is given by its ends, bins."""

Rate = tuple[str, str, NDArray[np.int64], NDArray[np.int64]]
"""Controller, kind of request, beginnings of the bins, wall clock, ns, shape (n,), requests in each, shape (n,)."""


class RequestRates:
    """Counts the requests of one rig."""

    def __init__(self, names: Names) -> None:
        self._names = names
        self._clients: dict[int, str] = {}
        self._pending: dict[tuple[str, str], tuple[int, int]] = {}

    def add(self, traffic: Rows) -> Iterator[Rate]:
        """Take in requests, fields as `columns.TRAFFIC`; the bins that are over."""
        read = np.isin(traffic["function"], _READS)
        clients = np.array([self._client(int(code)) for code in traffic["controller"]], dtype=object)
        for client in dict.fromkeys(clients):
            for kind, chosen in zip(KINDS, (read, ~read), strict=True):
                bins = traffic["wall_ns"][(clients == client) & chosen] // BIN_NS
                if len(bins):
                    yield from self._count(client, kind, bins)

    def end(self) -> Iterator[Rate]:
        """The last bins, which nothing followed."""
        for (client, kind), (number, count) in self._pending.items():
            yield client, kind, np.array([number]) * BIN_NS, np.array([count])
        self._pending.clear()

    def _client(self, code: int) -> str:
        client = self._clients.get(code)
        if client is None:
            client = self._names[code] or "unknown"
            if len(self._clients) >= MOST:
                return OTHERS
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
        # Between requests there were none: said at both ends of a long silence, in every bin of a short one.
        empty = [
            at
            for one, following in zip(numbers[:-1].tolist(), numbers[1:].tolist(), strict=True)
            for at in (range(one + 1, following) if following - one <= _LONG_GAP else (one + 1, following - 1))
        ]
        over = np.concatenate((numbers[:-1], np.array(empty, np.int64)))
        counts = np.concatenate((counts[:-1], np.zeros(len(empty), np.int64)))
        order = np.argsort(over)
        yield client, kind, over[order] * BIN_NS, counts[order]
