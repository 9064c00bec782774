"""What a person wrote wrong in a file or a request, as sentences: pydantic's findings, each with its place."""

from collections.abc import Iterator
from typing import Any

from pydantic import ValidationError

from hilrig_runtime.config.types import PATTERN_DESCRIPTIONS


def format_validation_error(error: ValidationError) -> list[str]:
    """A sentence for each mistake that a person made, with its place."""
    return [_sentence(mistake) for mistake in _causes(error)]


def _causes(error: ValidationError) -> list[Any]:
    """The mistakes, without the complaint that a list is too short for lack of an item that is itself mistaken."""
    mistakes = list(_flat(error, ()))

    def follows_from_another(mistake: Any) -> bool:
        place = mistake["loc"]
        inner = (other["loc"] for other in mistakes if other is not mistake)
        return mistake["type"] == "too_short" and any(loc[: len(place)] == place for loc in inner)

    return [mistake for mistake in mistakes if not follows_from_another(mistake)]


def _flat(error: ValidationError, place: tuple[str | int, ...]) -> Iterator[Any]:
    """Every mistake with its whole place; what a table's own validation found stands inside one of the lab's."""
    for mistake in error.errors():
        here: dict[str, Any] = {**mistake, "loc": (*place, *mistake["loc"])}
        cause = mistake.get("ctx", {}).get("error")
        if isinstance(cause, ValidationError):
            yield from _flat(cause, here["loc"])
        else:
            yield here


def _sentence(mistake: Any) -> str:
    place = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in mistake["loc"]).lstrip(".")
    if mistake["type"] == "extra_forbidden":
        return f"{place}: unknown key"
    if mistake["type"] == "missing":
        return f"{place}: is missing"
    if mistake["type"] == "value_error":
        return f"{place}: {mistake['ctx']['error']}" if place else str(mistake["ctx"]["error"])
    if mistake["type"] == "string_pattern_mismatch":
        expected = PATTERN_DESCRIPTIONS[mistake["ctx"]["pattern"]]
    else:
        expected = mistake["msg"].removeprefix("Input should be ").removeprefix("a valid ")
    return f"{place}: expected {expected}, found {mistake['input']!r}"
