"""The bus between processes, over zenoh."""

import logging
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final

import zenoh

from hilrig_runtime.bus.api import CACHE_DEPTH, Bus, Handle, OnLiveliness, OnMessage, Publisher, Reply
from hilrig_runtime.bus.reliable import ReliableSubscriber, declare_recording_publisher
from hilrig_runtime.bus.zenoh_config import (
    FIRST_INSTANCE,
    MESH_ORDER,
    finds_others_by_gossip,
    mesh_endpoint,
    system_reason,
    unknown_host,
    zenoh_config,
)
from hilrig_runtime.config.bus import BusConfig
from hilrig_runtime.errors import HilrigError, OperationError
from hilrig_runtime.timing.realtime import raise_priority
from hilrig_schemas.topics import Traffic

_GOSSIP_S: Final = 1.0
"""Time for discovery by gossip, s; it takes about 50 ms on an idle machine."""
_PRIORITIES: Final = {
    Traffic.CONTROL: zenoh.Priority.REAL_TIME,
    Traffic.RECORDING: zenoh.Priority.DATA_LOW,
    Traffic.REPORT: zenoh.Priority.BACKGROUND,
}

logger = logging.getLogger(__name__)


class _Declared(Handle):
    def __init__(self, declaration: Any) -> None:
        self._declaration = declaration

    def close(self) -> None:
        declaration, self._declaration = self._declaration, None
        if declaration is not None:
            declaration.undeclare()


class _NewestReader(Handle):
    """Reads a ring buffer of the newest samples on a thread of its own.

    A callback is behind a queue of 256 samples: a process that was delayed for a moment would first process outdated
    samples, at a step of 1 ms for a quarter of a second.
    """

    def __init__(self, session: zenoh.Session, key_expr: str, on_message: OnMessage, depth: int) -> None:
        self._subscriber: Any = session.declare_subscriber(key_expr, zenoh.handlers.RingChannel(depth))
        # The thread waits in the ring buffer, not in the subscriber, which could not be undeclared meanwhile.
        self._ring = self._subscriber.handler
        self._on_sample = _deliver(on_message)
        self._closing = False
        self._thread = threading.Thread(target=self._read, name=f"newest {key_expr}", daemon=True)
        self._thread.start()

    def _read(self) -> None:
        recv, on_sample = self._ring.recv, self._on_sample
        # A receive fails when the subscriber is undeclared or the session is closed.
        with raise_priority(), suppress(zenoh.ZError):
            while not self._closing:
                sample = recv()
                if not self._closing:
                    on_sample(sample)

    def close(self) -> None:
        if not self._closing:
            self._closing = True
            self._subscriber.undeclare()
            self._thread.join(timeout=1.0)


