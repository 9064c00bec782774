"""Counts and logs the exception responses of a rig: an operator sees which client asks for what does not exist."""

from collections.abc import Callable, Iterator
from typing import Final, NamedTuple

from pymodbus.constants import ExcCodes

from hilrig_modbus_edge.device.client import Client
from hilrig_modbus_edge.protocol.functions import FunctionCode
from hilrig_modbus_edge.server.explanation import explain
from hilrig_runtime.timing.rate_limiter import RepeatReporter

MAX_HOSTS: Final = 32
"""Number of hosts that are counted by name; the others are counted together, as `OTHER_HOSTS`."""
OTHER_HOSTS: Final = "other"
LOG_PERIOD_NS: Final = 10_000_000_000
"""Shortest time between two log messages about the same function, exception and host, ns."""
_FUNCTIONS: Final = frozenset(int(function) for function in FunctionCode)
_UNSUPPORTED: Final = 0


class _Key(NamedTuple):
    host: str
    function: int
    """0: one that the rig does not have."""
    code: int


class ExceptionLog:
    """Exception responses of one rig by host, function and code. Time is passed in."""

    def __init__(self, report: Callable[[str, int], None]) -> None:
        self._counts: dict[_Key, int] = {}
        self._hosts: set[str] = set()
        self._reporter: RepeatReporter[_Key, tuple[str, int, int, bytes, int]] = RepeatReporter(
            LOG_PERIOD_NS, lambda refused, count: report(f"{refused[0]} {explain(*refused[1:])}", count)
        )

    def record(self, client: Client, transaction: int, unit: int, request: bytes, code: int, now_ns: int) -> None:
        """Count an exception response, and report it, rate-limited.

        Args:
            client: connection that sent the request.
            transaction: transaction identifier of the request.
            unit: its unit identifier.
            request: its PDU.
            code: exception code of the response.
            now_ns: time, ns, monotonic clock.
        """
        host = client.host
        if host not in self._hosts:
            if len(self._hosts) < MAX_HOSTS:
                self._hosts.add(host)
            else:
                host = OTHER_HOSTS
        key = _Key(host, request[0] if request[0] in _FUNCTIONS else _UNSUPPORTED, code)
        self._counts[key] = self._counts.get(key, 0) + 1
        # A refused write is an event, with the reason of this moment.
        if code != ExcCodes.DEVICE_BUSY:
            self._reporter.record(key, (client.address, transaction, unit, request, code), now_ns)

    def check(self, now_ns: int) -> None:
        """Report the suppressed exception responses whose period has ended; ns, monotonic clock."""
        self._reporter.check(now_ns)

    def counts(self) -> Iterator[tuple[str, int, int, int]]:
        """Yield host, function, exception code and number; function 0: one that the rig does not have."""
        for key, count in self._counts.items():
            yield *key, count
