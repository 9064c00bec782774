"""The commands of `hilrig`: each module is registered, each command is documented, and none is slow to import."""

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

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


def test_top_level_has_at_most_36_commands() -> None:
    assert len(list(registered())) <= 36


def test_example_of_every_command_is_valid() -> None:
    from typer.main import get_command

    root = get_command(main.app)
    for name, example in main.EXAMPLES.items():
        command, arguments = root, example.partition(" >")[0].split()
        assert example.startswith(name)
        while hasattr(command, "commands"):
            command = command.commands[arguments.pop(0)]
        # Raises an error for an unknown option or a wrong value.
        command.make_context(name, arguments)
        assert example in (command.epilog or "")


def test_every_first_line_and_option_is_described() -> None:
    from typer.main import get_command

    def described(group: Any, prefix: str = "") -> Iterator[str]:
        for name, command in group.commands.items():
            if hasattr(command, "commands"):
                yield from described(command, f"{name} ")
                continue
            first = command.help.partition("\n\n")[0]
            assert first.endswith("."), name
            assert len(first) <= 130, name
            for param in command.params:
                assert param.name == "help" or param.help, (name, param.name)
                # A value that the option has without being given is shown.
                assert param.default in (None, "", False, True, ()) or param.show_default, (name, param.name)
            yield f"{prefix}{name}"

    assert set(described(get_command(main.app))) == set(main.EXAMPLES)


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
