"""The `[impairment]` of a lab: delay and loss that are added on purpose, on the state's way and on the command's.

A delay is written as people say it, `"gamma:20,8"` (the kind, then its numbers in ms, in the order of its fields), or
as a table, `{ kind = "gamma", mean_ms = 20, std_ms = 8 }`; a loss likewise. Drawing from it is the edge's work.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import BeforeValidator, Field, model_validator

from hilrig_runtime.config.types import NotNegative, Section

LONGEST_MS: Final = 10_000.0
"""A loop that is slower than this is no loop; a mistyped unit is found here."""

Milliseconds = Annotated[float, Field(ge=0, le=LONGEST_MS, allow_inf_nan=False)]
SomeMilliseconds = Annotated[float, Field(gt=0, le=LONGEST_MS, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0, le=1)]


class _Kind(Section):
    """Base of the kinds of delay and of loss: `kind`, then its numbers in the order in which a text gives them."""

    kind: str

    def describe(self) -> str:
        """In words, for people."""
        said = [f"{name.removesuffix('_ms').replace('_', ' ')} {value}" for name, value in self._said()]
        return " ".join((self.kind, ", ".join(said))).strip()

    def _said(self) -> list[tuple[str, str]]:
        fields = type(self).model_fields
        named = [(name, getattr(self, name)) for name, field in fields.items() if name != "kind"]
        # What is as usual is not said.
        said = [(name, value) for name, value in named if value != fields[name].default]
        return [(name, f"{value:g} ms" if name.endswith("_ms") else f"{value:g}") for name, value in said]


class ConstantDelay(_Kind):
    """Always the same."""

    kind: Literal["constant"] = "constant"
    delay_ms: Milliseconds = 0.0


class UniformDelay(_Kind):
    """Anything between two limits, alike."""

    kind: Literal["uniform"] = "uniform"
    low_ms: Milliseconds
    high_ms: Milliseconds

    @model_validator(mode="after")
    def _in_order(self) -> "UniformDelay":
        if self.low_ms > self.high_ms:
            raise ValueError(f"low_ms {self.low_ms:g} is above high_ms {self.high_ms:g}")
        return self


class NormalDelay(_Kind):
    """Normal, truncated at zero: what would be negative is drawn again."""

    kind: Literal["normal"] = "normal"
    mean_ms: Milliseconds
    """Of the normal distribution before it is truncated."""
    std_ms: Milliseconds


class GammaDelay(_Kind):
    """Gamma: a peak and a tail to the right, as queues make it; shape (mean/std)², scale std²/mean."""

    kind: Literal["gamma"] = "gamma"
    mean_ms: SomeMilliseconds
    """Of what comes on top of the offset."""
    std_ms: SomeMilliseconds
    offset_ms: Milliseconds = 0.0
    """What every message takes."""


class ExponentialDelay(_Kind):
    """Exponential: mostly short, now and then long."""

    kind: Literal["exponential"] = "exponential"
    mean_ms: SomeMilliseconds
    """Of what comes on top of the offset."""
    offset_ms: Milliseconds = 0.0
    """What every message takes."""


class TraceDelay(_Kind):
    """Delays that were measured, one after the other in their order, over and over."""

    kind: Literal["trace"] = "trace"
    delays_ms: Annotated[tuple[Milliseconds, ...], Field(min_length=1, max_length=1_000_000)]

    def _said(self) -> list[tuple[str, str]]:
        mean_ms = sum(self.delays_ms) / len(self.delays_ms)
        return [("of", f"{len(self.delays_ms)} delays"), ("mean", f"{mean_ms:.3g} ms")]


class NoLoss(_Kind):
    """Every message arrives."""

    kind: Literal["none"] = "none"


class BernoulliLoss(_Kind):
    """Each message is lost with the same probability, whatever became of the one before."""

    kind: Literal["bernoulli"] = "bernoulli"
    rate: Share


class GilbertElliottLoss(_Kind):
    """Losses in bursts: a channel that is good or bad, and changes with a probability at each message.

    Gilbert 1960, Elliott 1963. With the defaults a bad channel loses all: bursts of 1 / to_good messages on average.
    """

    kind: Literal["gilbert"] = "gilbert"
    to_bad: Share
    """Probability that a good channel has turned bad at the next message."""
    to_good: Annotated[float, Field(gt=0, le=1)]
    """Probability that a bad one has recovered."""
    rate_bad: Share = 1.0
    """Share that a bad channel loses."""
    rate_good: Share = 0.0
    """Share that a good one loses."""


_DELAYS: Final = (ConstantDelay, UniformDelay, NormalDelay, GammaDelay, ExponentialDelay, TraceDelay)
_LOSSES: Final = (NoLoss, BernoulliLoss, GilbertElliottLoss)


def _from_text(what: str, kinds: Sequence[type[_Kind]]) -> BeforeValidator:
    known = {kind.model_fields["kind"].default: kind for kind in kinds}

    def read(value: Any) -> Any:
        if not isinstance(value, str):
            return value
        name, _, rest = value.partition(":")
        kind = known.get(name.strip())
        if kind is None:
            raise ValueError(f"no {what} is called {name.strip()!r}: expected one of {', '.join(known)}")
        if kind is TraceDelay:
            return {"kind": "trace", "delays_ms": read_trace(Path(rest))}
        words = [word.strip() for word in rest.split(",")] if rest.strip() else []
        fields = {key: field for key, field in kind.model_fields.items() if key != "kind"}
        needed = sum(field.is_required() for field in fields.values())
        if not needed <= len(words) <= len(fields):
            names = ", ".join(key if field.is_required() else f"[{key}]" for key, field in fields.items())
            raise ValueError(f"{name} takes {names or 'no numbers'}, found {value!r}")
        return {"kind": name.strip(), **dict(zip(fields, words, strict=False))}

    return BeforeValidator(read)


Delay = Annotated[
    Annotated[
        ConstantDelay | UniformDelay | NormalDelay | GammaDelay | ExponentialDelay | TraceDelay,
        Field(discriminator="kind"),
    ],
    _from_text("delay", _DELAYS),
]
Loss = Annotated[
    Annotated[NoLoss | BernoulliLoss | GilbertElliottLoss, Field(discriminator="kind")], _from_text("loss", _LOSSES)
]


def read_trace(path: Path) -> tuple[float, ...]:
    """The delays of a text file, one a line, ms; lines that begin with # are comments.

    Raises:
        ValueError: it can't be read, or a line is no delay: a trace has no gaps.
    """
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
        raise ValueError(f"trace {path}: can't be read: {reason}") from error
    delays = []
    for number, line in enumerate(lines, 1):
        if line.startswith("#"):
            continue
        try:
            delay_ms = float(line)
        except ValueError:
            delay_ms = -1.0
        if not 0 <= delay_ms <= LONGEST_MS:
            raise ValueError(
                f"trace {path}, line {number}: expected a delay from 0 to {LONGEST_MS:g} ms, found {line!r}"
            )
        delays.append(delay_ms)
    if not delays:
        raise ValueError(f"trace {path}: there is no delay in it")
    return tuple(delays)


class LinkImpairment(Section):
    """What one way does to the messages on it; a text alone is its delay."""

    delay: Delay = ConstantDelay()
    loss: Loss = NoLoss()

    @model_validator(mode="before")
    @classmethod
    def _text_is_its_delay(cls, value: Any) -> Any:
        return {"delay": value} if isinstance(value, str) else value

    @property
    def is_inactive(self) -> bool:
        """Whether every message passes at once."""
        return self.delay == ConstantDelay() and self.loss == NoLoss()

    def describe(self) -> str:
        """In words, for people."""
        if self.is_inactive:
            return "none"
        words = [] if self.delay == ConstantDelay() else [self.delay.describe()]
        if self.loss != NoLoss():
            words.append(f"loss {self.loss.describe()}")
        return ", ".join(words)


class LinkImpairments(Section):
    """Both ways of a rig's loop."""

    state: LinkImpairment = LinkImpairment()
    """From the simulation to the controller."""
    command: LinkImpairment = LinkImpairment()
    """From the controller to the simulation."""

    @property
    def is_inactive(self) -> bool:
        """Whether the loop is as it is."""
        return self.state.is_inactive and self.command.is_inactive

    def describe(self) -> str:
        """In words, for people."""
        if self.is_inactive:
            return "none"
        return f"state link {self.state.describe()}; command link {self.command.describe()}"