class ZenohBus(Bus):
    """Implements `hilrig_runtime.bus.api.Bus` over zenoh; raises `OperationError` if the session can't be opened."""

    def __init__(self, bus: BusConfig, service: str, instance: str = FIRST_INSTANCE) -> None:
        self._express = bus.express
        if finds_others_by_gossip(bus, service, instance):
            self.settle_timeout_s = _GOSSIP_S
        try:
            with raise_priority():
                self._session: zenoh.Session | None = zenoh.open(zenoh_config(bus, service, instance))
        except zenoh.ZError as error:
            raise OperationError(_open_error(bus, service, error)) from error

    @property
    def session(self) -> zenoh.Session:
        """The zenoh session."""
        if self._session is None:
            raise OperationError("the bus is closed")
        return self._session

    def publisher(self, key: str, traffic: Traffic, cache_depth: int = CACHE_DEPTH) -> Publisher:
        """See `Bus.publisher`."""
        if traffic is Traffic.RECORDING:
            publisher: Any = declare_recording_publisher(self.session, key, _PRIORITIES[traffic], cache_depth)
        else:
            publisher = self.session.declare_publisher(
                key,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=_PRIORITIES[traffic],
                express=self._express and traffic is Traffic.CONTROL,
            )
        return Publisher(publisher.put, _Declared(publisher))

    def subscribe(self, key_expr: str, on_message: OnMessage) -> Handle:
        """See `Bus.subscribe`."""
        return _Declared(self.session.declare_subscriber(key_expr, _deliver(on_message)))

    def subscribe_newest(self, key_expr: str, on_message: OnMessage, depth: int) -> Handle:
        """See `Bus.subscribe_newest`."""
        return _NewestReader(self.session, key_expr, on_message, depth)

    def subscribe_recording(self, key_expr: str, on_message: OnMessage, cache_depth: int = CACHE_DEPTH) -> Handle:
        """See `Bus.subscribe_recording`."""
        return ReliableSubscriber(self.session, key_expr, on_message, cache_depth)

    def declare_queryable(self, key: str, handler: Callable[[bytes], bytes]) -> Handle:
        """See `Bus.declare_queryable`."""

        def reply(query: zenoh.Query) -> None:
            with query:
                try:
                    query.reply(key, handler(b"" if query.payload is None else query.payload.to_bytes()))
                except HilrigError as error:
                    query.reply_err(str(error).encode())
                except Exception:
                    logger.exception("query handler of %s failed", key)
                    query.reply_err(b"internal error of the service; see its log")

        return _Declared(self.session.declare_queryable(key, reply))

    def query(self, key_expr: str, payload: bytes = b"", *, timeout_s: float = 1.0) -> list[Reply]:
        """See `Bus.query`."""
        replies = []
        sent_ns = time.monotonic_ns()
        # Without consolidation, each reply is delivered when it arrives. Otherwise zenoh keeps it back until all have
        # arrived or the time is over, which a stopped service prolongs for all others.
        found = self.session.get(
            key_expr,
            payload=payload,
            timeout=timeout_s,
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
        )
        for reply in found:
            if reply.ok is not None:
                now_ns = time.monotonic_ns()
                key, content = str(reply.ok.key_expr), reply.ok.payload.to_bytes()
                replies.append(Reply(key, content, arrived_ns=now_ns, round_trip_ns=now_ns - sent_ns))
            elif reply.err is not None:
                text = reply.err.payload.to_bytes().decode(errors="replace")
                # zenoh reports a query without a reply as an error of its own.
                if text.lower() != "timeout":
                    replies.append(Reply(key_expr, b"", text))
        return replies

    def declare_token(self, key: str) -> Handle:
        """See `Bus.declare_token`."""
        return _Declared(self.session.liveliness().declare_token(key))

    def subscribe_liveliness(self, key_expr: str, on_alive: OnLiveliness) -> Handle:
        """See `Bus.subscribe_liveliness`."""

        def on_sample(sample: zenoh.Sample) -> None:
            on_alive(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        return _Declared(self.session.liveliness().declare_subscriber(key_expr, on_sample, history=True))

    def get_liveliness(self, key_expr: str, *, timeout_s: float = 1.0) -> list[str]:
        """See `Bus.get_liveliness`."""
        replies = self.session.liveliness().get(key_expr, timeout=timeout_s)
        return sorted({str(reply.ok.key_expr) for reply in replies if reply.ok is not None})

    def close(self) -> None:
        """Close the session; a process that exits with an open session can hang."""
        session, self._session = self._session, None
        if session is not None:
            try:
                session.close()  # type: ignore[no-untyped-call]
            except zenoh.ZError as error:
                # A stopped peer does not acknowledge the end of its link, for which zenoh waits 10 s.
                logger.debug("the bus was not closed in order: %s", error)


def _deliver(on_message: OnMessage) -> Callable[[zenoh.Sample], None]:
    def on_sample(sample: zenoh.Sample) -> None:
        on_message(str(sample.key_expr), sample.payload.to_bytes())

    return on_sample


def _open_error(bus: BusConfig, service: str, error: Exception) -> str:
    if bus.topology == "router":
        host = unknown_host(bus.router_host)
        if host:
            return f"no zenoh router answers at {bus.router} (bus.router in lab.toml): unknown host name {host!r}"
        certificate = "" if bus.tls is None else ", or the certificates do not match: run hilrig doctor"
        return f"no zenoh router answers at {bus.router} (bus.router in lab.toml){certificate}"
    if service not in MESH_ORDER:
        return f"can't connect to the bus: {error}"
    return (
        f"can't listen on {mesh_endpoint(bus, service)} for the bus ({system_reason(error)}): "
        "is another hilrig running here? Stop it, or choose another bus.first_port in lab.toml"
    )
