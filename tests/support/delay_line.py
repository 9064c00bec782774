"""A network link that delays and loses packets: two TUN devices with a queue between them.

The far one is in a network namespace.

Needs root, iproute2 and /dev/net/tun. The queue keeps the order of the packets, as a cable does.
"""

import ctypes
import fcntl
import heapq
import os
import random
import select
import shutil
import struct
import subprocess
import sys
import threading
import time
from itertools import count
from pathlib import Path
from types import TracebackType
from typing import Final, Self

import pytest

NEAR, FAR = "10.79.0.1", "10.79.0.2"
"""Addresses of the two ends; the far one is in the namespace."""
LONGEST_EMPTY_PACKET: Final = 60
"""IP and TCP headers with options, bytes: connections are opened and closed without losses."""
TUNSETIFF = 0x400454CA
IFF_TUN_NO_PI = 0x0001 | 0x1000
CLONE_NEWNET: Final = 0x40000000
_NUMBERS = count()


def require_delay_line() -> None:
    """Skip the test if there are no TUN devices or network namespaces."""
    if sys.platform != "linux" or os.geteuid() != 0:
        pytest.skip("needs root on Linux for a TUN device and a network namespace")
    if shutil.which("ip") is None:
        pytest.skip("needs `ip` (Debian package iproute2)")
    try:
        with DelayLine(0.0, 0.0):
            pass
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"needs /dev/net/tun and network namespaces (CAP_NET_ADMIN, CAP_SYS_ADMIN): {error}")


class DelayLine:
    """Context manager; each packet takes `low_s` to `high_s` from one end to the other, uniformly distributed.

    A packet of a size that has data is lost with the probability `loss`.
    """

    def __init__(self, low_s: float, high_s: float, loss: float = 0.0) -> None:
        number = next(_NUMBERS)
        self.interface = f"hrn{os.getpid() % 100_000}x{number}"
        self._namespace = f"hr{os.getpid()}delay{number}"
        self._bounds_s = low_s, high_s
        self._loss = loss
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="delay line")
        self._ends: list[int] = []

    def command(self, command: list[str]) -> list[str]:
        """Return a command line that runs a command at the far end."""
        return ["ip", "netns", "exec", self._namespace, *command]

    def __enter__(self) -> Self:
        _ip("netns", "add", self._namespace)
        try:
            far = self.interface.replace("hrn", "hrf")
            self._ends = [_open_tun(self.interface, None), _open_tun(far, Path("/run/netns") / self._namespace)]
            for prefix, name, here, there in (
                ((), self.interface, NEAR, FAR),
                (("-n", self._namespace), far, FAR, NEAR),
            ):
                _ip(*prefix, "addr", "add", here, "peer", there, "dev", name)
                _ip(*prefix, "link", "set", name, "up")
            self._thread.start()
        except BaseException:
            self._close()
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stopping.set()
        self._thread.join()
        self._close()

    def _close(self) -> None:
        # A TUN device is removed when its file is closed.
        for end in self._ends:
            os.close(end)
        subprocess.run(["ip", "netns", "delete", self._namespace], check=False)

    def _run(self) -> None:
        generator = random.Random(1)
        other = dict(zip(self._ends, reversed(self._ends), strict=True))
        due: list[tuple[float, int, int, bytes]] = []
        last_s = dict.fromkeys(self._ends, 0.0)
        order = count()
        while not self._stopping.is_set():
            wait_s = 0.05 if not due else max(0.0, min(0.05, due[0][0] - time.monotonic()))
            readable, _, _ = select.select(self._ends, [], [], wait_s)
            for end in readable:
                packet = os.read(end, 65536)
                if self._loss and len(packet) > LONGEST_EMPTY_PACKET and generator.random() < self._loss:
                    continue
                last_s[end] = max(last_s[end], time.monotonic() + generator.uniform(*self._bounds_s))
                heapq.heappush(due, (last_s[end], next(order), other[end], packet))
            while due and due[0][0] <= time.monotonic():
                _, _, end, packet = heapq.heappop(due)
                os.write(end, packet)


def _open_tun(name: str, namespace: Path | None) -> int:
    """Create a TUN device, in this network namespace or in that of a file, and return its descriptor."""
    opened: list[int | OSError] = []

    def create() -> None:
        # Only this thread changes its namespace.
        try:
            if namespace is not None:
                with namespace.open() as file:
                    if ctypes.CDLL(None, use_errno=True).setns(file.fileno(), CLONE_NEWNET):
                        raise OSError(ctypes.get_errno(), f"setns {namespace}")
            descriptor = os.open("/dev/net/tun", os.O_RDWR)
            fcntl.ioctl(descriptor, TUNSETIFF, struct.pack("16sH22x", name.encode(), IFF_TUN_NO_PI))
            opened.append(descriptor)
        except OSError as error:
            opened.append(error)

    thread = threading.Thread(target=create)
    thread.start()
    thread.join()
    if isinstance(opened[0], OSError):
        raise opened[0]
    return opened[0]


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True, text=True)
