"""Every command module is a command of `hilrig`, and every command is documented."""

import importlib
import pkgutil
import re
from pathlib import Path

from typer.main import get_command

from hilrig_cli import commands
from hilrig_cli.main import app

ROOT = Path(__file__).parents[2]
NAMES = sorted(get_command(app).commands)  # type: ignore[attr-defined]


def test_every_module_is_registered() -> None:
    registered = {id(info.callback) for info in app.registered_commands}
    registered |= {id(info.typer_instance) for info in app.registered_groups}
    unregistered = [
        name
        for _, name, _ in pkgutil.iter_modules(commands.__path__)
        if registered.isdisjoint(map(id, vars(importlib.import_module(f"{commands.__name__}.{name}")).values()))
    ]
    assert unregistered == []


def test_every_command_is_documented() -> None:
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages)
    assert [name for name in NAMES if not re.search(rf"hilrig {name}\b", text)] == []
