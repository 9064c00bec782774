"""The commands of `hilrig`: each module is registered, each command is documented, and none is slow to import."""

import ast
import re
import sys
from pathlib import Path

from hilrig_cli import main
from support.extras import registered

ROOT = Path(__file__).parents[2]
MODULES = sorted((ROOT / "tools/cli/hilrig_cli/commands").glob("[a-z]*.py"))
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
PANELS = set(main.PANELS)


def test_every_module_is_registered() -> None:
    assert {module.rpartition(".")[2] for module, _, _ in registered()} == {path.stem for path in MODULES}
    assert {panel for _, _, panel in registered()} == PANELS


def test_every_command_is_documented() -> None:
    text = "".join(page.read_text(encoding="utf-8") for page in PAGES)
    assert [name for _, name, _ in registered() if not re.search(rf"\bhilrig {name}\b", text)] == []


def test_commands_import_their_implementation_when_run() -> None:
    # `hilrig --help` is fast, and a host with the dependencies of one service runs that service.
    allowed = sys.stdlib_module_names | {"typer", "hilrig_cli"}
    imported = {
        (path.stem, module)
        for path in MODULES
        for node in ast.parse(path.read_text(encoding="utf-8")).body
        for module in (
            [node.module or ""]
            if isinstance(node, ast.ImportFrom)
            else [alias.name for alias in node.names]
            if isinstance(node, ast.Import)
            else []
        )
    }
    assert {(stem, module) for stem, module in imported if module.partition(".")[0] not in allowed} == set()
