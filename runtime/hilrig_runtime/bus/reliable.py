"""A complete stream out of zenoh's advanced publishers: live samples, and what is missing out of their caches.

zenoh's advanced subscriber would ask for all that is missing at once, and while a cache answers, its publisher's next
put waits: a recorder that came back to a class of rigs held the simulation up until it had taken in seconds of batches.
It asks for a gap only once, too, and takes the history of a publisher for old whose first live sample overtakes it. So
this subscribes to plain samples, and a thread of its own fetches what is missing in small pieces, one after the other,
until all is there or can't be had any more.
"""

import logging
import threading
import time
from dataclasses import dataclass
from typing import Any, Final

import zenoh
import zenoh.ext

from hilrig_runtime.bus.api import Handle, OnLoss, OnMessage
from hilrig_runtime.bus.reorder_buffer import ReorderBuffer

FETCH_PAGE_BYTES: Final = 256 * 1024
"""Of samples asked for at once: little enough to lie in the buffers between two processes."""
_PAUSE_S: Final = 0.002
"""Between two pieces, so that what is live goes on."""
_OVERTAKEN_S: Final = 0.1
"""A heartbeat may come before the sample that it tells of."""
_ASK_TIMEOUT_S: Final = 1.0
_ASK_AGAIN_S: Final = 0.25
_GIVE_UP_S: Final = 10.0
"""Who has not answered for so long is not waited for any more: what came after is to be written."""
_HEARTBEAT_S: Final = 0.25

logger = logging.getLogger(__name__)


def declare_recording_publisher(session: zenoh.Session, key: str, priority: zenoh.Priority, cache_depth: int) -> Any:
    """A publisher with a cache of its newest `cache_depth` samples.

    It never waits: what a slow reader has no room for is dropped, and can be repeated.
    """
    return zenoh.ext.declare_advanced_publisher(
        session,
        key,
        congestion_control=zenoh.CongestionControl.DROP,
        priority=priority,
        cache=zenoh.ext.CacheConfig(
            cache_depth,
            # The cache is locked while it answers: it must not wait for a reader that is held up. Who misses an answer
            # asks again.
            replies_config=zenoh.ext.RepliesConfig(
                congestion_control=zenoh.CongestionControl.DROP, priority=zenoh.Priority.BACKGROUND, express=False
            ),
        ),
        sample_miss_detection=zenoh.ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=_HEARTBEAT_S),
        publisher_detection=True,
    )


@dataclass(slots=True)
class _Source:
    """One publisher."""

    cache: str
    """Where its cache is asked."""
    samples: ReorderBuffer[zenoh.Sample]
    size: int = FETCH_PAGE_BYTES
    """Of its newest sample, bytes."""
    is_new: bool = True
    """It is not known yet what it sent before."""
    ask_at_s: float = 0.0
    """When to ask next, if something is missing; monotonic clock."""
    since_s: float = 0.0
    """Since when something is missing and nothing came of it."""
    has_backlog: bool = False
    """Something is missing."""


