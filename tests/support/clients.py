"""Third-party Modbus clients: mbpoll, and a C program on libmodbus."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
_KINDS = {"holding": "4", "coil": "0", "input": "3"}


def require_mbpoll() -> None:
    """Skip the test if mbpoll is not installed."""
    if shutil.which("mbpoll") is None:
        pytest.skip("needs mbpoll (Debian package mbpoll)")


def mbpoll_read(port: int, register: int, count: int, kind: str = "holding") -> list[int]:
    """Read registers or coils with mbpoll: numbers from 1, as usual for PLCs; signed values."""
    command = ["mbpoll", "-m", "tcp", "-p", str(port), "-a", "1", "-t", _KINDS[kind], "-1", "-q"]
    command += ["-r", str(register), "-c", str(count), "127.0.0.1"]
    output = subprocess.run(command, check=True, capture_output=True, text=True, timeout=10).stdout
    values = [int(match[1]) for match in re.finditer(r"^\[\d+\]:\s+(\d+)", output, re.MULTILINE)]
    assert len(values) == count, output
    return [value - 65536 if kind != "coil" and value > 32767 else value for value in values]


def mbpoll_write(port: int, register: int, value: int, kind: str = "holding") -> None:
    """Write one register or coil with mbpoll; numbers start at 1."""
    command = ["mbpoll", "-m", "tcp", "-p", str(port), "-a", "1", "-t", _KINDS[kind], "-1", "-q"]
    command += ["-r", str(register), "127.0.0.1", "--", str(value)]
    subprocess.run(command, check=True, capture_output=True, text=True, timeout=10)


def compile_with_libmodbus(source: Path, folder: Path) -> Path:
    """Compile a C program; returns its path. Skips the test if compiler or library are not installed."""
    if shutil.which("gcc") is None or shutil.which("pkg-config") is None:
        pytest.skip("needs gcc and pkg-config (Debian's packages of these names)")
    flags = subprocess.run(
        ["pkg-config", "--cflags", "--libs", "libmodbus"], check=False, capture_output=True, text=True
    )
    if flags.returncode:
        pytest.skip("needs libmodbus (Debian's package libmodbus-dev)")
    program = folder / source.stem
    warnings = ["-O2", "-Wall", "-Wextra", "-Werror"]
    subprocess.run(["gcc", *warnings, "-o", str(program), str(source), *flags.stdout.split(), "-lm"], check=True)
    return program


def build_c_client() -> Path:
    """Compile the benchmark's C controller, which uses libmodbus; returns its path."""
    sys.path.insert(0, str(ROOT / "bench"))
    from harness import MissingDependencyError, build_c

    try:
        return build_c("loop_client.c")
    except MissingDependencyError as error:
        pytest.skip(str(error))
    finally:
        sys.path.pop(0)
