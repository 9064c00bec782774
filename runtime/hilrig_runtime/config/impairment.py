"""The `[impairment]` section of `lab.toml`: emulated delay and loss on the state link and the command link.

A delay is a string, `"gamma:20,8"` (the kind, then its numbers in ms, in the order of its fields), or a table,
`{ kind = "gamma", mean_ms = 20, std_ms = 8 }`; a loss likewise. The edge samples from these distributions.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import BeforeValidator, Field, model_validator

from hilrig_runtime.config.types import NotNegative, Section
from hilrig_runtime.config.validation import read_text
from hilrig_runtime.errors import InputError

MAX_DELAY_MS: Final = 10_000.0
"""Longest delay, ms; a mistyped unit is detected here."""

Milliseconds = Annotated[float, Field(ge=0, le=MAX_DELAY_MS, allow_inf_nan=False)]
PositiveMilliseconds = Annotated[float, Field(gt=0, le=MAX_DELAY_MS, allow_inf_nan=False)]
Fraction = Annotated[float, Field(ge=0, le=1)]


class _Kind(Section):
    """Base of the kinds of delay and of loss: `kind`, then its numbers in the order of the string form."""

    kind: str

    def describe(self) -> str:
        """Return a human-readable description."""
        values = [f"{name.removesuffix('_ms').replace('_', ' ')} {value}" for name, value in self._values()]
        return " ".join((self.kind, ", ".join(values))).strip()

    def _values(self) -> list[tuple[str, str]]:
        fields = type(self).model_fields
        named = [(name, getattr(self, name)) for name, field in fields.items() if name != "kind"]
        # Default values are omitted.
        changed = [(name, value) for name, value in named if value != fields[name].default]
        return [(name, f"{value:g} ms" if name.endswith("_ms") else f"{value:g}") for name, value in changed]


class ConstantDelay(_Kind):
    """Constant delay."""

    kind: Literal["constant"] = "constant"
    delay_ms: Milliseconds = 0.0


class UniformDelay(_Kind):
    """Uniform between two limits."""

    kind: Literal["uniform"] = "uniform"
    low_ms: Milliseconds
    high_ms: Milliseconds

    @model_validator(mode="after")
    def _in_order(self) -> "UniformDelay":
        if self.low_ms > self.high_ms:
            raise ValueError(f"low_ms must be ≤ high_ms, got {self.low_ms:g} and {self.high_ms:g}")
        return self


class NormalDelay(_Kind):
    """Normal, truncated at zero: a negative sample is drawn again."""

    kind: Literal["normal"] = "normal"
    mean_ms: Milliseconds
    """Mean of the normal distribution before truncation."""
    std_ms: Milliseconds


class GammaDelay(_Kind):
    """Gamma: a peak and a tail to the right, as caused by queues; shape (mean/std)², scale std²/mean."""

    kind: Literal["gamma"] = "gamma"
    mean_ms: PositiveMilliseconds
    """Mean of the delay on top of the offset."""
    std_ms: PositiveMilliseconds
    offset_ms: Milliseconds = 0.0
    """Delay of every message, added to the random part."""


class ExponentialDelay(_Kind):
    """Exponential: mostly short delays, occasionally a long one."""

    kind: Literal["exponential"] = "exponential"
    mean_ms: PositiveMilliseconds
    """Mean of the delay on top of the offset."""
    offset_ms: Milliseconds = 0.0
    """Delay of every message, added to the random part."""


class TraceDelay(_Kind):
    """Measured delays, replayed in their order and repeated from the start."""

    kind: Literal["trace"] = "trace"
    delays_ms: Annotated[tuple[Milliseconds, ...], Field(min_length=1, max_length=1_000_000)]

    def _values(self) -> list[tuple[str, str]]:
        mean_ms = sum(self.delays_ms) / len(self.delays_ms)
        return [("of", f"{len(self.delays_ms)} delays"), ("mean", f"{mean_ms:.3g} ms")]


class NoLoss(_Kind):
    """Every message arrives."""

    kind: Literal["none"] = "none"


class BernoulliLoss(_Kind):
    """Each message is lost with the same probability, independently of the one before."""

    kind: Literal["bernoulli"] = "bernoulli"
    rate: Fraction


class GilbertElliottLoss(_Kind):
    """Losses in bursts: a channel is good or bad, and changes its state with a probability at each message.

    Gilbert 1960, Elliott 1963. By default a bad channel loses every message: bursts of 1 / to_good messages on average.
    """

    kind: Literal["gilbert"] = "gilbert"
    to_bad: Fraction
    """Probability that a good channel is bad at the next message."""
    to_good: Annotated[float, Field(gt=0, le=1)]
    """Probability that a bad channel is good at the next message."""
    rate_bad: Fraction = 1.0
    """Loss rate of a bad channel."""
    rate_good: Fraction = 0.0
    """Loss rate of a good channel."""


_DELAYS: Final = (ConstantDelay, UniformDelay, NormalDelay, GammaDelay, ExponentialDelay, TraceDelay)
_LOSSES: Final = (NoLoss, BernoulliLoss, GilbertElliottLoss)


def _from_text(quantity: str, kinds: Sequence[type[_Kind]]) -> BeforeValidator:
    known = {kind.model_fields["kind"].default: kind for kind in kinds}

    def read(value: Any) -> Any:
        if not isinstance(value, str):
            return value
        name, _, rest = value.partition(":")
        kind = known.get(name.strip())
        if kind is None:
            raise ValueError(f"unknown {quantity} {name.strip()!r}; must be one of {', '.join(known)}")
        if kind is TraceDelay:
            return {"kind": "trace", "delays_ms": read_trace(Path(rest))}
        numbers = [number.strip() for number in rest.split(",")] if rest.strip() else []
        fields = {key: field for key, field in kind.model_fields.items() if key != "kind"}
        needed = sum(field.is_required() for field in fields.values())
        if not needed <= len(numbers) <= len(fields):
            names = ", ".join(key if field.is_required() else f"[{key}]" for key, field in fields.items())
            raise ValueError(f"{name} needs {names or 'no numbers'}, got {value!r}")
        return {"kind": name.strip(), **dict(zip(fields, numbers, strict=False))}

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
    """Read the delays of a text file, one per line, ms; lines that begin with # are comments.

    Raises:
        ValueError: the file can't be read, or a line is not a delay: a trace has no gaps.
    """
    try:
        lines = read_text(path).splitlines()
    except InputError as error:
        raise ValueError(f"trace {error}") from error
    delays = []
    for number, line in enumerate(lines, 1):
        if line.startswith("#"):
            continue
        try:
            delay_ms = float(line)
        except ValueError:
            delay_ms = -1.0
        if not 0 <= delay_ms <= MAX_DELAY_MS:
            raise ValueError(
                f"trace {path}, line {number}: must be a delay from 0 to {MAX_DELAY_MS:g} ms, got {line!r}"
            )
        delays.append(delay_ms)
    if not delays:
        raise ValueError(f"trace {path}: contains no delay")
    return tuple(delays)


class LinkImpairment(Section):
    """Delay and loss of the messages on one link; a string sets the delay only."""

    delay: Delay = ConstantDelay()
    loss: Loss = NoLoss()

    @model_validator(mode="before")
    @classmethod
    def _text_is_its_delay(cls, value: Any) -> Any:
        return {"delay": value} if isinstance(value, str) else value

    @property
    def is_inactive(self) -> bool:
        """Whether every message passes without delay and loss."""
        return self.delay == ConstantDelay() and self.loss == NoLoss()

    def describe(self) -> str:
        """Return a human-readable description."""
        if self.is_inactive:
            return "none"
        parts = [] if self.delay == ConstantDelay() else [self.delay.describe()]
        if self.loss != NoLoss():
            parts.append(f"loss {self.loss.describe()}")
        return ", ".join(parts)


class LinkImpairments(Section):
    """Impairments of both links of a rig's loop."""

    state: LinkImpairment = LinkImpairment()
    """From the simulation to the controller."""
    command: LinkImpairment = LinkImpairment()
    """From the controller to the simulation."""

    @property
    def is_inactive(self) -> bool:
        """Whether neither link is impaired."""
        return self.state.is_inactive and self.command.is_inactive

    def describe(self) -> str:
        """Return a human-readable description."""
        if self.is_inactive:
            return "none"
        return f"state link {self.state.describe()}; command link {self.command.describe()}"


