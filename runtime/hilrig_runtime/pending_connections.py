"""Accepted connections that wait for their client: for its TLS handshake, or for a complete request.

Anybody can open such a connection and send nothing. Therefore they have limits of their own, per host and in total, and
beyond a limit an old one is closed instead of the new one: a client that sends its handshake or request at once is
served, however many others wait. Pure.
"""

from collections import Counter
from collections.abc import Iterator
from typing import Generic, TypeVar

ConnectionT = TypeVar("ConnectionT")


class PendingConnections(Generic[ConnectionT]):
    """The waiting connections of a server, each with its host; the first one waits longest."""

    def __init__(self, limit: int, limit_per_host: int) -> None:
        self._limit = limit
        self._limit_per_host = limit_per_host
        self._hosts: dict[ConnectionT, str] = {}
        self._counts: Counter[str] = Counter()

    def __iter__(self) -> Iterator[ConnectionT]:
        return iter(tuple(self._hosts))

    def __len__(self) -> int:
        return len(self._hosts)

    def add(self, connection: ConnectionT, host: str) -> ConnectionT | None:
        """Add a connection, as the newest one; return a connection to close because of a limit, which is removed.

        That is the oldest one of its host or, if only the total is exceeded, of the host with the most.
        """
        self.discard(connection)
        self._hosts[connection] = host
        self._counts[host] += 1
        if self._counts[host] > self._limit_per_host:
            crowded = host
        elif len(self._hosts) > self._limit:
            crowded = max(self._counts, key=self._counts.__getitem__)
        else:
            return None
        oldest = next(one for one, its_host in self._hosts.items() if its_host == crowded)
        self.discard(oldest)
        return oldest

    def discard(self, connection: ConnectionT) -> None:
        """Remove a connection that does not wait any more, if it is present."""
        host = self._hosts.pop(connection, None)
        if host is not None:
            self._counts[host] -= 1
            if not self._counts[host]:
                del self._counts[host]
