"""`lab.toml`: defaults, and errors with the place, the accepted value and the value found."""

import re
from pathlib import Path

import pytest

from hilrig_runtime.config.lab import LabConfig, load_lab, parse_lab
from hilrig_runtime.errors import InputError


def test_default_lab_has_one_rig_on_loopback() -> None:
    lab = load_lab(None)
    assert [rig.name for rig in lab.rigs] == ["rig1"]
    assert lab.ports == {"rig1": 5020}
    assert lab.edge.host == "127.0.0.1"
    assert lab.sim.step_ns == 20_000_000


def test_free_ports_are_assigned_in_order() -> None:
    lab = parse_lab('[[rigs]]\nname="a"\n[[rigs]]\nname="b"\nport=5021\n[[rigs]]\nname="c"\n')
    assert lab.ports == {"a": 5020, "b": 5021, "c": 5022}


def test_group_of_rigs_and_single_rigs() -> None:
    lab = parse_lab(
        '[rigs]\ncount = 3\n[rigs.arm]\nl2_m = 0.2\n[[rigs.single]]\nname = "rig2"\nport = 6000\n'
        '[[rigs.single]]\nname = "teacher"\n'
    )
    assert lab.ports == {"rig1": 5020, "rig2": 6000, "rig3": 5021, "teacher": 5022}
    assert [rig.arm.l2_m for rig in lab.rigs] == [0.2, 0.3, 0.2, 0.3]


def test_rigs_have_one_port_at_several_addresses() -> None:
    text = '[[rigs]]\nname="a"\nport=502\nhost="10.0.0.1"\n[[rigs]]\nname="b"\nport=502\nhost="{}"\n'
    lab = parse_lab(text.format("10.0.0.2"))
    assert [lab.addresses()[rig]["Modbus TCP"] for rig in "ab"] == [("10.0.0.1", 502), ("10.0.0.2", 502)]
    for host in ("10.0.0.1", "0.0.0.0", "::"):
        with pytest.raises(InputError, match="port 502 is already used by another rig at the same address"):
            parse_lab(text.format(host))


def test_large_lab_is_parsed_quickly() -> None:
    lab = parse_lab("[rigs]\ncount = 2000\nprefix = 'seat-'\n")
    assert lab.addresses()["seat-2000"] == {"Modbus TCP": ("127.0.0.1", 7019)}


def test_addresses_match_listening_ports() -> None:
    tls = "[edge.tls]\ncertificate = 'c'\nkey = 'k'\nauthority = 'a'\nfirst_port = 8020\n"
    plain, secured = "Modbus TCP", "Modbus TCP with TLS"
    assert parse_lab("").addresses()["rig1"] == {plain: ("127.0.0.1", 5020)}
    assert parse_lab(tls).addresses()["rig1"] == {plain: ("127.0.0.1", 5020), secured: ("127.0.0.1", 8020)}
    assert parse_lab("[edge]\nplain = false\n" + tls).addresses()["rig1"] == {secured: ("127.0.0.1", 8020)}