def _both(delay: Delay, loss: Loss = NoLoss()) -> LinkImpairments:  # noqa: B008
    way = LinkImpairment(delay=delay, loss=loss)
    return LinkImpairments(state=way, command=way)


PRESETS: Final[dict[str, LinkImpairments]] = {
    "none": LinkImpairments(),
    "wired": _both(GammaDelay(mean_ms=0.2, std_ms=0.1, offset_ms=0.1)),
    "busy-wifi": _both(
        GammaDelay(mean_ms=8.0, std_ms=8.0, offset_ms=2.0), GilbertElliottLoss(to_bad=0.005, to_good=0.5)
    ),
    "vpn": _both(GammaDelay(mean_ms=3.0, std_ms=2.0, offset_ms=15.0), BernoulliLoss(rate=0.001)),
    "mobile": _both(
        GammaDelay(mean_ms=15.0, std_ms=12.0, offset_ms=20.0), GilbertElliottLoss(to_bad=0.002, to_good=0.3)
    ),
    # A quick controller at a step of 20 ms waits up to a step for the tick: 5 to 80 ms on top make the paper's loop.
    "paper-25-100ms": LinkImpairments(command=LinkImpairment(delay=UniformDelay(low_ms=5.0, high_ms=80.0))),
}
"""What labs have, by name; delays are one way."""


