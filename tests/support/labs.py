"""Complete labs for tests: `hilrig up` on free ports in a temporary folder, and `hilrig` commands."""

import os
import random
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from types import TracebackType
from typing import Self

from support.hilrig_process import HILRIG, ForkedPopen
from support.json_output import check_json_output
from support.waiting import eventually

PORTS = range(10_000, 32_000)
"""Below the ports that the system gives to outgoing connections: those of other tests could take a port that is probed
now and used by a lab later."""


def free_ports(count: int) -> int:
    """First of `count` consecutive ports that are free on loopback."""
    while True:
        first = random.SystemRandom().choice(PORTS)
        try:
            for port in range(first, first + count):
                with closing(socket.socket()) as probe:
                    probe.bind(("127.0.0.1", port))
        except OSError:
            continue
        return first


def hilrig(
    *arguments: str | Path, cwd: Path | None = None, timeout_s: float = 120.0
) -> subprocess.CompletedProcess[str]:
    """Run a `hilrig` command in a process that is forked from a server with the modules already imported.

    The output of a command with `--json` is checked against its published schema.
    tests/rig/test_documentation.py tests commands in new Python processes.
    """
    command = list(map(str, arguments))
    with TemporaryDirectory() as folder:
        paths = [Path(folder) / name for name in ("out", "err")]
        with paths[0].open("w") as out, paths[1].open("w") as err:
            process = ForkedPopen([*HILRIG, *command], stdin=subprocess.DEVNULL, stdout=out, stderr=err, cwd=cwd)
        try:
            code = process.wait(timeout_s)
        except BaseException:
            process.kill()
            process.wait()
            raise
        done = subprocess.CompletedProcess(command, code, *(path.read_text() for path in paths))
    if "--json" in command and code in (0, 1):
        check_json_output(command, done.stdout)
    return done


def write_lab(folder: Path, *, rigs: int = 1, extra: str = "") -> Path:
    """Write a `lab.toml` with free ports, and recordings in `folder`; returns its path.

    Each line of `extra` has the form `edge.watchdog_ms = 300` and is added to its table.
    """
    tables: dict[str, list[str]] = {
        "edge": [f"first_port = {free_ports(rigs)}"],
        "bus": [f"first_port = {free_ports(3)}"],
        "recorder": [f"folder = '{folder / 'recordings'}'"],
    }
    for line in filter(None, map(str.strip, extra.splitlines())):
        table, _, setting = line.partition(".")
        tables.setdefault(table, []).append(setting)
    text = "".join(f"[{table}]\n" + "\n".join(lines) + "\n" for table, lines in tables.items())
    text += "".join(f'[[rigs]]\nname = "rig{number}"\n' for number in range(1, rigs + 1))
    path = folder / "lab.toml"
    path.write_text(text)
    return path


class RunningLab:
    """`hilrig up` with a lab file; a context manager that ends all processes on exit."""

    def __init__(self, config: Path, *options: str) -> None:
        from hilrig_runtime.config.lab import load_lab

        self.config = config
        self.options = options
        self.lab = load_lab(config)
        self.log = config.parent / "up.log"

    @property
    def port(self) -> int:
        """Modbus port of the first rig."""
        return self.lab.ports[self.lab.rigs[0].name]

    @property
    def recordings(self) -> list[Path]:
        """Finished recordings, oldest first."""
        return sorted(self.lab.recorder.folder.rglob("*.mcap"), key=lambda path: path.stat().st_mtime)

    def output(self) -> str:
        """Output of `up` and its services so far."""
        return self.log.read_text()

    def service_pid(self, name: str) -> int:
        """Process id of a service: the child of `up` that runs that command.

        Raises:
            LookupError: no such service is running.
        """
        for pid in self.service_pids():
            if name in _arguments(pid):
                return pid
        raise LookupError(name)

    def service_pids(self) -> list[int]:
        """Process ids of the services."""
        return [pid for pid in _children(self.process.pid) if "hilrig_cli" in _arguments(pid)]

    def stop(self, number: signal.Signals = signal.SIGTERM, *, timeout_s: float = 30.0) -> int:
        """Send a signal to `up` and wait until it exits; returns the exit code."""
        if self.process.poll() is None:
            self.process.send_signal(number)
        return self.process.wait(timeout_s)

    def __enter__(self) -> Self:
        with self.log.open("w") as log:
            # The lab ends with the test process, also if that is killed.
            command = [*HILRIG, "up", "--stop-with-parent", "--config", str(self.config), *self.options]
            self.process = ForkedPopen(
                command, stdin=subprocess.PIPE, stdout=log, stderr=log, cwd=self.config.parent, start_new_session=True
            )

        def up() -> bool:
            assert self.process.poll() is None, self.output()
            return "running; press Ctrl-C to stop" in self.output()

        try:
            eventually(up)
        except BaseException:
            self.__exit__(None, None, None)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.stop()
        except subprocess.TimeoutExpired:
            children = self.service_pids()
            self.process.kill()
            self.process.wait()
            for pid in children:
                os.kill(pid, signal.SIGKILL)
        if self.process.stdin is not None:
            self.process.stdin.close()


@contextmanager
def steady_controller(port: int) -> Iterator[None]:
    """Run a controller process that commands joint 1 fifty times per second."""
    program = Path(__file__).with_name("steady_controller.py")
    process = subprocess.Popen(
        [sys.executable, str(program), "127.0.0.1", str(port)], stdin=subprocess.PIPE, stdout=subprocess.DEVNULL
    )
    try:
        yield
    finally:
        process.communicate()


def _arguments(pid: int) -> list[str]:
    return Path(f"/proc/{pid}/cmdline").read_text().split("\0")


def _children(parent: int) -> list[int]:
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                stat = (entry / "stat").read_text()
            except OSError:
                continue
            # The name in parentheses may contain spaces; state and parent follow it.
            state, ppid = stat.rpartition(")")[2].split()[:2]
            if int(ppid) == parent and state != "Z":
                found.append(int(entry.name))
    return found
