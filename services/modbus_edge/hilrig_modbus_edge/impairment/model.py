"""Delays and losses drawn from what a lab says of a way: the live edge and the study draw from the same code.

Reproducible from the seed, whether drawn one by one or in blocks. Each message is drawn for by itself, as a network of
datagrams treats it: one that takes longer than its successor is overtaken by it, and what is overtaken is of no use to
control (`ways`). Pure numpy.
"""

import zlib
from collections.abc import Callable, Iterator
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from hilrig_runtime.config.impairment import (
    BernoulliLoss,
    ConstantDelay,
    Delay,
    ExponentialDelay,
    GammaDelay,
    GilbertElliottLoss,
    LinkImpairment,
    Loss,
    NormalDelay,
    TraceDelay,
    UniformDelay,
)

BLOCK: Final = 1024
"""Drawn at once; what is drawn does not depend on how it is asked for."""

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]


def way_seed(seed: int, rig: str, way: Literal["state", "command"]) -> np.random.SeedSequence:
    """The seed of one way of one rig: its stream is independent of all others of the same `seed`."""
    return np.random.SeedSequence(seed, spawn_key=(zlib.crc32(rig.encode()), int(way == "command")))


class Impairment:
    """The fates of the messages on one way, one after the other."""

    def __init__(self, config: LinkImpairment, seed: int | np.random.SeedSequence) -> None:
        # Delay and loss have a stream each: changing the loss leaves the delays as they are.
        root = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
        streams = [np.random.SeedSequence(root.entropy, spawn_key=(*root.spawn_key, part)) for part in range(2)]
        delays, losses = (np.random.Generator(np.random.PCG64(stream)) for stream in streams)
        self._delay_block = _delay_blocks(config.delay, delays)
        self._loss_block = _loss_blocks(config.loss, losses)
        self._delay_ns = np.empty(0, np.int64)
        self._lost = np.empty(0, np.bool_)

    def draw(self, n: int) -> tuple[NDArray[np.int64], Flags]:
        """The next `n` messages: delay, ns, shape (n,), and whether it is lost, shape (n,)."""
        missing = n - len(self._lost)
        if missing > 0:
            blocks = range(-(-missing // BLOCK))
            milliseconds = [self._delay_block() for _ in blocks]
            self._delay_ns = np.concatenate(
                (self._delay_ns, *(np.rint(ms * 1e6).astype(np.int64) for ms in milliseconds))
            )
            self._lost = np.concatenate((self._lost, *(self._loss_block() for _ in blocks)))
        delay_ns, self._delay_ns = self._delay_ns[:n], self._delay_ns[n:]
        lost, self._lost = self._lost[:n], self._lost[n:]
        return delay_ns, lost

    def each(self) -> Iterator[tuple[int, bool]]:
        """Message by message, without end: delay, ns, and whether it is lost."""
        while True:
            delay_ns, lost = self.draw(BLOCK)
            yield from zip(delay_ns.tolist(), lost.tolist(), strict=True)


def _delay_blocks(delay: Delay, rng: np.random.Generator) -> Callable[[], Floats]:
    """A function that gives the next block of delays, ms, shape (BLOCK,)."""
    match delay:
        case ConstantDelay():
            return lambda: np.full(BLOCK, delay.delay_ms)
        case UniformDelay():
            return lambda: rng.uniform(delay.low_ms, delay.high_ms, BLOCK)
        case NormalDelay():
            return lambda: _truncated(lambda: rng.normal(delay.mean_ms, delay.std_ms, BLOCK))
        case GammaDelay():
            shape, scale = (delay.mean_ms / delay.std_ms) ** 2, delay.std_ms**2 / delay.mean_ms
            return lambda: delay.offset_ms + rng.gamma(shape, scale, BLOCK)
        case ExponentialDelay():
            return lambda: delay.offset_ms + rng.exponential(delay.mean_ms, BLOCK)
        case TraceDelay():
            return _Trace(np.asarray(delay.delays_ms), int(rng.integers(len(delay.delays_ms))))


def _truncated(draw: Callable[[], Floats]) -> Floats:
    # The mean is not negative, so at least every second one is kept.
    kept = np.empty(0)
    while len(kept) < BLOCK:
        drawn = draw()
        kept = np.concatenate((kept, drawn[drawn >= 0]))
    return kept[:BLOCK]


class _Trace:
    """Goes round and round through measured delays; where it begins is drawn, so that rigs differ."""

    def __init__(self, delays_ms: Floats, start: int) -> None:
        self._delays_ms = delays_ms
        self._next = start

    def __call__(self) -> Floats:
        rows = (self._next + np.arange(BLOCK)) % len(self._delays_ms)
        self._next = (self._next + BLOCK) % len(self._delays_ms)
        return np.asarray(self._delays_ms[rows])


def _loss_blocks(loss: Loss, rng: np.random.Generator) -> Callable[[], Flags]:
    """A function that gives the next block of losses, shape (BLOCK,)."""
    match loss:
        case BernoulliLoss():
            return lambda: rng.random(BLOCK) < loss.rate
        case GilbertElliottLoss():
            return _GilbertElliott(loss, rng)
    return lambda: np.zeros(BLOCK, np.bool_)


class _GilbertElliott:
    """A channel that is good or bad; it begins as it is in the long run."""

    def __init__(self, loss: GilbertElliottLoss, rng: np.random.Generator) -> None:
        self._loss = loss
        self._rng = rng
        self._bad = bool(rng.random() < loss.to_bad / (loss.to_bad + loss.to_good))

    def __call__(self) -> Flags:
        loss, rng = self._loss, self._rng
        changes, losses = rng.random(BLOCK), rng.random(BLOCK)
        bad = np.empty(BLOCK, np.bool_)
        start = 0
        while start < BLOCK:
            # Up to the message at which the channel turns.
            turning = np.flatnonzero(changes[start:] < (loss.to_good if self._bad else loss.to_bad))
            end = start + int(turning[0]) if len(turning) else BLOCK
            bad[start:end] = self._bad
            if end < BLOCK:
                self._bad = not self._bad
                bad[end] = self._bad
            start = end + 1
        return losses < np.where(bad, loss.rate_bad, loss.rate_good)