class ReliableSubscriber(Handle):
    """Subscribes to the recording publishers on `key_expr`; messages of each come in order and without a gap.

    `on_loss` hears how many messages of a publisher could not be recovered; each can repeat its newest `cache_depth`.
    """

    def __init__(
        self, session: zenoh.Session, key_expr: str, on_message: OnMessage, on_loss: OnLoss, cache_depth: int
    ) -> None:
        self._session = session
        self._cache_depth = cache_depth
        self._on_message = on_message
        self._on_loss = on_loss
        self._changed = threading.Condition()
        self._closing = False
        self._sources: dict[str, _Source] = {}
        self._thread = threading.Thread(target=self._fetch, name="fetching", daemon=True)
        self._thread.start()
        publishers = f"{key_expr}/@adv/pub/*/*/*"
        self._declared: list[Any] = [
            session.declare_subscriber(key_expr, self._on_sample),
            session.declare_subscriber(publishers, self._on_heartbeat),
            session.liveliness().declare_subscriber(publishers, self._on_token, history=True),
        ]

    def close(self) -> None:
        """See `Handle.close`; what waited behind a gap is delivered."""
        while self._declared:
            self._declared.pop().undeclare()
        with self._changed:
            if not self._closing:
                self._closing = True
                self._changed.notify()
                for source in self._sources.values():
                    source.samples.flush()

    # -- what comes -------------------------------------------------------------------------------------------------

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
            self._look(source)

    def _on_heartbeat(self, sample: zenoh.Sample) -> None:
        with self._changed:
            source = self._source(_cache_of(sample))
            source.samples.set_head(int.from_bytes(sample.payload.to_bytes(), "little"))
            self._look(source, _OVERTAKEN_S)

    def _on_token(self, sample: zenoh.Sample) -> None:
        if sample.kind == zenoh.SampleKind.PUT:
            with self._changed:
                # Also after an outage: what was sent last may be what is missing.
                source = self._source(_cache_of(sample))
                source.is_new = True
                self._look(source)

    def _source(self, cache: str) -> _Source:
        source = self._sources.get(cache)
        if source is None:
            samples: ReorderBuffer[zenoh.Sample] = ReorderBuffer(self._deliver, self._on_loss, self._cache_depth)
            source = self._sources[cache] = _Source(cache, samples)
        return source

    def _look(self, source: _Source, wait_s: float = 0.0) -> None:
        """See whether something is missing; if so, it is asked for after a while."""
        had_backlog, source.has_backlog = source.has_backlog, source.is_new or bool(source.samples.missing(1))
        if source.has_backlog and not had_backlog:
            source.since_s = time.monotonic()
            source.ask_at_s = source.since_s + wait_s
            self._changed.notify()

    def _deliver(self, sample: Any) -> None:
        self._on_message(str(sample.key_expr), sample.payload.to_bytes())

    # -- what is fetched --------------------------------------------------------------------------------------------

    def _fetch(self) -> None:
        while True:
            with self._changed:
                source = self._next()
                if source is None:
                    return
                question = f"{source.cache}?{_wanted(source)}"
            got = self._ask(source, question)
            with self._changed:
                self._judge(source, got)
            time.sleep(_PAUSE_S)

    def _next(self) -> _Source | None:
        """Wait for the source that is to be asked next, something of which is missing; None: the stream is closed."""
        while not self._closing:
            behind = [source for source in self._sources.values() if source.has_backlog]
            first = min(behind, key=lambda source: source.ask_at_s, default=None)
            wait_s = None if first is None else first.ask_at_s - time.monotonic()
            if wait_s is not None and wait_s <= 0:
                return first
            self._changed.wait(wait_s)
        return None

    def _ask(self, source: _Source, question: str) -> int:
        """Ask a source's cache; gives how many samples it had that are new."""
        got = 0
        try:
            replies = self._session.get(
                question,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                accept_replies=zenoh.ReplyKeyExpr.ANY,
                timeout=_ASK_TIMEOUT_S,
            )
            for reply in replies:
                sample = reply.ok
                if sample is None or sample.source_info is None:
                    continue
                with self._changed:
                    if self._closing:
                        break
                    got += source.samples.insert(int(sample.source_info.source_sn), sample)
                    source.size = max(1, len(sample.payload))
                    source.is_new = False
        except zenoh.ZError as error:
            logger.debug("%s can't be asked: %s", question, error)
        return got

    def _judge(self, source: _Source, got: int) -> None:
        """Ask on at once where something came of it, after a while where nothing did, and one day not at all."""
        now_s = time.monotonic()
        if got:
            source.since_s = now_s
            source.ask_at_s = now_s
        else:
            source.ask_at_s = now_s + _ASK_AGAIN_S
        if now_s - source.since_s > _GIVE_UP_S:
            source.samples.skip_gap()
            source.is_new = False
            source.since_s = now_s
        self._look(source)


def _wanted(source: _Source) -> str:
    """What to ask a cache for: the next piece, or of a source that is new its newest sample, to know what there is."""
    if source.is_new:
        return "_max=1"
    numbers = source.samples.missing(max(1, FETCH_PAGE_BYTES // source.size))
    return f"_max={len(numbers)};_sn={numbers.start}..{numbers.stop - 1}"


def _cache_of(sample: zenoh.Sample) -> str:
    """Where the cache of the publisher is asked whose token or heartbeat this is."""
    return f"{str(sample.key_expr).rpartition('/')[0]}/*"
