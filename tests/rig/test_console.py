"""The console beside a lab that really runs: what a browser gets, what it does not, and how it begins and ends."""

import base64
import http.client
import json
import os
import re
import signal
import socket
import ssl
import subprocess
import threading
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from hilrig_console.app import BROWSERS
from hilrig_console.auth import Guard
from hilrig_console.serving import Address, ConsoleServer, TlsFiles, ask_health
from hilrig_runtime.config.lab import load_lab
from hilrig_runtime.errors import OperationError
from support.browser import CHROMIUM, Browser
from support.bus_certificates import make_bus_folder
from support.labs import HILRIG, RunningLab, hilrig, steady_controller, write_lab
from support.recordings import Script, record
from support.waiting import PATIENT_S, eventually

pytestmark = pytest.mark.rig


@dataclass
class RunningConsole:
    """A console as a user starts it, asked over plain HTTP."""

    process: "subprocess.Popen[str]"
    port: int
    said: str

    def ask(self, path: str, method: str = "GET", **headers: str) -> tuple[int, dict[str, str], bytes]:
        """Status, headers in small letters, body; the path goes out as it is."""
        # A report is made by a process that steps back behind all others: where these are busy, it takes long.
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
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        told = re.search(r"https?://\S+:(\d+)/", line)
        assert told is not None, (line, process.stderr and process.stderr.read())
        running = RunningConsole(process, int(told[1]), line)
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
    """A browser's event stream, the newest of each kind and every event."""

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
class Beside:
    lab: RunningLab
    console: RunningConsole
    said_without_lab: dict[str, Any]


@pytest.fixture(scope="module")
def beside(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Beside]:
    """The console first, the lab behind it: it says that there is none, and finds it."""
    folder = tmp_path_factory.mktemp("console")
    config = write_lab(folder, rigs=2, extra="edge.session_grace_ms = 0")
    with ExitStack() as closing:
        running = closing.enter_context(console(config))
        with Watcher(running.port) as watcher:
            eventually(lambda: "lab" in watcher.newest)
            without = watcher.newest["lab"]
            eventually(lambda: "no such folder" in running.json("/runs")["trouble"])
        lab = closing.enter_context(RunningLab(config))
        yield Beside(lab, running, without)


def test_a_console_without_a_lab_says_so_and_finds_the_lab_when_it_comes(beside: Beside) -> None:
    assert beside.said_without_lab["services"] == []
    assert [rig["state"] for rig in beside.said_without_lab["rigs"]] == ["no edge", "no edge"]
    with Watcher(beside.console.port) as watcher:
        eventually(
            lambda: [rig["state"] for rig in watcher.newest.get("lab", {}).get("rigs", [])] == ["free", "free"],
            timeout_s=20,
        )
        eventually(lambda: watcher.rig("rig1")["address"] == f"127.0.0.1:{beside.lab.port}")
        eventually(lambda: watcher.pose("rig1") and watcher.pose("rig2"))
    (scene,) = beside.console.json("/scenes")
    assert scene["span"] == 600


def test_a_rig_in_use_shows_who_holds_it_how_it_moves_and_what_happened(beside: Beside) -> None:
    port = beside.console.port
    # One that never reads holds up nobody.
    with Watcher(port) as watcher, Watcher(port) as other, socket.create_connection(("127.0.0.1", port)) as asleep:
        asleep.sendall(b"GET /live HTTP/1.1\r\nHost: localhost\r\n\r\n")
        eventually(lambda: watcher.pose("rig1"))
        before = watcher.pose("rig1")
        with steady_controller(beside.lab.port):
            # The recorder and the edge each say it in their own second.
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
    # A browser that comes back gets what it has not seen.
    with Watcher(beside.console.port, last_event_id=str(numbers[-2])) as returned:
        eventually(lambda: returned.events)
        assert returned.events[0]["id"] == numbers[-1]


