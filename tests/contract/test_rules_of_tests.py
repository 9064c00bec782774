"""Rules of the tests themselves: a test waits for a condition, and a fixed wait has its reason beside it."""

import ast
from collections.abc import Iterator
from pathlib import Path

TESTS = Path(__file__).parents[1]


def fixed_sleeps(text: str) -> Iterator[int]:
    """Yield the line of each sleep of a fixed time that has no comment on its line or the line before.

    A time that is computed by a call, such as the rest of a period, is not fixed.
    """
    lines = ["", *text.splitlines()]
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Call) and ast.unparse(node.func) in ("time.sleep", "asyncio.sleep", "sleep"):
            (time_s,) = node.args
            computed = any(isinstance(part, ast.Call) for part in ast.walk(time_s))
            yields_only = isinstance(time_s, ast.Constant) and time_s.value == 0
            explained = "# " in lines[node.lineno] or lines[node.lineno - 1].lstrip().startswith("# ")
            if not (computed or yields_only or explained):
                yield node.lineno


def test_every_fixed_sleep_has_its_reason_beside_it() -> None:
    found = [
        f"{path.relative_to(TESTS)}:{line}"
        for path in sorted(TESTS.rglob("*.py"))
        for line in fixed_sleeps(path.read_text(encoding="utf-8"))
    ]
    assert found == [], "wait for the condition with `eventually`, or write the reason beside the sleep"


def test_sleep_without_reason_is_found() -> None:
    assert list(fixed_sleeps("import time\ntime.sleep(0.5)\ntime.sleep(max(0.0, due()))\n")) == [2]
    assert list(fixed_sleeps("time.sleep(0.5)  # the stop\n# the stop\nawait_ = time.sleep(0.5)\n")) == []
    assert list(fixed_sleeps("async def f():\n    await asyncio.sleep(wait_s)\n    await asyncio.sleep(0)\n")) == [2]
