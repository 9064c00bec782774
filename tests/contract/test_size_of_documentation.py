"""Limits of the hand-written documentation: words of a page, and of all pages."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
GENERATED = {
    "docs/configuration.md",
    "docs/json-output.md",
    "docs/modbus-conformance.md",
    "docs/performance.md",
    "docs/registers.md",
}
"""Written by `make gen` and `make bench`."""
NOT_COUNTED = {"CHANGELOG.md", *(f"docs/project/{path.stem.lower()}.md" for path in ROOT.glob("*.md"))}
"""The changes of each release, and the titles of pages outside docs/ on the site."""
MAX_WORDS_OF_A_PAGE = 2_000
MAX_WORDS = 30_000
"""Of all pages."""


def words(page: str) -> int:
    """Return the number of words: tokens with a letter, outside code blocks."""
    text = (ROOT / page).read_text(encoding="utf-8")
    text = re.sub(r"^ *```.*?^ *```", "", text, flags=re.MULTILINE | re.DOTALL)
    return sum(re.search(r"[^\W\d_]", token) is not None for token in text.split())


def pages() -> dict[str, int]:
    found = {str(path.relative_to(ROOT)) for path in [*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md")]}
    assert found >= GENERATED | NOT_COUNTED
    return {page: words(page) for page in found - GENERATED - NOT_COUNTED}


def test_no_page_is_long() -> None:
    assert {page: count for page, count in pages().items() if count > MAX_WORDS_OF_A_PAGE} == {}


def test_documentation_is_short_as_a_whole() -> None:
    assert sum(pages().values()) <= MAX_WORDS
