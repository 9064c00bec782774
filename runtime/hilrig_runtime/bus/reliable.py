"""A reliable subscriber to zenoh's advanced publishers: receives live samples and recovers lost ones from their caches.

zenoh's advanced subscriber requests all missing samples at once, and while a cache replies, the publisher's next put
blocks: a recorder that restarted beside many rigs blocked the simulation until it had received seconds of batches. It
also requests a gap only once, and ignores the history of a publisher whose first live sample arrives before it. So this
class subscribes to plain samples, and its own thread fetches missing samples page by page until the gap is closed or
the samples are no longer available.
"""

import logging
import threading
import time
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import zenoh
import zenoh.ext

from hilrig_runtime.bus.api import Handle, OnMessage
from hilrig_runtime.bus.reorder_buffer import ReorderBuffer

FETCH_PAGE_BYTES: Final = 256 * 1024
"""Size of a page of samples, bytes: small enough for the buffers between two processes."""
_PAGE_INTERVAL_S: Final = 0.002
"""Pause between two pages, so that live samples are not delayed."""
_HEARTBEAT_GRACE_S: Final = 0.1
"""Time that a sample may arrive after the heartbeat that announces it."""
_QUERY_TIMEOUT_S: Final = 1.0
_RETRY_INTERVAL_S: Final = 0.25
_RECOVERY_TIMEOUT_S: Final = 10.0
"""Time without progress after which a gap is declared lost, so that later samples can be written."""
_HEARTBEAT_S: Final = 0.25
_MAX_SAMPLE_NUMBER: Final = (1 << 32) - 1
"""Largest number that zenoh gives to a sample."""

logger = logging.getLogger(__name__)


def declare_recording_publisher(session: zenoh.Session, key: str, priority: zenoh.Priority, cache_depth: int) -> Any:
    """Declare a publisher with a cache of its newest `cache_depth` samples.

    It never blocks: samples for a slow subscriber are dropped, and can be recovered from the cache.
    """
    return zenoh.ext.declare_advanced_publisher(
        session,
        key,
        congestion_control=zenoh.CongestionControl.DROP,
        priority=priority,
        cache=zenoh.ext.CacheConfig(
            cache_depth,
            # The cache is locked while it replies, so it must not wait for a slow subscriber, which repeats its query.
            replies_config=zenoh.ext.RepliesConfig(
                congestion_control=zenoh.CongestionControl.DROP, priority=zenoh.Priority.BACKGROUND, express=False
            ),
        ),
        sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=_HEARTBEAT_S),
        publisher_detection=True,
    )


@dataclass(slots=True)
class _Source:
    """State of one publisher."""

    cache: str
    """Key expression of its cache."""
    samples: ReorderBuffer[zenoh.Sample]
    size: int = FETCH_PAGE_BYTES
    """Size of its newest sample, bytes."""
    is_new: bool = True
    """Its earlier samples are still unknown."""
    next_query_s: float = 0.0
    """Time of the next query if samples are missing, monotonic clock, s."""
    last_progress_s: float = 0.0
    """Time since which samples are missing without progress, monotonic clock, s."""
    has_backlog: bool = False
    """Samples are missing."""


