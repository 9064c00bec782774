"""A complete stream out of zenoh's advanced subscriber: what a publisher sent before its first live message too.

The advanced subscriber recovers gaps, and fetches the history of the publishers that it finds. But when a publisher's
first live sample overtakes that history, as it does when a link comes up under load, the history is taken for old
and dropped. So the first sample of a source that does not begin at zero is held here, with all that follow it, until
the source's own cache has said what went before.
"""

import threading
from typing import Any, Final

import zenoh
import zenoh.ext

from hilrig_runtime.bus import Handle, OnLoss, OnMessage

CACHE_SAMPLES: Final = 500
"""What a publisher can repeat: 10 s at 50 batches a second."""
_RECALL_TIMEOUT_S: Final = 2.0


class CompleteStream(Handle):
    """Subscribes to the advanced publishers on `key_expr`; messages of each come in order and without a gap.

    `on_loss` hears how many messages of a publisher could not be recovered.
    """

    def __init__(self, session: zenoh.Session, key_expr: str, on_message: OnMessage, on_loss: OnLoss) -> None:
        self._session = session
        self._on_message = on_message
        self._lock = threading.Lock()
        self._known: set[str] = set()
        self._held: dict[str, list[zenoh.Sample]] = {}
        subscriber = zenoh.ext.declare_advanced_subscriber(
            session,
            key_expr,
            self._on_sample,
            history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=CACHE_SAMPLES),
            recovery=zenoh.ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
        )
        self._declared: list[Any] = [subscriber, subscriber.sample_miss_listener(lambda miss: on_loss(miss.nb))]

    def close(self) -> None:
        """See `Handle.close`."""
        while self._declared:
            self._declared.pop().undeclare()

    def _on_sample(self, sample: zenoh.Sample) -> None:
        info = sample.source_info
        if info is None:
            self._deliver(sample)
            return
        zid, eid = info.source_id.zid, info.source_id.eid
        source = f"{zid}/{eid}"
        with self._lock:
            held = self._held.get(source)
            if held is not None:
                held.append(sample)
                return
            if source in self._known or info.source_sn == 0:
                self._known.add(source)
                self._deliver(sample)
                return
            self._known.add(source)
            self._held[source] = [sample]
        self._recall(source, f"{sample.key_expr}/@adv/pub/{source}/*", info.source_sn)

    def _recall(self, source: str, cache: str, first: int) -> None:
        """Ask a publisher's cache for what it sent before its sample number `first`."""
        earlier: dict[int, zenoh.Sample] = {}

        def on_reply(reply: zenoh.Reply) -> None:
            if reply.ok is not None and reply.ok.source_info is not None and reply.ok.source_info.source_sn < first:
                earlier[reply.ok.source_info.source_sn] = reply.ok

        def on_all() -> None:
            with self._lock:
                for number in sorted(earlier):
                    self._deliver(earlier[number])
                for sample in self._held.pop(source):
                    self._deliver(sample)

        self._session.get(
            f"{cache}?_max={CACHE_SAMPLES}",
            zenoh.handlers.Callback(on_reply, on_all),
            target=zenoh.QueryTarget.ALL,
            consolidation=zenoh.ConsolidationMode.NONE,
            accept_replies=zenoh.ReplyKeyExpr.ANY,
            timeout=_RECALL_TIMEOUT_S,
        )

    def _deliver(self, sample: Any) -> None:
        self._on_message(str(sample.key_expr), sample.payload.to_bytes())