def test_lab_keeps_its_source_text(tmp_path: Path) -> None:
    file = tmp_path / "lab.toml"
    file.write_text('name = "robotics"\n')
    assert load_lab(file).source == 'name = "robotics"\n'
    assert LabConfig().source == ""


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[sim\n", r"lab\.toml: invalid TOML: .*line 1"),
        ("[sim]\nstep = 20\n", r"lab\.toml: sim\.step: unknown key, did you mean step_ms\?"),
        ("[edge]\nwatchdogms = 3\n", r"edge\.watchdogms: unknown key, did you mean watchdog_ms\?"),
        ("[bus.tls]\nqqq = 3\n", r"bus\.tls\.qqq: unknown key; known keys are edges, folder$"),
        ("[[rigs]]\n[rigs.arm]\nl9_m = 3\n", r"rigs\[0\]\.arm\.l9_m: unknown key, did you mean l\d_m\?"),
        (
            "[impairment.command.delay]\nkind = 'gamma'\nmean = 3\nstd_ms = 1\n",
            r"gamma\.mean: unknown key, did you mean mean_ms",
        ),
        ("[impairment.command.delay]\nkind = 'gama'\n", r"kind must be one of 'constant', .*, got 'gama'"),
        ("[sim]\nintegrator = 'rk'\n", r"sim\.integrator: must be 'rkf45', .*'euler', got 'rk'"),
        ("sim = 3\n", r"sim: must be a table, got 3"),
        ('[sim]\nstep_ms = "fast"\n', r"lab\.toml: sim\.step_ms: must be a number, got 'fast'"),
        ("[sim]\nstep_ms = -1\n", r"sim\.step_ms: must be ≥ 0\.5, got -1"),
        ("[sim]\nstep_ms = nan\n", r"sim\.step_ms: must be ≤ 1000, got nan"),
        ('[[rigs]]\nname = "a b"\n', r"rigs\[0\]\.name: .*got 'a b'"),
        ('[[rigs]]\nname = "log"\n', r"rigs\[0\]: 'log' is a reserved name"),
        ('[[rigs]]\nname = "edge"\n', r"rigs\[0\]: 'edge' is a reserved name"),
        ('[[rigs]]\nname="a"\n[[rigs]]\nname="a"\n', r"duplicate rig name 'a'"),
        ('[[rigs]]\nname="a"\nport=5020\n[[rigs]]\nname="b"\nport=5020\n', r"port 5020 is already used by another rig"),
        ("[[rigs]]\nport = 70000\n", r"rigs\[0\]\.port: must be ≤ 65535, got 70000"),
        ("[edge]\nfirst_port=65535\n[[rigs]]\nname='a'\n[[rigs]]\nname='b'\n", r"no port available"),
        ('name = "a b"\n', r"name: must be 1 to 63 letters, digits, - and _, beginning .*, got 'a b'"),
        ('realtime = "yes"\n', r"realtime: must be true or false, got 'yes'"),
        ('[rigs]\ncount = "12"\n', r"rigs\.count: must be an integer, got '12'"),
        ('[sim]\nstep_ms = "20"\n', r"sim\.step_ms: must be a number, got '20'"),
        ("[rigs]\narm.masses_kg = [1, 1]\n", r"rigs\.arm\.masses_kg\[2\]: is missing"),
        ("rigs = []\n", r"rigs: .*at least 1"),
        ("[rigs]\ncount = 0\n", r"rigs\.count: must be ≥ 1, got 0"),
        ("[rigs]\ncount = 2\nprefx = 3\n", r"rigs\.prefx: unknown key, did you mean prefix\?"),
        ("[rigs]\n[[rigs.single]]\nname = 'a b'\n", r"rigs\.single\[0\]\.name: .*got 'a b'"),
        ("[rigs]\n[[rigs.single]]\nname='a'\n[[rigs.single]]\nname='a'\n", r"rigs: duplicate rig name 'a'"),
        ("[rigs]\n[rigs.arm]\nl2_m = -1\n", r"rigs\.arm\.l2_m: must be > 0, got -1"),
    ],
)
def test_invalid_value_is_reported_with_its_place(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        parse_lab(text)


def test_all_errors_are_reported_at_once() -> None:
    with pytest.raises(InputError) as caught:
        parse_lab("[sim]\nstep = 1\n[edge]\nhots = 2\n")
    assert len(str(caught.value).splitlines()) == 2


TLS = "[edge.tls]\ncertificate = 'edge.pem'\nkey = 'edge.key'\nauthority = 'ca.pem'\n[edge.tls.clients]\n"


def test_every_mistake_in_the_clients_is_reported() -> None:
    clients = (
        'alice = ["rig1"]\nAlice = ["*"]\n"CN=bob" = ["rig1"]\n"" = ["rig1"]\nnone = []\nall = ["*", "rig1"]\n'
        'twice = ["rig1", "rig1"]\nplc7 = ["rig7", "rig8"]\n'
    )
    with pytest.raises(InputError) as caught:
        parse_lab(TLS + clients)
    found = str(caught.value).splitlines()
    assert all(line.startswith("lab.toml: edge.tls.clients.") for line in found)
    expected = [
        r"alice: duplicate name",
        r"Alice: duplicate name",
        r"CN=bob: must be the common name .* without CN=",
        r": must be the common name",
        r"none: must have at least one rig",
        r'all: "\*" is every rig',
        r"twice: duplicate rig 'rig1'",
        r"plc7: unknown rig 'rig7'",
        r"plc7: unknown rig 'rig8'",
    ]
    assert len(found) == len(expected)
    for line, text in zip(found, expected, strict=True):
        assert re.match(rf"lab\.toml: edge\.tls\.clients\.{text}", line), line


def test_clients_write_to_the_rigs_of_their_lists() -> None:
    tls = parse_lab(TLS + 'alice = ["rig1"]\nplc7 = ["*"]\n').edge.tls
    assert tls is not None
    assert (tls.writers_of("rig1"), tls.writers_of("added")) == ({"alice", "plc7"}, {"plc7"})
    unlisted = parse_lab(TLS.removesuffix("[edge.tls.clients]\n")).edge.tls
    assert unlisted is not None
    assert unlisted.writers_of("rig1") is None


def test_missing_file_is_reported_in_one_line(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"none\.toml: no such file"):
        load_lab(tmp_path / "none.toml")


def test_binary_file_is_reported_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "lab.toml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="it is not UTF-8 text"):
        load_lab(tmp_path / "lab.toml")


def test_many_errors_are_counted() -> None:
    with pytest.raises(InputError) as raised:
        parse_lab("".join(f"key{number} = 1\n" for number in range(60_000)))
    lines = str(raised.value).splitlines()
    assert len(lines) == 21
    assert "key0: unknown key" in lines[0]
    assert lines[-1].endswith("59980 more errors")


def test_unknown_rig_error_lists_existing_rigs() -> None:
    with pytest.raises(InputError, match="unknown rig 'rig9'; this lab has rig1"):
        LabConfig().rig("rig9")
    with pytest.raises(InputError, match=r"this lab has rig1, (rig\d+, ){14}rig16 and 1984 more \(hilrig rig list\)$"):
        parse_lab("[rigs]\ncount = 2000\n").rig("rig9999")
