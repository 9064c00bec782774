"""Console with a running lab: event stream, recordings, access control, start and shutdown."""

import base64
import http.client
import json
import os
import re
import resource
import signal
import socket
import ssl
import subprocess
import threading
import time
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from hilrig_console.app import MAX_BROWSERS
from hilrig_console.auth import AccessPolicy
from hilrig_console.serving import ConsoleServer, TlsFiles, check_health
from hilrig_runtime.config.lab import load_lab
from hilrig_runtime.errors import OperationError
from hilrig_runtime.listen_address import ListenAddress
from support.browser import CHROMIUM, Browser
from support.bus_certificates import make_bus_folder
from support.edge_rig import RawClient
from support.hilrig_process import HILRIG, ForkedPopen
from support.labs import RunningLab, hilrig, steady_controller, write_lab
from support.long_tests import LONG
from support.recordings import Script, record
from support.waiting import LONG_TIMEOUT_S, eventually

pytestmark = pytest.mark.rig


CONNECTIONS = 1400 if LONG else 700
"""Half-sent requests."""


@dataclass
class RunningConsole:
    """Console process as started by a user."""

    process: "subprocess.Popen[str]"
    port: int
    first_line: str

    def ask(self, path: str, method: str = "GET", **headers: str) -> tuple[int, dict[str, str], bytes]:
        """Return status, headers with lower-case names, and body; the path is sent unmodified."""
        # A report is created by a process of low priority, which takes long on a busy machine.
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=90)
        try:
            connection.putrequest(method, path, skip_host="host" in headers)
            for name, value in headers.items():
                connection.putheader(name.replace("_", "-"), value)
            connection.endheaders()
            answer = connection.getresponse()
            return answer.status, {name.lower(): value for name, value in answer.getheaders()}, answer.read()
        finally:
            connection.close()

    def json(self, path: str) -> Any:
        status, _, body = self.ask(path)
        assert status == 200, body
        return json.loads(body)


@contextmanager
def console(config: Path, *options: str, listen: str = "127.0.0.1:0") -> Iterator[RunningConsole]:
    command = [*HILRIG, "console", "--config", str(config), "--listen", listen, *options]
    process = ForkedPopen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        match = re.search(r"https?://\S+:(\d+)/", line)
        assert match is not None, (line, process.stderr and process.stderr.read())
        running = RunningConsole(process, int(match[1]), line)
        eventually(lambda: is_up(running))
        yield running
    finally:
        if process.poll() is None:
            process.terminate()
        try:
            process.wait(10)
        finally:
            process.kill()
            for pipe in (process.stdout, process.stderr):
                assert pipe is not None
                pipe.close()


def is_up(running: RunningConsole) -> bool:
    try:
        return running.ask("/health")[0] == 200
    except OSError:
        return False


class Watcher:
    """Client of the event stream: keeps the newest message of each kind, and all events."""

    def __init__(self, port: int, **headers: str) -> None:
        self.newest: dict[str, Any] = {}
        self.events: list[dict[str, Any]] = []
        self.ended = False
        self._connection = http.client.HTTPConnection("127.0.0.1", port, timeout=30)
        self._connection.request(
            "GET", "/live", headers={name.replace("_", "-"): value for name, value in headers.items()}
        )
        self._answer = self._connection.getresponse()
        assert self._answer.getheader("content-type", "").startswith("text/event-stream")
        self._thread = threading.Thread(target=self._read)
        self._thread.start()

    def _read(self) -> None:
        kind = ""
        try:
            for raw in self._answer:
                line = raw.decode().rstrip("\n")
                if line.startswith("event: "):
                    kind = line[7:]
                elif line.startswith("data: "):
                    value = json.loads(line[6:])
                    if kind == "event":
                        self.events.append(value)
                    else:
                        self.newest[kind] = value
        except (OSError, ValueError, AttributeError, http.client.HTTPException):
            pass
        self.ended = True

    def rig(self, name: str) -> dict[str, Any]:
        rigs = self.newest.get("lab", {}).get("rigs", [])
        return next((dict(rig) for rig in rigs if rig["rig"] == name), {})

    def pose(self, name: str) -> list[int] | None:
        drawn = self.newest.get("poses", {}).get(name)
        return list(drawn[1]) if drawn else None

    def __enter__(self) -> "Watcher":
        return self

    def __exit__(self, *_: object) -> None:
        if self._connection.sock is not None:
            self._connection.sock.shutdown(2)
        self._connection.close()
        self._thread.join(10)


@dataclass
class ConsoleWithLab:
    """Console and lab, and the first message of the console before the lab was started."""

    lab: RunningLab
    console: RunningConsole
    message_without_lab: dict[str, Any]


