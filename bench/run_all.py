"""Run every benchmark, or those that are named, and write their tables into docs/performance.md.

The sections of the others stay as they are: the whole takes most of an hour.
"""

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).parent
PAGE = HERE.parent / "docs" / "performance.md"
NOT_A_BENCHMARK = {"ablation.py", "harness.py", "modbus_servers.py", "run_all.py", "soak.py", "stolen.py"}
LONGEST_S = 1800


def main() -> int:
    known = [path.name for path in sorted(HERE.glob("*.py")) if path.name not in NOT_A_BENCHMARK]
    chosen = sys.argv[1:] or known
    if unknown := set(chosen) - set(known):
        print(f"no such benchmark: {', '.join(sorted(unknown))}; there are {', '.join(known)}", file=sys.stderr)
        return 2
    sections = sections_of(PAGE.read_text(encoding="utf-8"))
    failed = []
    for name in chosen:
        print(f"{name} …", file=sys.stderr, flush=True)
        command = [sys.executable, str(HERE / name), "--json"]
        done = subprocess.run(command, check=False, stdout=subprocess.PIPE, timeout=LONGEST_S)
        if not done.stdout:
            print(f"{name} gave no figures (exit code {done.returncode})", file=sys.stderr)
            failed.append(name)
            continue
        sections[name] = section(name, json.loads(done.stdout))
        write(sections)
        if done.returncode:
            failed.append(name)
    print(f"wrote {PAGE}", file=sys.stderr)
    if failed:
        print(f"a bar does not hold, or figures are missing: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


def sections_of(page: str) -> dict[str, str]:
    """The sections of the page by the name of their benchmark."""
    found = {}
    for text in re.split(r"^(?=## )", page, flags=re.MULTILINE)[1:]:
        name = re.search(r"`python bench/(\w+\.py)`", text)
        if name:
            found[name[1]] = "\n" + text.rstrip("\n") + "\n"
    return found


def write(sections: dict[str, str]) -> None:
    PAGE.write_text(HEADER + "".join(sections[name] for name in sorted(sections)), encoding="utf-8")


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
    return "\n".join(lines).rstrip("\n") + "\n"


if __name__ == "__main__":
    sys.exit(main())