class ReliableSubscriber(Handle):
    """Subscribes to the recording publishers on `key_expr`; delivers the messages of each in order.

    A gap remains only if its messages could not be recovered; each publisher caches `cache_depth` messages.
    """

    def __init__(self, session: zenoh.Session, key_expr: str, on_message: OnMessage, cache_depth: int) -> None:
        self._session = session
        self._cache_depth = cache_depth
        self._on_message = on_message
        self._changed = threading.Condition()
        self._closing = False
        self._sources: dict[str, _Source] = {}
        self._thread = threading.Thread(target=self._fetch, name="recovery", daemon=True)
        self._thread.start()
        publishers = f"{key_expr}/@adv/pub/*/*/*"
        self._declared: list[Any] = [
            session.declare_subscriber(key_expr, self._on_sample),
            session.declare_subscriber(publishers, self._on_heartbeat),
            session.liveliness().declare_subscriber(publishers, self._on_token, history=True),
        ]

    def close(self) -> None:
        """See `Handle.close`; delivers the samples that are buffered behind a gap."""
        while self._declared:
            self._declared.pop().undeclare()
        with self._changed:
            if not self._closing:
                self._closing = True
                self._changed.notify()
                for source in self._sources.values():
                    source.samples.flush()

    # -- received samples -------------------------------------------------------------------------------------------

    def _on_sample(self, sample: zenoh.Sample) -> None:
        info = sample.source_info
        if info is None:
            self._deliver(sample)
            return
        identity = f"{info.source_id.zid}/{info.source_id.eid}"
        with self._changed:
            source = self._source(f"{sample.key_expr}/@adv/pub/{identity}/*")
            source.size = max(1, len(sample.payload))
            source.is_new = False
            source.samples.insert(int(info.source_sn), sample)
            self._update_backlog(source)

    def _on_heartbeat(self, sample: zenoh.Sample) -> None:
        number = int.from_bytes(sample.payload.to_bytes(), "little")
        if number > _MAX_SAMPLE_NUMBER:
            return
        with self._changed:
            source = self._source(_cache_of(sample))
            source.samples.set_head(number)
            self._update_backlog(source, _HEARTBEAT_GRACE_S)

    def _on_token(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            with self._changed:
                # Also after an outage: the newest samples may be missing.
                source = self._source(_cache_of(sample))
                source.is_new = True
                self._update_backlog(source)

    def _source(self, cache: str) -> _Source:
        source = self._sources.get(cache)
        if source is None:
            samples: ReorderBuffer[zenoh.Sample] = ReorderBuffer(
                self._deliver, partial(logger.debug, "%s: %d samples lost", cache), self._cache_depth
            )
            for other in self._sources.values():
                if _service_of(other.cache) == _service_of(cache) and _session_of(other.cache) != _session_of(cache):
                    # The service was restarted: the cache of its earlier instance has ended with it, and the messages
                    # that were received of that one precede those of this one.
                    other.samples.flush()
                    other.is_new = other.has_backlog = False
            source = self._sources[cache] = _Source(cache, samples)
        return source

    def _update_backlog(self, source: _Source, delay_s: float = 0.0) -> None:
        """Check whether samples are missing; if so, query them after `delay_s`."""
        had_backlog, source.has_backlog = source.has_backlog, source.is_new or bool(source.samples.missing(1))
        if source.has_backlog and not had_backlog:
            source.last_progress_s = time.monotonic()
            source.next_query_s = source.last_progress_s + delay_s
            self._changed.notify()

    def _deliver(self, sample: Any) -> None:
        self._on_message(str(sample.key_expr), sample.payload.to_bytes())

    # -- recovery ---------------------------------------------------------------------------------------------------

    def _fetch(self) -> None:
        while True:
            with self._changed:
                source = self._wait_for_backlog()
                if source is None:
                    return
                selector = f"{source.cache}?{_query_parameters(source)}"
            new_samples = self._query(source, selector)
            with self._changed:
                self._schedule(source, new_samples)
            time.sleep(_PAGE_INTERVAL_S)

    def _wait_for_backlog(self) -> _Source | None:
        """Wait until a source must be queried, and return it; None: the subscriber is closed."""
        while not self._closing:
            behind = [source for source in self._sources.values() if source.has_backlog]
            first = min(behind, key=lambda source: source.next_query_s, default=None)
            wait_s = None if first is None else first.next_query_s - time.monotonic()
            if wait_s is not None and wait_s <= 0:
                return first
            self._changed.wait(wait_s)
        return None

    def _query(self, source: _Source, selector: str) -> int:
        """Query a source's cache; return the number of new samples."""
        new_samples = 0
        try:
            replies = self._session.get(
                selector,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                accept_replies=zenoh.ReplyKeyExpr.ANY,
                timeout=_QUERY_TIMEOUT_S,
            )
            for reply in replies:
                sample = reply.ok
                if sample is None or sample.source_info is None:
                    continue
                with self._changed:
                    if self._closing:
                        break
                    new_samples += source.samples.insert(int(sample.source_info.source_sn), sample)
                    source.size = max(1, len(sample.payload))
                    source.is_new = False
        except zenoh.ZError as error:
            logger.debug("query of %s failed: %s", selector, error)
        return new_samples

    def _schedule(self, source: _Source, new_samples: int) -> None:
        """Query again at once after progress, else after an interval; declare the gap lost after the timeout."""
        now_s = time.monotonic()
        if new_samples:
            source.last_progress_s = now_s
            source.next_query_s = now_s
        else:
            source.next_query_s = now_s + _RETRY_INTERVAL_S
        if now_s - source.last_progress_s > _RECOVERY_TIMEOUT_S:
            source.samples.skip_gap()
            source.is_new = False
            source.last_progress_s = now_s
        self._update_backlog(source)


def _query_parameters(source: _Source) -> str:
    """Return the parameters of the next query: the next page, or for a new source its newest sample."""
    if source.is_new:
        return "_max=1"
    numbers = source.samples.missing(max(1, FETCH_PAGE_BYTES // source.size))
    return f"_max={len(numbers)};_sn={numbers.start}..{numbers.stop - 1}"


def _service_of(cache: str) -> str:
    """Return the key on which the publisher of a cache publishes."""
    return cache.partition("/@adv/")[0]


def _session_of(cache: str) -> str:
    """Return the identity of the zenoh session of a cache's publisher."""
    return cache.rsplit("/", 3)[1]


def _cache_of(sample: zenoh.Sample) -> str:
    """Return the key expression of the cache of the publisher whose token or heartbeat this is."""
    return f"{str(sample.key_expr).rpartition('/')[0]}/*"