@pytest.fixture(scope="module")
def running_lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ConsoleWithLab]:
    """Start the console first and the lab later."""
    folder = tmp_path_factory.mktemp("console")
    config = write_lab(folder, rigs=2, extra="edge.session_grace_ms = 0")
    with ExitStack() as closing:
        running = closing.enter_context(console(config))
        with Watcher(running.port) as watcher:
            eventually(lambda: "lab" in watcher.newest)
            without = watcher.newest["lab"]
            eventually(lambda: "no such folder" in running.json("/runs")["error"])
        lab = closing.enter_context(RunningLab(config))
        yield ConsoleWithLab(lab, running, without)


def test_console_detects_lab_started_later(running_lab: ConsoleWithLab) -> None:
    assert running_lab.message_without_lab["services"] == []
    assert [rig["state"] for rig in running_lab.message_without_lab["rigs"]] == ["no edge", "no edge"]
    with Watcher(running_lab.console.port) as watcher:
        eventually(
            lambda: [rig["state"] for rig in watcher.newest.get("lab", {}).get("rigs", [])] == ["free", "free"],
            timeout_s=20,
        )
        eventually(lambda: watcher.rig("rig1")["address"] == f"127.0.0.1:{running_lab.lab.port}")
        eventually(lambda: watcher.pose("rig1") and watcher.pose("rig2"))
    (scene,) = running_lab.console.json("/scenes")
    assert scene["span"] == 600


def test_rig_in_use_shows_controller_poses_and_events(running_lab: ConsoleWithLab) -> None:
    port = running_lab.console.port
    # A client that never reads does not block the others.
    with Watcher(port) as watcher, Watcher(port) as other, socket.create_connection(("127.0.0.1", port)) as idle:
        idle.sendall(b"GET /live HTTP/1.1\r\nHost: localhost\r\n\r\n")
        eventually(lambda: watcher.pose("rig1"))
        before = watcher.pose("rig1")
        with steady_controller(running_lab.lab.port):
            # Recorder and edge report it independently, once per second.
            held = eventually(lambda: (rig := watcher.rig("rig1"))["recording"] and rig["state"] == "in use" and rig)
            assert held["controller"].startswith("127.0.0.1:")
            assert "-rig1-" in held["session"]
            eventually(lambda: watcher.pose("rig1") != before and other.pose("rig1") != before)
        kinds = {"lease_granted", "session_start", "lease_lost", "session_end"}
        eventually(lambda: kinds <= {event["kind"] for event in watcher.events if event["rig"] == "rig1"})
        eventually(lambda: other.events == watcher.events)
        numbers = [event["id"] for event in watcher.events]
        assert numbers == sorted(set(numbers))
        assert watcher.rig("rig2")["state"] == "free"
    # A browser that reconnects receives the events after its last one.
    with Watcher(running_lab.console.port, last_event_id=str(numbers[-2])) as returned:
        eventually(lambda: returned.events)
        assert returned.events[0]["id"] == numbers[-1]


def test_recordings_are_listed_served_and_reported(running_lab: ConsoleWithLab) -> None:
    folder = running_lab.lab.lab.recorder.folder
    shown = folder / "lab" / "rig9"
    shown.mkdir(parents=True)
    good = record(shown / "good <&> run.mcap", Script(seconds=3.0))
    (shown / "torn.mcap").write_bytes(good.read_bytes()[:20_000])
    (folder / "secret.txt").write_text("not for browsers")
    (shown / "away.mcap").symlink_to(Path(__file__))

    def listed() -> dict[str, dict[str, Any]] | None:
        runs = {run["path"]: run for run in running_lab.console.json("/runs?query=RIG9")["runs"]}
        return runs if len(runs) == 3 and runs["lab/rig9/good <&> run.mcap"]["loop_p50_ms"] else None

    with Watcher(running_lab.console.port):
        runs = eventually(listed, every_s=0.2)
    assert "hilrig recover" in runs["lab/rig9/torn.mcap"]["error"]
    status, headers, body = running_lab.console.ask("/recordings/lab/rig9/good%20%3C%26%3E%20run.mcap")
    assert (status, body) == (200, good.read_bytes())
    assert headers["content-disposition"].startswith("attachment")
    part = running_lab.console.ask("/recordings/lab/rig9/good%20%3C%26%3E%20run.mcap", range="bytes=0-7")
    assert (part[0], part[2]) == (206, good.read_bytes()[:8])

    status, headers, page = running_lab.console.ask("/reports/lab/rig9/good%20%3C%26%3E%20run.mcap")
    assert status == 200
    assert b"<h1>Run 20260101T000000Z-rig1-abcd</h1>" in page
    policy = headers["content-security-policy"]
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    assert "img-src data:;" in policy
    assert running_lab.console.ask("/reports/lab/rig9/good%20%3C%26%3E%20run.mcap")[2] == page
    status, _, message = running_lab.console.ask("/reports/lab/rig9/torn.mcap")
    assert (status, b"hilrig recover" in message) == (404, True)

    for path in (
        "/recordings/secret.txt",
        "/recordings/lab/rig9/away.mcap",
        "/recordings/../lab.toml",
        "/recordings/lab/../secret.txt",
        "/recordings/%2e%2e/lab.toml",
        "/recordings/..%2flab.toml",
        "/recordings//etc/passwd",
        "/reports/%2fetc%2fpasswd",
        "/recordings/<b>",
        "/static/console.js",
        "/console.py",
    ):
        status, _, body = running_lab.console.ask(path)
        assert status == 404, path
        assert b"not for browsers" not in body
        assert b"<b>" not in body


