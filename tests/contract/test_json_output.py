"""The JSON output of the commands: every command has a published schema, and each version keeps its fields."""

import ast
import copy
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

import generate_json_schemas as generator
from hilrig_cli.json_output import catalog
from hilrig_cli.main import app
from support.json_output import command_of

ROOT = Path(__file__).parents[2]
FILES = sorted(generator.FOLDER.iterdir())


def commands(group: Any, *names: str) -> Iterator[tuple[str, Any]]:
    """Yield the names and the definition of each command below a group."""
    for name, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands(command, *names, name)
        else:
            yield " ".join((*names, name)), command


def objects(schema: Any) -> Iterator[dict[str, Any]]:
    """Yield each schema of an object with named fields."""
    if isinstance(schema, dict):
        if "properties" in schema:
            yield schema
        for value in schema.values():
            yield from objects(value)
    elif isinstance(schema, list):
        for value in schema:
            yield from objects(value)


def test_every_command_with_json_has_a_schema() -> None:
    found = {
        name for name, command in commands(get_command(app)) if any("--json" in one.opts for one in command.params)
    }
    assert len(found) > 20
    assert found == set(catalog.OUTPUTS)


def test_every_json_output_is_checked_in_a_run() -> None:
    # `hilrig` and `hilrig_in_process` compare each JSON output with its published schema.
    checked = set()
    for path in (ROOT / "tests").rglob("test_*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") in ("hilrig", "hilrig_in_process"):
                arguments = [str(one.value) for one in node.args if isinstance(one, ast.Constant)]
                if "--json" in arguments:
                    checked.add(command_of(arguments))
    assert checked == set(catalog.OUTPUTS)


def test_published_schemas_and_page_are_up_to_date() -> None:
    written = generator.schemas()
    assert sorted(written) == FILES
    assert [path.name for path, text in written.items() if path.read_text(encoding="utf-8") != text] == []
    assert generator.PAGE.read_text(encoding="utf-8") == generator.page()


@pytest.mark.parametrize("file", FILES, ids=lambda path: path.name.removesuffix(".schema.json"))
def test_schema_allows_no_other_fields(file: Path) -> None:
    from jsonschema import Draft202012Validator

    schema = json.loads(file.read_text(encoding="utf-8"))
    Draft202012Validator.check_schema(schema)
    assert schema["properties"]["schema"]["const"] == schema["$id"]
    for found in objects(schema):
        assert found["additionalProperties"] is False, found
        # Every key is always present: a reader needs no default.
        assert set(found["required"]) == set(found["properties"]), found


def test_removed_or_changed_field_needs_a_new_version() -> None:
    old = json.loads((generator.FOLDER / "hilrig.latency-1.schema.json").read_text(encoding="utf-8"))
    new = copy.deepcopy(old)
    new["properties"]["added"] = {"type": "string"}
    new["properties"]["rig"]["description"] = "Another text."
    assert generator.broken_fields(old, new) == []
    del new["$defs"]["Statistics"]["properties"]["p95"]
    new["properties"]["samples"] = {"type": "string"}
    assert generator.broken_fields(old, new) == ["samples", "Statistics.p95"]
