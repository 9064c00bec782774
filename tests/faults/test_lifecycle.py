"""Shutdown of a process: first signal, second signal, end of its parent, closing timeout, crashed thread."""

import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from support.labs import free_ports
from support.waiting import LONG_TIMEOUT_S, eventually

SERVICE = """
import sys, threading, time
from hilrig_runtime.config.lab import BusConfig, LabConfig
from hilrig_runtime.errors import InputError, OperationError
from hilrig_runtime.process.shutdown import run_process
from hilrig_runtime.process.lifecycle import run_service

def orderly(service):
    service.ready()
    print("ready", flush=True)
    service.stopping.wait()
    print("closing", flush=True)

def ignoring_stop(service):
    service.ready()
    print("ready", flush=True)
    while True:
        time.sleep(0.1)

def failing(service):
    raise InputError("lab.toml: sim.step: unknown key")

def crashing_thread(service):
    service.ready()
    threading.Thread(target=lambda: 1 / 0, name="worker").start()
    service.stopping.wait()

def main():
    lab = LabConfig(bus=BusConfig(first_port={port}))
    run_service("sim", {run}, lab, stop_with_parent={parent}, close_timeout_s={timeout})
    print("ended", flush=True)

run_process(main)
"""


def start(
    tmp_path: Path, run: str, *, parent: bool = False, timeout: float = 5.0, ready: bool = True
) -> subprocess.Popen[str]:
    script = tmp_path / "service.py"
    script.write_text(textwrap.dedent(SERVICE).format(run=run, parent=parent, timeout=timeout, port=free_ports(3)))
    process = subprocess.Popen(
        [sys.executable, str(script)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    if ready:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
    return process


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_first_signal_stops_in_order(tmp_path: Path, number: signal.Signals) -> None:
    process = start(tmp_path, "orderly")
    process.send_signal(number)
    output, _ = process.communicate(timeout=10)
    assert output == "closing\nended\n"
    assert process.returncode == 0


def test_second_signal_forces_exit(tmp_path: Path) -> None:
    process = start(tmp_path, "ignoring_stop", timeout=60)
    process.terminate()

    def has_exited() -> bool:
        process.terminate()
        return process.poll() is not None

    eventually(has_exited)
    assert process.wait() == 128 + signal.SIGTERM
    process.communicate()


LOCKED = """
import os, signal
from hilrig_runtime.process.shutdown import stop_on_signals

stopping = stop_on_signals()
with stopping._cond:
    # `wait` holds this lock for a moment.
    os.kill(os.getpid(), signal.SIGTERM)
    for _ in range(1000):
        pass
stopping.wait()
print("ended", flush=True)
"""


def test_signal_while_the_event_is_locked_is_handled() -> None:
    done = subprocess.run(
        [sys.executable, "-c", LOCKED], check=True, capture_output=True, text=True, timeout=LONG_TIMEOUT_S
    )
    assert done.stdout == "ended\n"


def test_process_exits_when_closing_hangs(tmp_path: Path) -> None:
    process = start(tmp_path, "ignoring_stop", timeout=0.3)
    process.terminate()
    _, errors = process.communicate(timeout=10)
    assert "shutdown timed out" in errors
    assert process.returncode == 3


def test_service_stops_with_its_parent(tmp_path: Path) -> None:
    process = start(tmp_path, "orderly", parent=True)
    output, _ = process.communicate(timeout=10)
    assert output == "closing\nended\n"
    assert process.returncode == 0


def test_service_fails_when_a_thread_crashes(tmp_path: Path) -> None:
    process = start(tmp_path, "crashing_thread", ready=False)
    output, errors = process.communicate(timeout=20)
    assert output == ""
    assert "ZeroDivisionError" in errors
    last = errors.splitlines()[-1]
    assert last == "hilrig: error: sim/1: thread 'worker' crashed (see traceback above)"
    assert process.returncode == 3


def test_error_is_one_line_with_its_exit_code(tmp_path: Path) -> None:
    process = start(tmp_path, "failing", ready=False)
    output, errors = process.communicate(timeout=20)
    assert output == ""
    assert "hilrig: error: lab.toml: sim.step: unknown key\n" in errors
    assert "Traceback" not in errors
    assert process.returncode == 2


ENDING_PROGRAM = """
import atexit, sys, threading
from hilrig_runtime.process.shutdown import run_process

def main():
    atexit.register(print, "last function")
    threading.Thread(target=lambda: threading.Event().wait(0.2) or print("thread")).start()
    threading.Thread(target=threading.Event().wait, daemon=True).start()
    print("main")
    {ending}

run_process(main)
"""


@pytest.mark.parametrize(
    ("ending", "code", "error"),
    [
        ("return None", 0, ""),
        ("return 3", 3, ""),
        ("sys.exit()", 0, ""),
        ("sys.exit(4)", 4, ""),
        ("sys.exit('text')", 1, "text"),
        ("return 1 // 0", 1, "ZeroDivisionError"),
    ],
)
def test_process_ends_as_the_interpreter(ending: str, code: int, error: str) -> None:
    command = [sys.executable, "-c", ENDING_PROGRAM.format(ending=ending)]
    done = subprocess.run(command, check=False, capture_output=True, text=True, timeout=LONG_TIMEOUT_S)
    assert done.stdout == "main\nthread\nlast function\n"
    assert error in done.stderr
    assert bool(error) == bool(done.stderr)
    assert done.returncode == code


HANGUP_PROGRAM = """
import fcntl, signal, sys, termios, threading
from hilrig_runtime.process.shutdown import call_on_hangup

fcntl.ioctl(int(sys.argv[1]), termios.TIOCSCTTY, 0)
signal.signal(signal.SIGHUP, signal.SIG_IGN if sys.argv[2] == "nohup" else signal.SIG_DFL)
stopping = threading.Event()
call_on_hangup(lambda: print("reloaded", flush=True), stopping)
print("ready", flush=True)
while not stopping.wait(0.05):
    pass
"""


@pytest.mark.parametrize("with_nohup", [False, True])
def test_hangup_reloads_and_closed_terminal_stops(tmp_path: Path, with_nohup: bool) -> None:
    master, terminal = os.openpty()
    out = tmp_path / "out"
    command = [sys.executable, "-c", HANGUP_PROGRAM, str(terminal), "nohup" if with_nohup else ""]
    with out.open("w") as log:
        process = subprocess.Popen(command, stdout=log, start_new_session=True, pass_fds=[terminal])
    try:
        os.close(terminal)
        eventually(lambda: "ready" in out.read_text())
        process.send_signal(signal.SIGHUP)
        eventually(lambda: "reloaded" in out.read_text())
        assert process.poll() is None
        os.close(master)
        if with_nohup:
            eventually(lambda: out.read_text().count("reloaded") >= 2)
            assert process.poll() is None
        else:
            assert process.wait(5) == 0
    finally:
        process.kill()
        process.wait()