def _known(preset: str) -> str:
    if preset not in PRESETS:
        raise ValueError(f"no preset is called {preset!r}: expected one of {', '.join(PRESETS)}")
    return preset


class ImpairmentSetting(Section):
    """A setting of both ways: a preset, and what is said of a way instead."""

    preset: Annotated[str, BeforeValidator(_known)] = "none"
    """none, wired, busy-wifi, vpn, mobile or paper-25-100ms."""
    state: LinkImpairment | None = None
    """The state's way, as "gamma:20,8" or { delay = "gamma:20,8", loss = "bernoulli:0.01" }; default: the preset's."""
    command: LinkImpairment | None = None
    """The command's way; default: the preset's."""

    @property
    def links(self) -> LinkImpairments:
        """What is in force on both ways."""
        preset = PRESETS[self.preset]
        return LinkImpairments(state=self.state or preset.state, command=self.command or preset.command)


class ScheduledImpairment(ImpairmentSetting):
    """A setting that comes into force while a session goes on."""

    at_s: NotNegative
    """Time from the session's start, s."""


class ImpairmentConfig(ImpairmentSetting):
    """Delay and loss that are added on purpose, for latency studies (docs/studies.md)."""

    seed: Annotated[int, Field(ge=0, lt=2**63)] = 1
    """The same seed gives the same delays and losses, message by message, in each session."""
    schedule: tuple[ScheduledImpairment, ...] = ()
    """Settings that follow in the course of a session: { at_s = 30, preset = "vpn" }."""

    def describe(self) -> str:
        """In words, for people; "none" where the loop is as it is."""
        words = [self.links.describe(), *(f"at {entry.at_s:g} s {entry.links.describe()}" for entry in self.schedule)]
        return ", then ".join(words)

    @model_validator(mode="after")
    def _schedule_goes_on(self) -> "ImpairmentConfig":
        for before, after in zip(self.schedule, self.schedule[1:], strict=False):
            if after.at_s <= before.at_s:
                raise ValueError(f"schedule: at_s {after.at_s:g} stands after {before.at_s:g}: put them in order")
        return self