def _both(delay: Delay, loss: Loss = NoLoss()) -> LinkImpairments:  # noqa: B008
    link = LinkImpairment(delay=delay, loss=loss)
    return LinkImpairments(state=link, command=link)


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
    # At a step of 20 ms a fast controller's command waits up to a step for the tick; with 5 to 80 ms more, the loop
    # latency is that of the paper.
    "paper-25-100ms": LinkImpairments(command=LinkImpairment(delay=UniformDelay(low_ms=5.0, high_ms=80.0))),
}
"""Typical networks, by name; delays are one-way."""


def _check_preset(preset: str) -> str:
    if preset not in PRESETS:
        raise ValueError(f"unknown preset {preset!r}; must be one of {', '.join(PRESETS)}")
    return preset


class ImpairmentSetting(Section):
    """Impairments of both links: a preset, and optionally other values for a link."""

    preset: Annotated[str, BeforeValidator(_check_preset)] = "none"
    """none, wired, busy-wifi, vpn, mobile or paper-25-100ms."""
    state: LinkImpairment | None = None
    """State link, as "gamma:20,8" or { delay = "gamma:20,8", loss = "bernoulli:0.01" }; default: the preset's."""
    command: LinkImpairment | None = None
    """Command link; default: the preset's."""

    @property
    def links(self) -> LinkImpairments:
        """The resulting impairments of both links."""
        preset = PRESETS[self.preset]
        return LinkImpairments(state=self.state or preset.state, command=self.command or preset.command)


class ScheduledImpairment(ImpairmentSetting):
    """A setting that becomes active during a session."""

    at_s: NotNegative
    """Time from the session's start, s."""


class ImpairmentConfig(ImpairmentSetting):
    """Emulated network delay and loss, for latency studies (docs/impairment.md)."""

    seed: Annotated[int, Field(ge=0, lt=2**63)] = 1
    """The same seed gives the same delays and losses, message by message, in each session."""
    schedule: tuple[ScheduledImpairment, ...] = ()
    """Settings that become active later in a session: { at_s = 30, preset = "vpn" }."""

    def describe(self) -> str:
        """Return a human-readable description; "none": not impaired."""
        settings = [
            self.links.describe(),
            *(f"at {entry.at_s:g} s {entry.links.describe()}" for entry in self.schedule),
        ]
        return ", then ".join(settings)

    @model_validator(mode="after")
    def _schedule_is_ordered(self) -> "ImpairmentConfig":
        for before, after in zip(self.schedule, self.schedule[1:], strict=False):
            if after.at_s <= before.at_s:
                raise ValueError(f"schedule: at_s must increase, got {after.at_s:g} after {before.at_s:g}")
        return self