def test_rejects_foreign_hosts_sites_and_methods(running_lab: ConsoleWithLab) -> None:
    ask = running_lab.console.ask
    status, headers, page = ask("/")
    assert status == 200
    assert b"<script src=" in page
    policy = headers["content-security-policy"]
    assert "default-src 'none'" in policy
    assert "unsafe" not in policy
    assert headers["x-content-type-options"] == "nosniff"
    assert ask("/", host="evil.example")[0] == 421
    assert ask("/live", host="localhost.evil.example:80")[0] == 421
    assert ask("/runs", sec_fetch_site="cross-site", sec_fetch_mode="no-cors")[0] == 403
    assert ask("/", sec_fetch_site="cross-site", sec_fetch_mode="navigate")[0] == 200
    for method in ("POST", "PUT", "DELETE", "PATCH", "OPTIONS"):
        for path in ("/", "/live", "/runs", "/scenes"):
            assert ask(path, method)[0] == 405, (method, path)
    assert ask("/", "HEAD")[2] == b""


def test_number_of_browsers_is_limited(running_lab: ConsoleWithLab) -> None:
    crowd = []

    def is_full() -> bool:
        connection = http.client.HTTPConnection("127.0.0.1", running_lab.console.port, timeout=10)
        connection.request("GET", "/live")
        crowd.append(connection)
        return connection.getresponse().status == 503

    try:
        eventually(is_full, every_s=0)
        assert len(crowd) > MAX_BROWSERS
    finally:
        for connection in crowd:
            connection.close()
    eventually(lambda: not is_full())
    crowd.pop().close()


def test_simulation_restart_is_shown(running_lab: ConsoleWithLab) -> None:
    with Watcher(running_lab.console.port) as watcher:
        eventually(lambda: watcher.pose("rig2"))
        sim = running_lab.lab.service_pid("sim")
        os.kill(sim, signal.SIGSTOP)
        try:
            eventually(lambda: watcher.rig("rig2")["state"] == "no simulation")
            eventually(lambda: watcher.pose("rig2") is None)
            assert any("sim/1" in alert for alert in watcher.newest["lab"]["alerts"])
        finally:
            os.kill(sim, signal.SIGKILL)
        eventually(lambda: watcher.rig("rig2")["state"] == "free" and watcher.pose("rig2"))


@pytest.mark.skipif(CHROMIUM is None, reason="needs Debian's chromium")
def test_browser_shows_changing_values(running_lab: ConsoleWithLab, tmp_path: Path) -> None:
    with Browser(tmp_path / "profile") as browser:
        browser.open(f"http://127.0.0.1:{running_lab.console.port}/", width=1400, height=900)

        def card(expression: str) -> str:
            found = "[...document.querySelectorAll('#cards > li')].find(card => card.innerText.startsWith('rig2'))"
            return str(browser.run(f"(card => card ? {expression} : '')({found})"))

        text, arm = "card.innerText", "(card.querySelector('.one')?.getAttribute('y2') ?? '')"
        eventually(lambda: "free" in card(text) and card(arm))
        before = float(card(arm))
        with steady_controller(running_lab.lab.lab.ports["rig2"]):
            eventually(lambda: "in use" in card(text) and "127.0.0.1:" in card(text))
            eventually(lambda: abs(float(card(arm)) - before) > 20)
        eventually(lambda: "session" in browser.run("document.getElementById('events').innerText"))
        assert browser.run("document.getElementById('refused-panel').hidden")
        with RawClient("127.0.0.1", running_lab.lab.lab.ports["rig2"]) as client:
            assert client.ask("03 00 00 00 0A").hex() == "8302"
        eventually(
            lambda: (
                "rig2 127.0.0.1 3 02 1"
                in browser.run("document.querySelector('#refused tbody').innerText.replace(/\\s+/g, ' ')")
            )
        )
        eventually(lambda: browser.run("document.querySelectorAll('#runs tbody tr').length") >= 1)
        assert browser.run("document.getElementById('link').innerText") == "live"
        browser.run("document.getElementById('as-table').click()")
        assert browser.run("document.querySelector('#rows tbody tr').innerText.includes('rig1')")
        search = "document.getElementById('rig-search')"
        browser.run(f"{search}.value = 'rig2'; {search}.dispatchEvent(new Event('input'))")
        assert browser.run("[...document.querySelectorAll('#rows tbody tr')].filter(row => !row.hidden).length") == 1
        assert sorted(browser.run("location.hash")[1:].split("&")) == ["rigs=rig2", "view=table"]
        for width in (1400, 400):
            browser.open(f"http://127.0.0.1:{running_lab.console.port}/", width=width, height=900)
            eventually(lambda: "rig2" in browser.run("document.body.innerText"))
            assert browser.run("document.documentElement.scrollWidth") <= width
            eventually(lambda: browser.run("document.querySelectorAll('.arm:not(.stale) .one').length") == 2)
        assert browser.errors == []
        assert {re.sub(r"^http://127\.0\.0\.1:\d+/", "", url).partition("?")[0] for url in browser.requests} <= {
            "",
            "console.css",
            "console.js",
            "icon.svg",
            "live",
            "scenes",
            "runs",
        }


