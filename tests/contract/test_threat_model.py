"""The threat model in docs/security.md: each row names the tests that show it, and they exist."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]


def test_each_row_names_existing_tests() -> None:
    page = (ROOT / "docs/security.md").read_text(encoding="utf-8")
    section = page.partition("\n## Threat model\n")[2].partition("\n## ")[0]
    table = [line for line in section.splitlines() if line.startswith("|")]
    assert table[0] == "| who | can | is prevented from | by | test |"
    existing = {path.name for path in (ROOT / "tests").rglob("test_*.py")}
    named = [set(re.findall(r"`(test_\w+\.py)`", row.rpartition("|")[0].rpartition("|")[2])) for row in table[2:]]
    assert len(named) > 5
    assert all(named)
    assert set.union(*named) - existing == set()
