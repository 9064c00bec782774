"""A class in a real lab: codes, claims, and writes from another address, in both roles of the edge."""

import json
import os
import re
import signal
import socket
import struct
import subprocess
import sys
from pathlib import Path

import pytest

from hilrig_replay.io.run import open_run
from support.labs import RunningLab, free_ports, hilrig, write_lab
from support.recordings import content_of
from support.waiting import eventually

pytestmark = pytest.mark.rig

EXAMPLES = Path(__file__).parents[2] / "examples"
NAMES = {"s1001": "Zoë Müller", "s1002": "=1+1"}
READ = struct.pack(">HHHBBHH", 1, 0, 6, 1, 3, 4, 4)
WRITE = struct.pack(">HHHBBHH", 2, 0, 6, 1, 6, 0, 100)
WRITTEN, DENIED = WRITE[7:], b"\x86\x06"


def ask(host: str, port: int, request: bytes) -> bytes:
    """Send one request from a source address; return the PDU of the response, empty: the edge does not answer."""
    try:
        with socket.create_connection(("127.0.0.1", port), timeout=5, source_address=(host, 0)) as connection:
            connection.sendall(request)
            return connection.recv(300)[7:]
    except OSError:
        return b""


def test_rigs_are_written_by_those_who_claimed_them(tmp_path: Path) -> None:
    certs = tmp_path / "certs"
    assert hilrig("certs", certs, "--client", "pc7=operator").returncode == 0
    files = {"certificate": "edge.pem", "key": "edge.key", "authority": "ca.pem"}
    extra = "\n".join(f"edge.tls.{key} = '{certs / file}'" for key, file in files.items())
    extra += f"\nedge.tls.first_port = {free_ports(2)}\nedge.session_grace_ms = 300"
    config = write_lab(tmp_path, rigs=2, extra=extra)
    plc = free_ports(1)
    rows = "".join(f"{one},{name},A,rig{number}\n" for number, (one, name) in enumerate(NAMES.items(), start=1))
    (tmp_path / "roster.csv").write_text(f"id,name,group,rig\n{rows}", encoding="utf-8-sig")
    text = config.read_text().replace('"rig2"\n', f'"rig2"\ncontroller = "127.0.0.1:{plc}"\n')
    config.write_text(f"{text}[classroom]\nroster = '{tmp_path / 'roster.csv'}'\nclaims = '{tmp_path / 'claims'}'\n")

    with RunningLab(config) as lab:
        made = hilrig("rig", "codes", "--until", "23:59", "--out", tmp_path / "codes.csv", "-c", config, "--json")
        codes = json.loads(made.stdout)["codes"]
        assert f"s1002,'=1+1,A,rig2,{codes['s1002']}," in (tmp_path / "codes.csv").read_text()
        ports = lab.lab.ports

        def lease(rig: str, *options: str) -> dict[str, str]:
            found: dict[str, str] = json.loads(hilrig("lease", rig, *options, "-c", config, "--json").stdout)
            return found

        # Not claimed: nobody writes, in either role; everybody reads.
        assert [ask(host, ports["rig1"], WRITE) for host in ("127.0.0.1", "127.0.0.2")] == [DENIED] * 2
        assert ask("127.0.0.2", ports["rig1"], READ)[:2] == b"\x03\x08"
        server = [sys.executable, str(EXAMPLES / "server_controller.py"), "--port", str(plc), "--duration", "60"]
        with subprocess.Popen(server, stdout=subprocess.DEVNULL) as program:
            try:
                eventually(lambda: "rig2 is not claimed: claim it" in lease("rig2")["controller_fault"])
                wrong = hilrig("claim", codes["s1002"], f"127.0.0.1:{ports['rig1']}", "--json")
                assert (wrong.returncode, "is not valid for this rig" in json.loads(wrong.stdout)["reason"]) == (
                    1,
                    True,
                )
                for number, code in enumerate(codes.values(), start=1):
                    claimed = hilrig("claim", code.lower().replace("-", ""), f"rig{number}", "-c", config)
                    assert (claimed.returncode, "is yours until the end" in claimed.stdout) == (0, True), claimed
                assert ask("127.0.0.1", ports["rig1"], WRITE) == WRITTEN
                assert ask("127.0.0.2", ports["rig1"], WRITE) == DENIED
                assert "rig1 is claimed by s1001 from 127.0.0.1" in lab.output()
                assert ask("127.0.0.2", ports["rig1"], READ)[:2] == b"\x03\x08"
                eventually(lambda: list(tmp_path.rglob("*-rig2-s1002-*")))
            finally:
                program.kill()

        def rigs() -> dict[str, dict[str, str]]:
            """Rigs in the health reports."""
            shown = hilrig("top", "--once", "--json", "-c", config)
            return {row["rig"]: row for row in json.loads(shown.stdout)["rigs"]}

        assert eventually(lambda: [row.get("student") for row in rigs().values()] == ["s1001", "s1002"])

        # A claim survives the edge.
        os.kill(lab.service_pid("edge"), signal.SIGKILL)
        eventually(lambda: ask("127.0.0.2", ports["rig1"], WRITE) == DENIED)
        assert ask("127.0.0.1", ports["rig1"], WRITE) == WRITTEN
        status = lease("rig1", "--end-claim")
        assert (status["claim_ended"], status["holder"], status["session"]) == ("s1001", "", "")
        assert ask("127.0.0.1", ports["rig1"], WRITE) == DENIED
        assert hilrig("lease", "rig1", "--end-claim", "-c", config).returncode == 1

        # With a certificate, the address does not count.
        own = ("--certificate", certs / "pc7.pem", "--key", certs / "pc7.key", "--authority", certs / "ca.pem")
        assert hilrig("claim", codes["s1001"], "rig1", *own, "-c", config).returncode == 0
        assert lease("rig1")["claimed_from"] == "CN=pc7"
        assert ask("127.0.0.1", ports["rig1"], WRITE) == DENIED
        eventually(lambda: {path.parent.name for path in lab.recordings} == {"rig1", "rig2"})
        log = lab.output()

    found = {open_run(path).students for path in lab.recordings}
    assert found == {("s1001",), ("s1002",)}
    assert all(re.search(r"-rig(1-s1001|2-s1002)-", path.name) for path in lab.recordings)
    everything = log.encode() + b"".join(content_of(path) for path in lab.recordings)
    assert not [name for name in NAMES.values() if name.encode() in everything]
    assert not [code for code in codes.values() if code.replace("-", "").encode() in everything]


