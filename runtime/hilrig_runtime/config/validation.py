"""Reads and validates configuration; each error is a plain sentence with the place of the value."""

import difflib
import reprlib
import tomllib
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeVar, get_args

from pydantic import ValidationError

from hilrig_runtime.config.types import PATTERN_DESCRIPTIONS, Section, TableForm
from hilrig_runtime.errors import InputError, first_errors

SectionT = TypeVar("SectionT", bound=Section)

MAX_TEXT_BYTES: Final = 8 << 20
"""Largest text file that is read. A lab of 500 rigs has 0.1 MB, with a recorded delay trace in it 1 MB."""

_BOUNDS: Final = {"greater_than_equal": "≥", "greater_than": ">", "less_than_equal": "≤", "less_than": "<"}
_CONTEXT_KEYS: Final = {"greater_than_equal": "ge", "greater_than": "gt", "less_than_equal": "le", "less_than": "lt"}
_EXPECTED: Final = {
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "int_type": "an integer",
    "int_parsing": "an integer",
    "int_from_float": "an integer",
    "float_type": "a number",
    "float_parsing": "a number",
    "finite_number": "a finite number",
    "string_type": "a string",
    "path_type": "a path",
    "tuple_type": "a list",
    "list_type": "a list",
    "dict_type": "a table",
    "model_type": "a table",
    "model_attributes_type": "a table",
}
"""pydantic's type of error → the value that is accepted."""
_REPR: Final = reprlib.Repr()
_REPR.maxstring = _REPR.maxother = 80


def read_text(path: Path) -> str:
    """Read a text file of at most `MAX_TEXT_BYTES`.

    Raises:
        InputError: the file can't be read, or is too large.
    """
    try:
        with path.open("rb") as file:
            content = file.read(MAX_TEXT_BYTES + 1)
        if len(content) > MAX_TEXT_BYTES:
            raise InputError(f"{path}: can't be read: larger than {MAX_TEXT_BYTES >> 20} MiB")
        return content.decode("utf-8").replace("\r\n", "\n").replace("\r", "\n")
    except FileNotFoundError:
        raise InputError(f"{path}: no such file") from None
    except IsADirectoryError:
        raise InputError(f"{path}: expected a file, found a folder") from None
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text; save it as UTF-8"
        raise InputError(f"{path}: can't be read: {reason}") from error


MAX_KEY_PARTS: Final = 200
"""Maximum number of parts of a dotted key."""


def parse_toml(text: str, where: str) -> dict[str, Any]:
    """Parse TOML; `where` is the name of the file in messages.

    Raises:
        InputError: the text is not TOML, too long or nested too deeply.
    """
    if len(text) > MAX_TEXT_BYTES:
        raise InputError(f"{where}: invalid TOML: longer than {MAX_TEXT_BYTES >> 20} MiB")
    # tomllib needs memory that grows with the square of the parts of a dotted key.
    parts = (part for line in text.splitlines() for part in line.split("="))
    if any(part.count(".") > MAX_KEY_PARTS and "," not in part for part in parts):
        raise InputError(f"{where}: invalid TOML: nested too deeply; a key has more than {MAX_KEY_PARTS} parts")
    try:
        return tomllib.loads(text)
    except RecursionError as error:
        raise InputError(f"{where}: invalid TOML: nested too deeply; expected at most some hundred levels") from error
    except ValueError as error:
        # Also an integer with thousands of digits.
        raise InputError(f"{where}: invalid TOML: {error}") from error


def validate(model: type[SectionT], values: dict[str, Any], where: str = "") -> SectionT:
    """Return the table with these values; `where` is the name of the file in messages.

    Raises:
        InputError: a value is invalid; lists the first errors.
    """
    try:
        return model.model_validate(values)
    except ValidationError as error:
        prefix = f"{where}: " if where else ""
        raise InputError(
            "\n".join(f"{prefix}{line}" for text in format_validation_error(error) for line in text.splitlines())
        ) from error


def format_validation_error(error: ValidationError) -> list[str]:
    """Return one sentence for each of the first invalid values, with its place, and the number of the others."""
    return first_errors(_causes(error), _sentence)


