"""Writes the schemas of the JSON outputs, docs/json/, and their page, docs/json-output.md; run by `make gen`."""

import json
import re
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, Final

from hilrig_cli.json_output import catalog
from hilrig_runtime.config.types import Section

ROOT: Final = Path(__file__).parents[1]
FOLDER: Final = ROOT / "docs/json"
PAGE: Final = ROOT / "docs/json-output.md"

FORMS: Final = {
    "object": "one object",
    "array": "an array of objects",
    "object or array": "one object for one rig, otherwise an array",
    "lines": "one object in each line",
}
UNITS: Final = {
    "ms": "ms",
    "ns": "ns",
    "s": "s",
    "mm": "mm",
    "m": "m",
    "deg": "°",
    "j": "J",
    "mib": "MiB",
    "percent": "%",
    "share": "0 to 1",
}
"""Unit by the last part of a field's name, of fields with a number."""
INTRODUCTION: Final = """# JSON output

With `--json` a command prints JSON on standard output, in ASCII, and nothing else; messages and errors are on standard
error. Every object has the key `schema` with the name and the version of its schema. A later release of hilrig may add
keys to a version; a key that is removed or renamed, or whose type or meaning changes, needs a new version. NaN and
infinity do not occur: a value that does not exist is null. Exit codes are the same as without `--json`.

The schemas are JSON Schema, draft 2020-12, in `docs/json/`. This page is generated from them by `make gen`.
"""


def schemas() -> dict[Path, str]:
    """Return the text of each schema file by its path."""
    return {
        FOLDER / catalog.file_name(model): json.dumps(catalog.json_schema(model), indent=1, ensure_ascii=False) + "\n"
        for model in catalog.models()
    }


def page() -> str:
    """Return the text of the page."""
    lines = [INTRODUCTION, "\n| command | prints | schema |\n|---|---|---|\n"]
    for command, output in catalog.OUTPUTS.items():
        names = ", ".join(
            f"[`{catalog.schema_name(model)}`](json/{catalog.file_name(model)})" for model in output.models
        )
        lines.append(f"| `hilrig {command}` | {FORMS[output.form]} | {names} |\n")
    for model in catalog.models():
        schema = catalog.json_schema(model)
        lines.append(f"\n## {catalog.schema_name(model)}\n\n{_text(schema)}\n\n{_table(schema)}")
    lines.append("\n## Types\n\nObjects within the outputs. Those of a configuration file are described there:\n")
    lines.append("[lab.toml](configuration.md), [studies](studies.md).\n")
    for name, schema in sorted(_types().items()):
        if _is_described(name, schema):
            lines.append(f"\n### {name}\n\n{_text(schema)}\n\n{_table(schema)}")
    return "".join(lines)


def _table(schema: dict[str, Any]) -> str:
    rows = ["| field | type | unit | description |\n|---|---|---|---|\n"]
    for name, field in schema["properties"].items():
        if name == "schema":
            continue
        kind = _kind(field)
        unit = UNITS.get(name.rpartition("_")[2], "") if _is_number(field) and "_" in name else ""
        rows.append(f"| `{name}` | {kind} | {unit} | {_text(field)} |\n")
    return "".join(rows)


def _text(schema: dict[str, Any]) -> str:
    text = " ".join(schema.get("description", "").partition("\n\n")[0].split())
    # The descriptions of the types that the analysis uses call null None, as Python does.
    return re.sub(r"\bNone\b", "null", text).replace("|", "\\|")


def _kind(field: dict[str, Any]) -> str:
    """Return the type of a field as text."""
    if "anyOf" in field:
        return " or ".join(dict.fromkeys(map(_kind, field["anyOf"])))
    if "oneOf" in field:
        return "object"
    if "$ref" in field:
        name = field["$ref"].rpartition("/")[2]
        known = _types().get(name, {"type": "object"})
        return f"[{name}](#{name.lower()})" if _is_described(name, known) else str(known.get("type", "object"))
    match field.get("type"):
        case "array" if "prefixItems" in field:
            inner = ", ".join(dict.fromkeys(map(_kind, field["prefixItems"])))
            return f"array of {len(field['prefixItems'])}: {inner}"
        case "array":
            return f"array: {_kind(field.get('items', {}))}"
        case "object":
            values = field.get("additionalProperties")
            return f"object: {_kind(values)}" if isinstance(values, dict) else "object"
        case str(kind):
            return kind
    return "any"


@cache
def _types() -> dict[str, Any]:
    """Return the schema of each type within the outputs, by its name."""
    found: dict[str, Any] = {}
    for model in catalog.models():
        found |= catalog.json_schema(model).get("$defs", {})
    return found


def _is_number(field: dict[str, Any]) -> bool:
    """Whether the values of a field, or those in it, are numbers."""
    if field.get("type") in ("number", "integer") or field.get("$ref", "").endswith("/Statistics"):
        return True
    inner = [
        *field.get("anyOf", ()),
        *field.get("prefixItems", ()),
        field.get("items"),
        field.get("additionalProperties"),
    ]
    return any(isinstance(one, dict) and _is_number(one) for one in inner)


def _is_described(name: str, schema: dict[str, Any]) -> bool:
    return schema.get("type") == "object" and name not in _config_types()


@cache
def _config_types() -> frozenset[str]:
    """Return the names of the types that are tables of a configuration file."""

    def below(base: type[Section]) -> Iterator[str]:
        for one in base.__subclasses__():
            yield one.__name__
            yield from below(one)

    return frozenset(below(Section))


def broken_fields(old: dict[str, Any], new: dict[str, Any]) -> list[str]:
    """Return the fields of a published schema that a new schema of the same version lacks, or has with other types."""
    fields, present = _fields(old), _fields(new)
    return [name for name, field in fields.items() if present.get(name) != field]


def _fields(schema: dict[str, Any]) -> dict[str, str]:
    """Return the type of each field of a schema and of its types; limits and descriptions may change."""
    types = {"": schema} | schema.get("$defs", {})
    return {
        f"{kind}.{name}".removeprefix("."): _kind(field)
        for kind, one in types.items()
        for name, field in one.get("properties", {}).items()
    }


def main() -> int:
    """Write all files; remove the schemas of removed outputs. Exit code 1: a version would lose a field."""
    FOLDER.mkdir(exist_ok=True)
    found = schemas()
    for path, text in found.items():
        old = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
        if broken := broken_fields(old, json.loads(text)):
            print(
                f"{path.name}: removed, or of another type: {', '.join(broken)}; give the model the next version",
                file=sys.stderr,
            )
            return 1
    for path in set(FOLDER.iterdir()) - set(found):
        path.unlink()
    for path, text in found.items():
        path.write_text(text, encoding="utf-8")
    PAGE.write_text(page(), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
