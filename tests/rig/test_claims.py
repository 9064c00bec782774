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
    config = write_lab(tmp_path, rigs=2, extra="edge.session_grace_ms = 300\nedge.lease_timeout_ms = 1000")
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
                wrong = hilrig("claim", codes["s1002"], f"127.0.0.1:{ports['rig1']}")
                assert (wrong.returncode, "is not valid for this rig" in wrong.stdout) == (1, True)
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
        eventually(lambda: {path.parent.name for path in lab.recordings} == {"rig1", "rig2"})
        log = lab.output()

    found = {open_run(path).students for path in lab.recordings}
    assert found == {("s1001",), ("s1002",)}
    assert all(re.search(r"-rig(1-s1001|2-s1002)-", path.name) for path in lab.recordings)
    everything = log.encode() + b"".join(content_of(path) for path in lab.recordings)
    assert not [name for name in NAMES.values() if name.encode() in everything]
    assert not [code for code in codes.values() if code.replace("-", "").encode() in everything]