def _causes(error: ValidationError) -> list[Any]:
    """Return the details of all errors, except of a list that is too short only because an item of it is invalid."""
    details = list(_flatten(error, ()))

    places = Counter(detail["loc"][:end] for detail in details for end in range(len(detail["loc"]) + 1))

    def is_consequence(detail: Any) -> bool:
        return detail["type"] == "too_short" and places[detail["loc"]] > 1

    return [detail for detail in details if not is_consequence(detail)]


def _flatten(error: ValidationError, place: tuple[str | int, ...]) -> Iterator[Any]:
    """Yield the details of each error with its full place; errors of a nested validation are inside one of these."""
    for detail in error.errors():
        here: dict[str, Any] = {**detail, "loc": (*place, *detail["loc"])}
        cause = detail.get("ctx", {}).get("error")
        if isinstance(cause, ValidationError):
            yield from _flatten(cause, here["loc"])
        else:
            if detail["type"] == "extra_forbidden":
                here["keys"] = partial(_known_keys, error.title, detail["loc"][:-1])
            yield here


def _known_keys(model: str, place: tuple[str | int, ...]) -> list[str]:
    """Return the keys of the table at a place inside the model of that name."""
    tables = [one for one in _all_subclasses(Section) if one.__name__ == model]
    for part, following in zip(place, (*place, None)[1:], strict=True):
        fields = [one.model_fields[part] for one in tables if part in one.model_fields]
        forms = [mark.section for field in fields for mark in field.metadata if isinstance(mark, TableForm)]
        if forms and not isinstance(following, int):
            tables = forms
        elif fields:
            tables = [table for field in fields for table in _tables_in(field.annotation)]
        else:
            # The place of a union's member names its kind; an index names the item of a list.
            chosen = [one for one in tables if "kind" in one.model_fields and one.model_fields["kind"].default == part]
            tables = chosen or tables
    return sorted({key for one in tables for key in one.model_fields})


def _all_subclasses(base: type[Section]) -> Iterator[type[Section]]:
    for one in base.__subclasses__():
        yield one
        yield from _all_subclasses(one)


def _tables_in(annotation: Any) -> Iterator[type[Section]]:
    if isinstance(annotation, type) and issubclass(annotation, Section):
        yield annotation
    for argument in get_args(annotation):
        yield from _tables_in(argument)


def _sentence(detail: Any) -> str:
    place = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in detail["loc"]).lstrip(".")
    text = _text(detail)
    return f"{place}: {text}" if place else text


def _text(detail: Any) -> str:
    kind, context = detail["type"], detail.get("ctx", {})
    got = _REPR.repr(detail["input"])
    match kind:
        case "extra_forbidden":
            return _unknown_key(str(detail["loc"][-1]), detail["keys"]())
        case "missing":
            return "is missing"
        case "value_error":
            return str(context["error"])
        case "string_pattern_mismatch":
            return f"must be {PATTERN_DESCRIPTIONS[context['pattern']]}, got {got}"
        case "literal_error":
            return f"must be {context['expected']}, got {got}"
        case "union_tag_invalid":
            return f"kind must be one of {context['expected_tags']}, got {context['tag']!r}"
        case "union_tag_not_found":
            return "the key kind is missing"
        case "too_short" | "too_long":
            bound = f"at least {context['min_length']}" if kind == "too_short" else f"at most {context['max_length']}"
            return f"must have {bound} items, got {context['actual_length']}"
        case "string_too_long":
            return f"must have at most {context['max_length']} characters, got {len(detail['input'])}"
    if kind in _BOUNDS:
        bound = context[_CONTEXT_KEYS[kind]]
        return f"must be {_BOUNDS[kind]} {f'{bound:g}' if isinstance(bound, float) else bound}, got {got}"
    if kind in _EXPECTED:
        return f"must be {_EXPECTED[kind]}, got {got}"
    return f"{detail['msg']}, got {got}"


def _unknown_key(key: str, known: list[str]) -> str:
    near = difflib.get_close_matches(key, known, n=1)
    if near:
        return f"unknown key, did you mean {near[0]}?"
    return f"unknown key; known keys are {', '.join(known)}" if known else "unknown key"
