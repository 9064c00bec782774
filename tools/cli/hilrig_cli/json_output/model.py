"""Base classes of the models, and the function that prints them."""

import json
from collections.abc import Sequence
from typing import Any

from pydantic import BaseModel, ConfigDict, Field
from pydantic_core import to_jsonable_python


class Values(BaseModel):
    """Base of every object within an output; a docstring below a field is its description."""

    # Built at the first use: a command without --json needs no model.
    model_config = ConfigDict(defer_build=True, extra="forbid", use_attribute_docstrings=True)


class JsonOutput(Values):
    """Base of the objects that a command prints.

    A model overrides `schema_id` with its own name and version.
    """

    schema_id: str = Field(alias="schema")
    """Name and version of the schema."""


def print_json(output: JsonOutput | Sequence[JsonOutput]) -> None:
    """Print an output, or several as an array, in one line of ASCII: no text in it controls a terminal."""
    plain = [_plain(one) for one in ((output,) if isinstance(output, JsonOutput) else output)]
    print(json.dumps(plain[0] if isinstance(output, JsonOutput) else plain, allow_nan=False), flush=True)


def _plain(output: JsonOutput) -> Any:
    """Return an output as JSON values; NaN and infinity are null, and a file name need not be valid UTF-8."""
    return to_jsonable_python(output.model_dump(mode="json", by_alias=True), inf_nan_mode="null")
