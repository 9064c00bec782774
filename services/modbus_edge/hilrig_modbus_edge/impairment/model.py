"""Random model of an impaired link: samples of delay and loss, shared by the live edge and the study.

The samples depend on the seed alone, not on the number of samples per call. Each message has its own sample, as in a
datagram network: a message may be delayed more than its successor, and is then dropped (`delay_line`).
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

SAMPLES_PER_BLOCK: Final = 1024
"""Number of samples that are generated at once."""

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]


def link_seed(seed: int, rig: str, link: Literal["state", "command"]) -> np.random.SeedSequence:
    """Return the seed of one link of one rig: its stream is independent of all other streams of the same `seed`."""
    return np.random.SeedSequence(seed, spawn_key=(zlib.crc32(rig.encode()), int(link == "command")))


class Impairment:
    """Sequence of delay and loss samples for the messages of one link."""

    def __init__(self, config: LinkImpairment, seed: int | np.random.SeedSequence) -> None:
        # Delay and loss have separate streams: a change of the loss model does not change the delays.
        root = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(seed)
        streams = [np.random.SeedSequence(root.entropy, spawn_key=(*root.spawn_key, part)) for part in range(2)]
        delays, losses = (np.random.Generator(np.random.PCG64(stream)) for stream in streams)
        self._delay_block = _delay_blocks(config.delay, delays)
        self._loss_block = _loss_blocks(config.loss, losses)
        self._delay_ns = np.empty(0, np.int64)
        self._lost = np.empty(0, np.bool_)

    def draw(self, n: int) -> tuple[NDArray[np.int64], Flags]:
        """Return the samples of the next `n` messages: delay, ns, shape (n,), and whether it is lost, shape (n,)."""
        missing = n - len(self._lost)
        if missing > 0:
            blocks = range(-(-missing // SAMPLES_PER_BLOCK))
            milliseconds = [self._delay_block() for _ in blocks]
            self._delay_ns = np.concatenate(
                (self._delay_ns, *(np.rint(ms * 1e6).astype(np.int64) for ms in milliseconds))
            )
            self._lost = np.concatenate((self._lost, *(self._loss_block() for _ in blocks)))
        delay_ns, self._delay_ns = self._delay_ns[:n], self._delay_ns[n:]
        lost, self._lost = self._lost[:n], self._lost[n:]
        return delay_ns, lost

    def samples(self) -> Iterator[tuple[int, bool]]:
        """Yield one sample per message, endlessly: delay, ns, and whether it is lost."""
        while True:
            delay_ns, lost = self.draw(SAMPLES_PER_BLOCK)
            yield from zip(delay_ns.tolist(), lost.tolist(), strict=True)


def _delay_blocks(delay: Delay, rng: np.random.Generator) -> Callable[[], Floats]:
    """Return a function that returns the next block of delays, ms, shape (SAMPLES_PER_BLOCK,)."""
    match delay:
        case ConstantDelay():
            return lambda: np.full(SAMPLES_PER_BLOCK, delay.delay_ms)
        case UniformDelay():
            return lambda: rng.uniform(delay.low_ms, delay.high_ms, SAMPLES_PER_BLOCK)
        case NormalDelay():
            return lambda: _truncated(lambda: rng.normal(delay.mean_ms, delay.std_ms, SAMPLES_PER_BLOCK))
        case GammaDelay():
            shape, scale = (delay.mean_ms / delay.std_ms) ** 2, delay.std_ms**2 / delay.mean_ms
            return lambda: delay.offset_ms + rng.gamma(shape, scale, SAMPLES_PER_BLOCK)
        case ExponentialDelay():
            return lambda: delay.offset_ms + rng.exponential(delay.mean_ms, SAMPLES_PER_BLOCK)
        case TraceDelay():
            return _Trace(np.asarray(delay.delays_ms), int(rng.integers(len(delay.delays_ms))))


def _truncated(draw: Callable[[], Floats]) -> Floats:
    # The mean is not negative, so at least half of the samples are kept.
    kept = np.empty(0)
    while len(kept) < SAMPLES_PER_BLOCK:
        drawn = draw()
        kept = np.concatenate((kept, drawn[drawn >= 0]))
    return kept[:SAMPLES_PER_BLOCK]


class _Trace:
    """Repeats measured delays cyclically; the start index is random, so that rigs differ."""

    def __init__(self, delays_ms: Floats, start: int) -> None:
        self._delays_ms = delays_ms
        self._next = start

    def __call__(self) -> Floats:
        rows = (self._next + np.arange(SAMPLES_PER_BLOCK)) % len(self._delays_ms)
        self._next = (self._next + SAMPLES_PER_BLOCK) % len(self._delays_ms)
        return np.asarray(self._delays_ms[rows])


def _loss_blocks(loss: Loss, rng: np.random.Generator) -> Callable[[], Flags]:
    """Return a function that returns the next block of losses, shape (SAMPLES_PER_BLOCK,)."""
    match loss:
        case BernoulliLoss():
            return lambda: rng.random(SAMPLES_PER_BLOCK) < loss.rate
        case GilbertElliottLoss():
            return _GilbertElliott(loss, rng)
    return lambda: np.zeros(SAMPLES_PER_BLOCK, np.bool_)


class _GilbertElliott:
    """Two-state (good, bad) loss model; the first state is drawn from the stationary distribution."""

    def __init__(self, loss: GilbertElliottLoss, rng: np.random.Generator) -> None:
        self._loss = loss
        self._rng = rng
        self._bad = bool(rng.random() < loss.to_bad / (loss.to_bad + loss.to_good))

    def __call__(self) -> Flags:
        loss, rng = self._loss, self._rng
        changes, losses = rng.random(SAMPLES_PER_BLOCK), rng.random(SAMPLES_PER_BLOCK)
        bad = np.empty(SAMPLES_PER_BLOCK, np.bool_)
        start = 0
        while start < SAMPLES_PER_BLOCK:
            # Up to the message at which the state changes.
            turning = np.flatnonzero(changes[start:] < (loss.to_good if self._bad else loss.to_bad))
            end = start + int(turning[0]) if len(turning) else SAMPLES_PER_BLOCK
            bad[start:end] = self._bad
            if end < SAMPLES_PER_BLOCK:
                self._bad = not self._bad
                bad[end] = self._bad
            start = end + 1
        return losses < np.where(bad, loss.rate_bad, loss.rate_good)
