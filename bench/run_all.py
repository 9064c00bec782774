"""Run every benchmark and write the tables of docs/performance.md."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
PAGE = HERE.parent / "docs" / "performance.md"
NOT_A_BENCHMARK = {"harness.py", "run_all.py", "soak.py", "stolen.py"}


def main() -> int:
    sections = []
    failed = []
    for path in sorted(HERE.glob("*.py")):
        if path.name in NOT_A_BENCHMARK:
            continue
        print(f"{path.name} …", file=sys.stderr, flush=True)
        done = subprocess.run([sys.executable, str(path), "--json"], check=False, stdout=subprocess.PIPE, timeout=900)
        if not done.stdout:
            print(f"{path.name} gave no figures (exit code {done.returncode})", file=sys.stderr)
            failed.append(path.name)
            continue
        sections.append(section(path.name, json.loads(done.stdout)))
        if done.returncode:
            failed.append(path.name)
    PAGE.write_text(HEADER + "\n".join(sections))
    print(f"wrote {PAGE}", file=sys.stderr)
    if failed:
        print(f"a bar does not hold, or figures are missing: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


HEADER = """# Performance

Written by `make bench`; each section is one file of `bench/`, measured in one run on the machine that it names, next
to a peer. Absolute figures belong to that machine; the ratios are what the project promises.
"""


def section(name: str, report: dict[str, Any]) -> str:
    about = report["machine"]
    libraries = ", ".join(f"{library} {version}" for library, version in about["libraries"].items())
    lines = [
        f"\n## {report['question']}",
        "",
        f"`python bench/{name}` on {about['processor']}, {about['cores']} cores, Python {about['python']};",
        f"{libraries}.",
        "",
        "| case | metric | value | unit |",
        "|---|---|---:|---|",
        *(f"| {r['case']} | {r['metric']} | {r['value']:,.4g} | {r['unit']} |" for r in report["results"]),
        "",
        "| promise | measured | bound | holds |",
        "|---|---:|---|---|",
        *(
            f"| {b['what']} | {b['value']:,.4g} | {b['bound']} | {'yes' if b['holds'] else '**no**'} |"
            for b in report["bars"]
        ),
        "",
        *(f"{note}\n" for note in report["notes"]),
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
