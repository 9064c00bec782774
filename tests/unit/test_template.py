"""The template of `lab.toml` and the generated page agree with the models."""

import tomllib
from pathlib import Path

import generate_configuration
from hilrig_runtime.config.lab import LabConfig, parse_lab
from hilrig_runtime.config.template import lab_template
from hilrig_runtime.config.types import Section

DOCS = Path(__file__).parents[2] / "docs"


def test_template_is_the_default_lab() -> None:
    assert parse_lab(lab_template()).model_dump() == LabConfig().model_dump()


def test_template_contains_every_key() -> None:
    keys = {line.removeprefix("# ").partition(" =")[0] for line in lab_template().splitlines() if " =" in line}

    def check(section: Section) -> None:
        for name in type(section).model_fields:
            value = getattr(section, name)
            if isinstance(value, Section):
                check(value)
            elif isinstance(value, tuple) and value and isinstance(value[0], Section):
                check(value[0])
            else:
                assert name in keys

    check(LabConfig())


def test_page_is_up_to_date_and_examples_are_valid() -> None:
    text = (DOCS / "configuration.md").read_text()
    assert text == generate_configuration.page(), "run `make gen` and commit the result"
    examples = [block.partition("```")[0] for block in text.split("```toml\n")[1:]]
    assert len(examples) == 5
    assert [rig.name for rig in parse_lab(examples[1]).rigs] == ["left", "right"]
    assert len(parse_lab(examples[2]).rigs) == 65
    classroom, task = parse_lab(examples[3]).classroom, parse_lab(examples[4]).task
    assert classroom is not None
    assert classroom.claims == Path("claims")
    assert task is not None
    assert len(task.poses) == 2
    assert tomllib.loads(examples[0])
