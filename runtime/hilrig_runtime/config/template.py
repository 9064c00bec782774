"""The `lab.toml` template with every key, its description and its default; `hilrig check --template` prints it.

Generated from the models of `config`, so that the two can't differ.
"""

import ast
import inspect
import json
import textwrap
import types
from collections.abc import Iterator
from itertools import pairwise
from typing import Any, Final, get_args

from pydantic.fields import FieldInfo

from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.config.types import Section

COMMENT_WIDTH: Final = 110


def lab_template() -> str:
    """Return a lab's file in which every key has its default and a description; optional keys are commented out."""
    return "\n".join(_lines(LabConfig(), ())).strip() + "\n"


def _lines(section: Section, path: tuple[str, ...], *, with_comments: bool = True) -> Iterator[str]:
    descriptions = _descriptions(type(section))
    tables: list[tuple[str, Any]] = []
    for name, field in type(section).model_fields.items():
        value = getattr(section, name)
        if isinstance(value, Section) or (isinstance(value, tuple) and value and isinstance(value[0], Section)):
            tables.append((name, value))
            continue
        if with_comments:
            yield from _explanation(field, descriptions.get(name, ""))
        yield f"# {name} =" if value is None else f"{name} = {toml_value(value)}"
    for name, value in tables:
        field = type(section).model_fields[name]
        yield ""
        yield from _explanation(field, descriptions.get(name, ""))
        here = (*path, name)
        if isinstance(value, Section):
            yield from _about(type(value))
            yield f"[{'.'.join(here)}]"
            yield from _lines(value, here)
        else:
            for number, item in enumerate(value):
                # The keys of an array's tables are described once.
                first = number == 0
                yield from _about(type(item)) if first else [""]
                yield f"[[{'.'.join(here)}]]"
                yield from _lines(item, here, with_comments=first)


def _about(model: type[Section]) -> Iterator[str]:
    yield from _comment((model.__doc__ or "").strip().split("\n\n")[0])


def _descriptions(model: type[Section]) -> dict[str, str]:
    """Return the docstring below each key of a model; read from the source only when the template is made."""
    found = {}
    for one in (one for one in reversed(model.__mro__) if issubclass(one, Section)):
        (definition,) = ast.parse(textwrap.dedent(inspect.getsource(one))).body
        assert isinstance(definition, ast.ClassDef)
        for key, below in pairwise(definition.body):
            match key, below:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(text))):
                    found[name] = text
    return found


def _explanation(field: FieldInfo, text: str) -> Iterator[str]:
    choices = _choices(field.annotation)
    if choices:
        text = f"{text} One of {', '.join(choices)}.".strip()
    yield from _comment(text)


def _comment(text: str) -> Iterator[str]:
    for line in textwrap.wrap(" ".join(text.replace("`", "").split()), COMMENT_WIDTH):
        yield f"# {line}"


def _choices(annotation: Any) -> list[str]:
    if isinstance(annotation, types.UnionType):
        return [choice for part in get_args(annotation) for choice in _choices(part)]
    options = get_args(annotation)
    return [json.dumps(option) for option in options] if options and all(isinstance(o, str) for o in options) else []


def toml_value(value: Any) -> str:
    """Return a number, text, path, sequence or dictionary as an inline TOML value."""
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {toml_value(item)}" for key, item in value.items()) + " }"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(toml_value, value))}]"
    return json.dumps(value, default=str)
