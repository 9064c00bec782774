"""One place for the layout of MCAP records, and one for the names of recording files."""

import ast
import re
from dataclasses import fields
from functools import cache
from pathlib import Path

import pytest

from hilrig_recorder.ingest.recording import LossCounters
from hilrig_recorder.mcap_format.ending import Ending

ROOT = Path(__file__).parents[2]
FORMAT = ROOT / "services/recorder/hilrig_recorder/mcap_format"
SOURCES = [
    path
    for folder in ("schemas", "runtime", "services", "tools")
    for path in sorted((ROOT / folder).rglob("*.py"))
    if not path.stem.endswith("_pb2")
]
SUFFIX = re.compile(r"(?<!hilrig)\.(mcap|part|recovering|recovered|damaged)(?![a-z_])")
LIBRARY = {"mcap.data_stream", "mcap.stream_reader", "mcap.writer"}


@cache
def parsed(source: str) -> ast.Module:
    return ast.parse(source)


def literals(source: str) -> list[tuple[int, str]]:
    """Line and text of the string literals, without docstrings."""
    tree = parsed(source)
    ignored = {
        id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    }
    return [
        (node.lineno, node.value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in ignored
    ]


def imports(source: str) -> set[str]:
    """Modules that a source imports."""
    found: set[str] = set()
    for node in ast.walk(parsed(source)):
        if isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
        elif isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
    return found


@pytest.mark.parametrize("text", ['"x.mcap"', 'f"*/*{a}.part"', '"a" + ".recovering"'])
def test_suffix_literals_are_found(text: str) -> None:
    assert any(SUFFIX.search(value) for _, value in literals(f"x = {text}"))


def test_suffixes_of_recordings_are_in_one_module() -> None:
    found = [
        f"{path.relative_to(ROOT)}:{line}: {value!r}"
        for path in SOURCES
        # The example commands of main.py name files of users.
        if path not in (FORMAT / "file_names.py", ROOT / "tools/cli/hilrig_cli/main.py")
        and SUFFIX.search(path.read_text())
        for line, value in literals(path.read_text())
        if SUFFIX.search(value)
    ]
    assert not found, "use mcap_format/file_names.py"


def test_layout_of_mcap_records_is_in_one_module() -> None:
    found = {
        str(path.relative_to(ROOT)): modules
        for path in SOURCES
        if path != FORMAT / "records.py"
        and (modules := imports(path.read_text()) & (LIBRARY | ({"struct"} if path.parent == FORMAT else set())))
    }
    assert not found, "use mcap_format/records.py and mcap_format/reader.py"


def test_name_parts_are_documented() -> None:
    from hilrig_recorder.mcap_format.file_names import NAME_PARTS, NAME_TEMPLATE

    page = (ROOT / "docs/recordings.md").read_text()
    section = page.partition("## File names")[2].partition("\n## ")[0]
    rows = dict(re.findall(r"^\| `([^|]*)` \| (.*) \|$", section, re.MULTILINE))
    assert rows == NAME_PARTS
    assert f"`{NAME_TEMPLATE}`" in page


def test_size_of_chunks_is_documented() -> None:
    from hilrig_recorder.mcap_format.chunk import CHUNK_BYTES

    assert f"in chunks of at most {CHUNK_BYTES // 1024} KiB" in (ROOT / "docs/recordings.md").read_text()


def test_recordings_page_has_the_causes_and_the_counters() -> None:
    page = (ROOT / "docs/recordings.md").read_text(encoding="utf-8")
    section = page.partition("## Completeness")[2].partition("## ")[0]
    counters, causes = (
        [name for row in re.findall(r"^\| (`.*?) \|", table, re.MULTILINE) for name in re.findall("`(.+?)`", row)]
        for table in section.split("| `ended` | cause")
    )
    assert counters == [*(field.name for field in fields(LossCounters)), "messages"]
    assert causes == list(Ending)
