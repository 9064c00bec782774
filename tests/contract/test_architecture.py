"""ARCHITECTURE.md and the tree agree: each subpackage is described, and each described folder exists."""

import ast
import re
from collections import Counter
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
PACKAGES = {path.parent.name: path for path in sorted(ROOT.glob("*/hilrig_*")) + sorted(ROOT.glob("*/*/hilrig_*"))}
MAX_MODULES = 14
"""About a dozen modules a folder."""


def subpackages(package: Path) -> set[str]:
    return {path.parent.name for path in package.glob("*/__init__.py")}


def described() -> dict[str, set[str]]:
    rows: dict[str, set[str]] = {}
    package = ""
    for line in PAGE.partition("\n## Packages\n")[2].partition("\n## ")[0].splitlines():
        if match := re.match(r"\| (\w*) ?\| `(\w+)` \|", line):
            package = match[1] or package
            rows.setdefault(package, set()).add(match[2])
    return rows


def test_architecture_page_lists_every_subpackage() -> None:
    assert described() == {name: found for name, path in PACKAGES.items() if (found := subpackages(path))}


def test_architecture_page_names_existing_folders() -> None:
    folders = re.findall(r"`((?:tools|services|runtime|schemas|tests|scripts|bench|examples)[\w/]*/?)`", PAGE)
    assert folders
    assert [folder for folder in folders if not (ROOT / folder).is_dir()] == []


def test_subpackages_have_about_a_dozen_modules() -> None:
    counts = {
        str(folder.relative_to(ROOT)): len([path for path in folder.glob("*.py") if path.stem != "__init__"])
        for package in PACKAGES.values()
        for folder in [package, *(package / name for name in subpackages(package))]
        if folder.name not in ("commands", "v1")
    }
    assert {folder: count for folder, count in counts.items() if count > MAX_MODULES} == {}


def modules(package: Path) -> list[Path]:
    return [path for path in sorted(package.rglob("*.py")) if not path.stem.endswith("_pb2")]


def test_public_class_names_are_unique_in_the_product() -> None:
    defined: dict[str, list[str]] = {}
    for package in PACKAGES.values():
        for path in modules(package):
            for node in ast.parse(path.read_text(encoding="utf-8")).body:
                if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                    defined.setdefault(node.name, []).append(str(path.relative_to(ROOT)))
    assert {name: places for name, places in defined.items() if len(places) > 1} == {}


def test_module_names_are_unique_within_a_package() -> None:
    # The command of a library module has its name.
    exempt = {"__init__", "service", "errors"}
    found = {
        name: sorted(
            stem
            for stem, count in Counter(path.stem for path in modules(package) if path.parent.name != "commands").items()
            if count > 1 and stem not in exempt
        )
        for name, package in PACKAGES.items()
    }
    assert {name: stems for name, stems in found.items() if stems} == {}


def test_pymodbus_is_imported_by_the_edge_and_live_studies() -> None:
    users = {
        str(path.relative_to(package).parent)
        for package in PACKAGES.values()
        for path in modules(package)
        if re.search(r"^ *(from|import) pymodbus", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
    }
    assert users == {"protocol", "device", "classroom", "server", "client", "live"}


def test_test_names_have_at_most_sixty_characters() -> None:
    names = {
        name
        for path in (ROOT / "tests").rglob("test_*.py")
        for name in re.findall(r"^ *(?:async )?def (test_\w+)", path.read_text(encoding="utf-8"), flags=re.MULTILINE)
    }
    assert {name for name in names if len(name) > 60} == set()
