"""Runs a program as the controller of a lab on this host, and returns its recording."""

import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

from hilrig_cli.local.local_lab import POLL_S, free_ports, running_lab
from hilrig_cli.local.supervisor import own_process_group
from hilrig_recorder.mcap_format.file_names import MCAP_PATTERN
from hilrig_runtime.config.lab import LabConfig, load_lab
from hilrig_runtime.config.template import toml_value
from hilrig_runtime.errors import InputError, OperationError

FILE_TIMEOUT_S: Final = 2.0
"""Time until the recorder has a file of the session after the program has ended."""
FINISH_TIMEOUT_S: Final = 15.0
"""Time for the recorder to finish that file."""
_MAX_OUTPUT: Final = 2000


def record_program(
    lab: LabConfig,
    program: Path,
    folder: Path,
    time_limit_s: float,
    log: Callable[[str], None],
    on_progress: Callable[[float], None],
) -> Path:
    """Run a lab with a program as the controller of its first rig, until the program ends; return the recording.

    Args:
        lab: the lab; ports, addresses, certificates and the folder of its recordings are replaced.
        program: called with `--host HOST --port PORT`; a file with the suffix .py is run by this Python.
        folder: existing folder of the lab file and the recording.
        time_limit_s: time after which the program is ended.
        log: receives messages, one line each.
        on_progress: receives the elapsed share of the time limit.

    Raises:
        InputError: the program is missing, or the lab has a rig that is a client of its controller.
        OperationError: a service or the program could not start, or nothing was recorded.
    """
    if not program.is_file():
        raise InputError(f"{program}: no such file; expected a program that takes --host HOST and --port PORT")
    if lab.rigs[0].controller is not None:
        raise InputError(f"rig {lab.rigs[0].name!r} is a client of its controller: a program can't connect to it")
    config = folder / "lab.toml"
    _write_lab(config, lab, folder)
    local = load_lab(config)
    with running_lab(local, config, log, threading.Event()) as supervisor:
        rig = local.rigs[0].name
        command = [sys.executable] if program.suffix == ".py" else []
        command += [str(program.resolve()), "--host", local.host_of(local.rigs[0]), "--port", str(local.ports[rig])]
        output = _run(command, time_limit_s, supervisor.poll, on_progress)
        recordings = folder / local.name / rig
        ended_s = time.monotonic()
        while not (found := sorted(recordings.glob(MCAP_PATTERN))):
            elapsed_s = time.monotonic() - ended_s
            if elapsed_s > (FINISH_TIMEOUT_S if any(recordings.glob("*")) else FILE_TIMEOUT_S):
                break
            supervisor.poll()
            time.sleep(POLL_S)
    # The recorder finishes a file that is still open when it stops.
    found = found or sorted(recordings.glob(MCAP_PATTERN))
    if not found:
        raise OperationError(f"{program}: nothing was recorded: did it write torques? Its output: {output or 'none'}")
    return found[-1]


def _write_lab(path: Path, lab: LabConfig, folder: Path) -> None:
    values: dict[str, Any] = lab.model_dump(mode="json", exclude_none=True)
    values["edge"].pop("tls", None)
    values["edge"] |= {"host": "127.0.0.1", "plain": True, "first_port": free_ports(lab.edge.first_port)}
    # The recording ends when the program disconnects.
    values["edge"]["session_grace_ms"] = 0.0
    values["bus"] = {"first_port": free_ports(lab.bus.first_port, 3)}
    values["recorder"] = {"folder": str(folder.resolve())}
    rig = {key: value for key, value in values["rigs"][0].items() if key not in ("port", "host", "allow")}
    values["rigs"] = [rig]
    path.write_text("".join(f"{key} = {toml_value(value)}\n" for key, value in values.items()), encoding="utf-8")


def _run(
    command: list[str], time_limit_s: float, poll: Callable[[], None], on_progress: Callable[[float], None]
) -> str:
    """Run a program until it ends or its time has passed; return the end of its output.

    Raises:
        OperationError: it can't be started.
    """
    start_s = time.monotonic()
    try:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            **own_process_group(),
        )
    except OSError as error:
        raise OperationError(f"{command[0]}: can't be started: {error.strerror}") from error
    output: list[str] = []

    def read() -> None:
        assert process.stdout is not None
        for line in process.stdout:
            output.append(line)
            del output[:-50]

    with process:
        reader = threading.Thread(target=read)
        reader.start()
        try:
            while process.poll() is None:
                poll()
                elapsed_s = time.monotonic() - start_s
                on_progress(min(1.0, elapsed_s / time_limit_s))
                if elapsed_s > time_limit_s:
                    process.kill()
                time.sleep(POLL_S)
        finally:
            if process.poll() is None:
                process.kill()
            reader.join()
    return "".join(output).strip()[-_MAX_OUTPUT:]
