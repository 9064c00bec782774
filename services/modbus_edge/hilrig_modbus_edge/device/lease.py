"""One writer a rig: the first client to write takes the lease, and keeps it while it is heard.

Pure: time is passed in. A holder is any object that has an identity and says when it was last heard.
"""

from typing import Generic, Protocol, TypeVar


class Holder(Protocol):
    """What can hold a lease."""

    last_request_ns: int
    """When it last asked for anything, ns, monotonic clock."""


HolderT = TypeVar("HolderT", bound=Holder)


class Lease(Generic[HolderT]):
    """Who may write to a rig."""

    def __init__(self, timeout_ns: int) -> None:
        self.timeout_ns = timeout_ns
        self.holder: HolderT | None = None

    def take(self, client: HolderT) -> bool:
        """Give the lease to `client` if it is free; False: another one holds it."""
        if self.holder is None:
            self.holder = client
        return self.holder is client

    def release(self) -> HolderT | None:
        """Free the lease; who held it."""
        holder, self.holder = self.holder, None
        return holder

    def expired(self, now_ns: int) -> bool:
        """Whether the holder has asked for nothing for the lease's time-out."""
        return self.holder is not None and now_ns - self.holder.last_request_ns >= self.timeout_ns
