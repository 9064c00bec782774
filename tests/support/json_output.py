"""Checks the JSON output of a command against the published schemas, docs/json/."""

import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jsonschema import Draft202012Validator

FOLDER = Path(__file__).parents[2] / "docs/json"


def command_of(arguments: Sequence[str]) -> str:
    """Names of the command in its arguments: one, or two for a command of a group."""
    from hilrig_cli.json_output.catalog import OUTPUTS

    return next(name for name in (" ".join(arguments[:2]), arguments[0]) if name in OUTPUTS)


def check_json_output(arguments: Sequence[str], text: str) -> None:
    """Check that the output of a command has its form, and that each object is valid by the schema that it names."""
    from hilrig_cli.json_output.catalog import OUTPUTS, schema_name

    output = OUTPUTS[command_of(arguments)]
    lines = text.splitlines() if output.form == "lines" else [text]
    for line in lines:
        value = json.loads(line, parse_constant=_no_constant)
        form = "array" if isinstance(value, list) else "object"
        assert form in output.form or output.form == "lines", f"{arguments}: {form}, expected {output.form}"
        for one in value if isinstance(value, list) else [value]:
            assert one["schema"] in {schema_name(model) for model in output.models}, arguments
            mistakes = [
                f"{mistake.json_path}: {mistake.message}" for mistake in _validator(one["schema"]).iter_errors(one)
            ]
            assert mistakes == [], arguments


def _no_constant(name: str) -> Any:
    raise ValueError(f"{name} is not JSON")


@cache
def _validator(name: str) -> "Draft202012Validator":
    from jsonschema import Draft202012Validator

    schema = json.loads((FOLDER / f"{name.replace('/', '-')}.schema.json").read_text(encoding="utf-8"))
    return Draft202012Validator(schema)
