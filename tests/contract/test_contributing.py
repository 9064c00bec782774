"""What CONTRIBUTING.md and the recipes name exists; the list of files with four joints is complete."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = "".join((ROOT / name).read_text(encoding="utf-8") for name in ("CONTRIBUTING.md", "docs/recipes.md"))
PACKAGES = {path.name: path.parent for path in [*ROOT.glob("*/hilrig_*"), *ROOT.glob("*/*/hilrig_*")]}
TERMS = set(re.findall(r"`([^`\n]+)`", PAGE))
FOUR_JOINTS = re.compile(
    r"Vector4|\(4,\)|\(\(?4, (?:[a-zN]|8)|range\(4\)|theta4|[θτ]4|tau4|4[hf]\b|X4\b|[!=]= 4\b|\bJOINTS\b.* 4\b"
    r"|(?:bytes|bytearray)\(8\)|0\.0, 0\.0, 0\.0, 0\.0|count=4\b|zeros\(4\)|\bjoint \+ 4\b"
)
NOT_JOINTS = re.compile(r"quaternion|rgba|figsize|len\((?:parts|request)\)", re.IGNORECASE)


def place(name: str) -> Path:
    """Return the file or folder of a name in these pages."""
    return PACKAGES.get(name.partition("/")[0], ROOT) / name


def test_named_files_exist() -> None:
    names = {term for term in TERMS if re.fullmatch(r"[\w./*-]+", term) and ("/" in term or term.endswith(".md"))}
    assert len(names) > 40
    assert [name for name in sorted(names) if not list(ROOT.glob(str(place(name).relative_to(ROOT))))] == []


def test_named_tests_exist() -> None:
    text = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "tests").rglob("test_*.py"))
    names = {term for term in TERMS if re.fullmatch(r"test_\w+", term)}
    assert len(names) > 20
    assert [name for name in sorted(names) if f"def {name}(" not in text] == []


def test_named_targets_and_identifiers_exist() -> None:
    targets = {term.removeprefix("make ") for term in TERMS if term.startswith("make ")}
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert {
        target for target in targets if not re.search(rf"^{target}:|:.* {target}\b", makefile, re.MULTILINE)
    } == set()
    folders = ("schemas", "runtime", "services", "tools", "tests")
    sources = [path for folder in folders for path in (ROOT / folder).rglob("*.py")]
    words = {word for path in sources for word in re.findall(r"\w+", path.read_text(encoding="utf-8"))}
    identifiers = {
        part
        for term in TERMS
        if re.fullmatch(r"[A-Za-z_.]+=?", term) and not (ROOT / term).exists()
        for part in re.findall(r"\w+", term)
    }
    assert identifiers - words == set()


def test_robot_recipe_lists_every_file_with_four_joints() -> None:
    recipe = PAGE.partition("\n## Another robot")[2].partition("\n## ")[0]
    listed = {place(term) for term in re.findall(r"`([\w./-]+)`", recipe)}
    sources = [
        path
        for folder in ("schemas", "runtime", "services", "tools", "examples")
        for path in (ROOT / folder).rglob("*.*")
        if path.suffix in (".py", ".proto", ".js", ".c", ".st") and not path.stem.endswith("_pb2")
    ]
    found = {
        path
        for path in sources
        if any(
            FOUR_JOINTS.search(line) and not NOT_JOINTS.search(line)
            for line in path.read_text(encoding="utf-8").splitlines()
        )
    }
    assert len(found) > 30
    assert {str(path.relative_to(ROOT)) for path in found - listed} == set()