def test_recordings_are_listed_given_out_and_reported(beside: Beside) -> None:
    folder = beside.lab.lab.recorder.folder
    shown = folder / "lab" / "rig9"
    shown.mkdir(parents=True)
    good = record(shown / "good <&> run.mcap", Script(seconds=3.0))
    (shown / "torn.mcap").write_bytes(good.read_bytes()[:20_000])
    (folder / "secret.txt").write_text("not for browsers")
    (shown / "away.mcap").symlink_to(Path(__file__))

    def listed() -> dict[str, dict[str, Any]] | None:
        runs = {run["path"]: run for run in beside.console.json("/runs?words=RIG9")["runs"]}
        return runs if len(runs) == 3 and runs["lab/rig9/good <&> run.mcap"]["loop_p50_ms"] else None

    with Watcher(beside.console.port):
        runs = eventually(listed, every_s=0.2)
    assert "hilrig recover" in runs["lab/rig9/torn.mcap"]["trouble"]
    status, headers, body = beside.console.ask("/recordings/lab/rig9/good%20%3C%26%3E%20run.mcap")
    assert (status, body) == (200, good.read_bytes())
    assert headers["content-disposition"].startswith("attachment")
    part = beside.console.ask("/recordings/lab/rig9/good%20%3C%26%3E%20run.mcap", range="bytes=0-7")
    assert (part[0], part[2]) == (206, good.read_bytes()[:8])

    status, headers, page = beside.console.ask("/reports/lab/rig9/good%20%3C%26%3E%20run.mcap")
    assert status == 200
    assert b"<h1>Run 20260101T000000Z-rig1-abcd</h1>" in page
    assert headers["content-security-policy"].startswith("default-src 'none'; img-src data:;")
    assert beside.console.ask("/reports/lab/rig9/good%20%3C%26%3E%20run.mcap")[2] == page
    status, _, why = beside.console.ask("/reports/lab/rig9/torn.mcap")
    assert (status, b"hilrig recover" in why) == (404, True)

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
        status, _, body = beside.console.ask(path)
        assert status == 404, path
        assert b"not for browsers" not in body
        assert b"<b>" not in body


def test_it_answers_its_own_page_alone_and_changes_nothing(beside: Beside) -> None:
    ask = beside.console.ask
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


def test_there_are_only_so_many_places_and_who_leaves_makes_room(beside: Beside) -> None:
    crowd = []

    def is_full() -> bool:
        connection = http.client.HTTPConnection("127.0.0.1", beside.console.port, timeout=10)
        connection.request("GET", "/live")
        crowd.append(connection)
        return connection.getresponse().status == 503

    try:
        eventually(is_full, every_s=0)
        assert len(crowd) > BROWSERS
    finally:
        for connection in crowd:
            connection.close()
    eventually(lambda: not is_full())
    crowd.pop().close()


def test_a_simulation_that_starts_anew_is_seen_to_go_and_to_come(beside: Beside) -> None:
    with Watcher(beside.console.port) as watcher:
        eventually(lambda: watcher.pose("rig2"))
        sim = beside.lab.service_pid("sim")
        os.kill(sim, signal.SIGSTOP)
        try:
            eventually(lambda: watcher.rig("rig2")["state"] == "no simulation")
            eventually(lambda: watcher.pose("rig2") is None)
            assert any("sim/1" in alert for alert in watcher.newest["lab"]["alerts"])
        finally:
            os.kill(sim, signal.SIGKILL)
        eventually(lambda: watcher.rig("rig2")["state"] == "free" and watcher.pose("rig2"))


