"""A `lab.toml` with every key, its meaning and its default: what `hilrig check --template` prints.

Made from the models of `config`, so that it can't say anything else than they do.
"""

import ast
import inspect
import json
import textwrap
import types
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, Final, get_args

from pydantic.fields import FieldInfo

from hilrig_runtime.config.lab import LabConfig
from hilrig_runtime.config.types import Section

WIDTH: Final = 110


def lab_template() -> str:
    """The text of a lab's file in which every value is the default, explained; optional keys are commented out."""
    return "\n".join(_lines(LabConfig(), ())).strip() + "\n"


def _lines(section: Section, path: tuple[str, ...], *, explained: bool = True) -> Iterator[str]:
    meanings = _meanings(type(section))
    tables: list[tuple[str, Any]] = []
    for name, field in type(section).model_fields.items():
        value = getattr(section, name)
        if isinstance(value, Section) or (isinstance(value, tuple) and value and isinstance(value[0], Section)):
            tables.append((name, value))
            continue
        if explained:
            yield from _explanation(field, meanings.get(name, ""))
        yield f"# {name} =" if value is None else f"{name} = {_literal(value)}"
    for name, value in tables:
        field = type(section).model_fields[name]
        yield ""
        yield from _explanation(field, meanings.get(name, ""))
        here = (*path, name)
        if isinstance(value, Section):
            yield from _about(type(value))
            yield f"[{'.'.join(here)}]"
            yield from _lines(value, here)
        else:
            for number, item in enumerate(value):
                # The keys of an array's tables are explained once.
                first = number == 0
                yield from _about(type(item)) if first else [""]
                yield f"[[{'.'.join(here)}]]"
                yield from _lines(item, here, explained=first)


def _about(model: type[Section]) -> Iterator[str]:
    yield from _comment((model.__doc__ or "").strip().split("\n\n")[0])


def _meanings(model: type[Section]) -> dict[str, str]:
    """What stands below each key in the model's source; read here, for every process of a lab imports the models."""
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
    for line in textwrap.wrap(" ".join(text.replace("`", "").split()), WIDTH):
        yield f"# {line}"


def _choices(annotation: Any) -> list[str]:
    if isinstance(annotation, types.UnionType):
        return [choice for part in get_args(annotation) for choice in _choices(part)]
    options = get_args(annotation)
    return [json.dumps(option) for option in options] if options and all(isinstance(o, str) for o in options) else []


def _literal(value: Any) -> str:
    if isinstance(value, tuple):
        return f"[{', '.join(map(_literal, value))}]"
    if isinstance(value, Path):
        return json.dumps(str(value))
    return json.dumps(value)