def test_password_is_required_off_loopback(tmp_path: Path) -> None:
    with console(write_lab(tmp_path), listen="0.0.0.0:0") as running:
        assert running.process.stdout is not None
        match = re.match(r"password: (\S+) ", running.process.stdout.readline())
        assert match is not None

        def basic(password: str) -> str:
            return f"Basic {base64.b64encode(f'teacher:{password}'.encode()).decode()}"

        status, headers, _ = running.ask("/")
        assert (status, headers["www-authenticate"].partition(" ")[0]) == (401, "Basic")
        assert running.ask("/live", authorization=basic("guess"))[0] == 401
        assert running.ask("/health")[0] == 200
        with Watcher(running.port, authorization=basic(match[1])) as watcher:
            eventually(lambda: "lab" in watcher.newest)
            assert answers(ListenAddress("0.0.0.0", running.port), None)
            running.process.send_signal(signal.SIGINT)
            assert running.process.wait(LONG_TIMEOUT_S) == 0
            eventually(lambda: watcher.ended)
        assert running.process.stderr is not None
        assert "the password is sent unencrypted" in running.process.stderr.read()


def test_console_is_reachable_during_half_sent_requests(tmp_path: Path) -> None:
    resource.setrlimit(resource.RLIMIT_NOFILE, (resource.getrlimit(resource.RLIMIT_NOFILE)[1],) * 2)
    with console(write_lab(tmp_path)) as running, ExitStack() as closing:
        for number in range(CONNECTIONS):
            source = (f"127.0.5.{number % 3 + 1}" if number % 2 else "127.0.0.1", 0)
            connection = socket.create_connection(("127.0.0.1", running.port), timeout=5, source_address=source)
            closing.enter_context(connection).sendall(b"GET / HTTP/1.1\r\nHost: con")
        start_s = time.monotonic()
        for path in ("/health", "/", "/runs"):
            assert running.ask(path)[0] == 200
        assert time.monotonic() - start_s < 2
        assert len(list(Path(f"/proc/{running.process.pid}/fd").iterdir())) < 600
        running.process.terminate()
        assert running.process.wait(LONG_TIMEOUT_S) == 0
        assert running.process.stderr is not None
        assert len(running.process.stderr.read().splitlines()) < 10


def test_serves_https_with_certificate(tmp_path: Path) -> None:
    authority = make_bus_folder(tmp_path / "certs", ["console"])
    trusting = ssl.create_default_context(cadata=authority.certificate_pem.decode())
    tls = TlsFiles(tmp_path / "certs/console.pem", tmp_path / "certs/console.key")
    with ConsoleServer(
        load_lab(write_lab(tmp_path)), ListenAddress.parse("127.0.0.1:0"), AccessPolicy(), tls
    ) as server:
        assert server.urls.startswith("https://127.0.0.1:")
        address = ListenAddress.parse(server.urls.removeprefix("https://").rstrip("/"))
        eventually(lambda: answers(address, tls))
        with urllib.request.urlopen(server.urls, timeout=10, context=trusting) as page:
            assert b"console.js" in page.read()
        assert not answers(address, None)


def answers(address: ListenAddress, tls: TlsFiles | None) -> bool:
    try:
        check_health(address, tls)
    except OperationError:
        return False
    return True


def test_reports_occupied_port(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as occupied:
        listen = f"127.0.0.1:{occupied.getsockname()[1]}"
        done = hilrig("console", "--config", write_lab(tmp_path), "--listen", listen)
    assert done.returncode == 3
    (line,) = done.stderr.splitlines()
    assert f"can't listen on {listen}: Address already in use; choose another address with --listen" in line
