"""Forged recordings: every command ends with an exit code and a reason, in limited time and memory."""

import json
import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from support.forged import MEMORY_BYTES

COUNT = int(os.environ.get("HILRIG_FORGED_RECORDINGS", "100"))
SEED = int(os.environ.get("HILRIG_FORGED_SEED", "0"))


def limit_memory() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))


@pytest.mark.timeout(max(120, COUNT))
def test_commands_refuse_or_evaluate_forged_recordings(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "support.forged", str(tmp_path), str(COUNT), str(SEED)],
        capture_output=True,
        text=True,
        check=False,
        cwd=Path(__file__).parents[1],
        preexec_fn=limit_memory,
    )
    assert done.returncode == 0, done.stderr or f"ended by signal {-done.returncode}"
    *problems, memory = map(json.loads, done.stdout.splitlines())
    assert problems == []
    # Both peaks contain the libraries: the second one has the largest forged recording in addition.
    assert memory["after_kb"] <= 2 * memory["before_kb"]
