"""A complete stream out of zenoh's advanced subscriber: what a publisher sent before its first live message too.

The advanced subscriber recovers gaps, and fetches the history of the publishers that it finds. Two things escape it.
When a publisher's first live sample overtakes that history, as it does when a link comes up under load, the history
is taken for old and dropped. And a gap is asked for once: when that question or its answers are lost, on a link that
has just come back, the gap is given up. So here the sample behind a gap is held, with all that follow it, until the
source's own cache has said what went before; what it does not say at once is asked for again.
"""

import threading
from dataclasses import dataclass, field
from typing import Any, Final

import zenoh
import zenoh.ext

from hilrig_runtime.bus import Handle, OnLoss, OnMessage

CACHE_SAMPLES: Final = 500
"""What a publisher can repeat: 10 s at 50 batches a second."""
_RECALL_TIMEOUT_S: Final = 2.0
_RECALLS: Final = 3
"""How often a gap is asked for before it is given up."""


@dataclass(slots=True)
class _Source:
    """One publisher."""

    cache: str
    """Where its cache is asked."""
    next: int | None = None
    """Number of the sample that is due; None: nothing of it was delivered yet."""
    held: list[zenoh.Sample] | None = None
    """Samples behind a gap, while it is asked for."""
    found: dict[int, zenoh.Sample] = field(default_factory=dict)
    recalls: int = 0


class CompleteStream(Handle):
    """Subscribes to the advanced publishers on `key_expr`; messages of each come in order and without a gap.

    `on_loss` hears how many messages of a publisher could not be recovered.
    """

    def __init__(self, session: zenoh.Session, key_expr: str, on_message: OnMessage, on_loss: OnLoss) -> None:
        self._session = session
        self._on_message = on_message
        self._on_loss = on_loss
        self._lock = threading.Lock()
        self._sources: dict[str, _Source] = {}
        subscriber = zenoh.ext.declare_advanced_subscriber(
            session,
            key_expr,
            self._on_sample,
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=CACHE_SAMPLES),
            recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
        )
        self._declared: list[Any] = [subscriber]

    def close(self) -> None:
        """See `Handle.close`."""
        while self._declared:
            self._declared.pop().undeclare()

    def _on_sample(self, sample: zenoh.Sample) -> None:
        info = sample.source_info
        if info is None:
            self._deliver(sample)
            return
        identity = f"{info.source_id.zid}/{info.source_id.eid}"
        with self._lock:
            source = self._sources.get(identity)
            if source is None:
                source = self._sources[identity] = _Source(f"{sample.key_expr}/@adv/pub/{identity}/*")
            if source.held is not None:
                source.held.append(sample)
                return
            self._take(source, [sample])
            gap = source.held is not None
        if gap:
            self._recall(source)

    def _take(self, source: _Source, samples: list[zenoh.Sample]) -> None:
        """Deliver samples up to the first gap; what stands behind it is held. The lock is held."""
        for at, sample in enumerate(samples):
            number = _number(sample)
            due = 0 if source.next is None else source.next
            if number > due:
                source.held = samples[at:]
                return
            if number == due:
                self._deliver(sample)
                source.next = number + 1

    def _recall(self, source: _Source) -> None:
        """Ask a publisher's cache for what it sent before the first sample that is held."""
        assert source.held is not None
        first = 0 if source.next is None else source.next
        last = _number(source.held[0]) - 1
        source.recalls += 1

        def on_reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None and reply.ok.source_info is not None and first <= _number(reply.ok) <= last:
                source.found[_number(reply.ok)] = reply.ok

        def on_all() -> None:
            with self._lock:
                self._settle(source, first, last)
                again = source.held is not None
            if again and self._declared:
                self._recall(source)

        self._session.get(
            f"{source.cache}?_max={CACHE_SAMPLES};_sn={first}..{last}",
            zenoh.handlers.Callback(on_reply, on_all),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            accept_replies=zenoh.ReplyKeyExpr.ANY,
            timeout=_RECALL_TIMEOUT_S,
        )

    def _settle(self, source: _Source, first: int, last: int) -> None:
        """Deliver what the cache said, and what was held behind the gap, unless the gap is to be asked for again."""
        found = sorted(source.found)
        # What a source sent before it was first heard may be older than its cache reaches: that is no loss.
        begin = first if source.next is not None else (found[0] if found else last + 1)
        missing = last + 1 - begin - len(found)
        if missing and source.recalls < _RECALLS:
            return
        for number in found:
            self._deliver(source.found[number])
        source.found.clear()
        source.recalls = 0
        source.next = last + 1
        if missing:
            self._on_loss(missing)
        held, source.held = source.held or [], None
        self._take(source, held)

    def _deliver(self, sample: Any) -> None:
        self._on_message(str(sample.key_expr), sample.payload.to_bytes())


def _number(sample: Any) -> int:
    return int(sample.source_info.source_sn)