@pytest.mark.parametrize("command", ["check", "edge", "rig codes --until 23:59"])
def test_mistakes_of_the_roster_are_named(tmp_path: Path, command: str) -> None:
    config, roster = write_lab(tmp_path), tmp_path / "roster.csv"
    roster.write_text("id,name,rig\na,Ann,rig1\nA,Amy,rig1\n", encoding="utf-8")
    config.write_text(f"{config.read_text()}[classroom]\nroster = '{roster}'\nclaims = '{tmp_path}'\n")
    options = [config] if command == "check" else ["--config", config]
    done = hilrig(*command.split(), *options)
    assert (done.returncode, f"{roster}: line 3: id 'A' occurs twice, first in line 2" in done.stderr) == (2, True)
    roster.write_text("id,name,rig\na,Ann,rig7\nb,Bob,rig8\n", encoding="utf-8")
    done = hilrig(*command.split(), *options)
    assert done.returncode == 2
    assert "line 2: unknown rig 'rig7' of a; the lab has rig1" in done.stderr
    assert "line 3: unknown rig 'rig8' of b" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["ABC"], 2, "'ABC' is no code: expected 10 letters and digits"),
        (["AAAAA-22222", "a b"], 2, "'a b' is no address of a rig"),
        (["AAAAA-22222", "--key", "x"], 2, "--certificate, --key and --authority belong together"),
        (["AAAAA-22222", "127.0.0.1:1"], 3, "127.0.0.1:1 does not answer: Connection refused"),
    ],
)
def test_wrong_claims_are_explained(arguments: list[str], code: int, message: str) -> None:
    done = hilrig("claim", *arguments)
    assert (done.returncode, message in done.stderr) == (code, True), done.stderr
