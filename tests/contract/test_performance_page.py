"""docs/performance.md: its claims are those of the stored results."""

import importlib.util
import json
from pathlib import Path

BENCH = Path(__file__).parents[2] / "bench"


def test_page_has_the_claims_of_the_stored_results() -> None:
    spec = importlib.util.spec_from_file_location("run_all", BENCH / "run_all.py")
    assert spec is not None
    assert spec.loader is not None
    run_all = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(run_all)
    reports = {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in sorted(BENCH.glob("results/*.json"))}
    assert {f"{name}.py" for name in reports} <= {path.name for path in BENCH.glob("*.py")}
    expected = run_all.HEADER + "".join(run_all.section(name, report) for name, report in reports.items())
    assert run_all.PAGE.read_text(encoding="utf-8") == expected