@pytest.mark.skipif(CHROMIUM is None, reason="needs Debian's chromium")
def test_a_browser_sees_the_figures_of_a_rig_change(beside: Beside, tmp_path: Path) -> None:
    with Browser(tmp_path / "profile") as browser:
        browser.open(f"http://127.0.0.1:{beside.console.port}/", width=1400, height=900)

        def card(what: str) -> str:
            found = "[...document.querySelectorAll('#cards > li')].find(card => card.innerText.startsWith('rig2'))"
            return str(browser.run(f"(card => card ? {what} : '')({found})"))

        text, arm = "card.innerText", "(card.querySelector('.one')?.getAttribute('y2') ?? '')"
        eventually(lambda: "free" in card(text) and card(arm))
        before = float(card(arm))
        with steady_controller(beside.lab.lab.ports["rig2"]):
            eventually(lambda: "in use" in card(text) and "127.0.0.1:" in card(text))
            eventually(lambda: abs(float(card(arm)) - before) > 20)
        eventually(lambda: "session" in browser.run("document.getElementById('events').innerText"))
        eventually(lambda: browser.run("document.querySelectorAll('#runs tbody tr').length") >= 1)
        assert browser.run("document.getElementById('link').innerText") == "live"
        browser.run("document.getElementById('as-table').click()")
        assert browser.run("document.querySelector('#rows tbody tr').innerText.includes('rig1')")
        words = "document.getElementById('words')"
        browser.run(f"{words}.value = 'rig2'; {words}.dispatchEvent(new Event('input'))")
        assert browser.run("[...document.querySelectorAll('#rows tbody tr')].filter(row => !row.hidden).length") == 1
        assert sorted(browser.run("location.hash")[1:].split("&")) == ["rigs=rig2", "view=table"]
        for width in (1400, 400):
            browser.open(f"http://127.0.0.1:{beside.console.port}/", width=width, height=900)
            eventually(lambda: "rig2" in browser.run("document.body.innerText"))
            assert browser.run("document.documentElement.scrollWidth") <= width
            eventually(lambda: browser.run("document.querySelectorAll('.arm:not(.stale) .one').length") == 2)
        assert browser.errors == []
        assert {re.sub(r"^http://127\.0\.0\.1:\d+/", "", asked).partition("?")[0] for asked in browser.requests} <= {
            "",
            "console.css",
            "console.js",
            "icon.svg",
            "live",
            "scenes",
            "runs",
        }


def test_off_loopback_it_wants_the_password_that_it_prints_and_ends_at_once_with_browsers_there(tmp_path: Path) -> None:
    with console(write_lab(tmp_path), listen="0.0.0.0:0") as running:
        assert running.process.stdout is not None
        told = re.match(r"password: (\S+) ", running.process.stdout.readline())
        assert told is not None

        def basic(password: str) -> str:
            return f"Basic {base64.b64encode(f'teacher:{password}'.encode()).decode()}"

        status, headers, _ = running.ask("/")
        assert (status, headers["www-authenticate"].partition(" ")[0]) == (401, "Basic")
        assert running.ask("/live", authorization=basic("guess"))[0] == 401
        assert running.ask("/health")[0] == 200
        with Watcher(running.port, authorization=basic(told[1])) as watcher:
            eventually(lambda: "lab" in watcher.newest)
            assert answers(Address("", running.port), None)
            running.process.send_signal(signal.SIGINT)
            assert running.process.wait(PATIENT_S) == 0
            eventually(lambda: watcher.ended)
        assert running.process.stderr is not None
        assert "the password is sent unencrypted" in running.process.stderr.read()


def test_with_a_certificate_it_speaks_https(tmp_path: Path) -> None:
    authority = make_bus_folder(tmp_path / "certs", ["console"])
    trusting = ssl.create_default_context(cadata=authority.certificate_pem.decode())
    tls = TlsFiles(tmp_path / "certs/console.pem", tmp_path / "certs/console.key")
    with ConsoleServer(load_lab(write_lab(tmp_path)), Address.of("127.0.0.1:0"), Guard(), tls) as server:
        assert server.url.startswith("https://127.0.0.1:")
        address = Address.of(server.url.removeprefix("https://").rstrip("/"))
        eventually(lambda: answers(address, tls))
        with urllib.request.urlopen(server.url, timeout=10, context=trusting) as page:
            assert b"console.js" in page.read()
        assert not answers(address, None)


def answers(address: Address, tls: TlsFiles | None) -> bool:
    try:
        ask_health(address, tls)
    except OperationError:
        return False
    return True


def test_a_port_that_is_taken_is_said_in_a_line(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        listen = f"127.0.0.1:{taken.getsockname()[1]}"
        done = hilrig("console", "--config", write_lab(tmp_path), "--listen", listen)
    assert done.returncode == 3
    (line,) = done.stderr.splitlines()
    assert f"can't listen on {listen}: Address already in use; choose another address with --listen" in line
