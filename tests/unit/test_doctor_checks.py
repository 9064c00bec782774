"""`hilrig doctor`: each check says what is wrong, and what to do about it."""

import socket
from collections.abc import Iterable
from contextlib import closing
from datetime import datetime, timedelta
from pathlib import Path

import pytest

from hilrig_cli.doctor import Finding, Level, host, services
from hilrig_cli.doctor.certificates import check_certificates
from hilrig_runtime.config.lab import LabConfig, parse_lab
from hilrig_runtime.security.x509 import Credential, issue_client, issue_peer, issue_server, load, make_authority
from hilrig_runtime.timing.realtime import realtime_priority
from hilrig_schemas import Health
from support.bus_certificates import HOSTS, NOW, make_bus_folder, write

NAMES = ["router", "sim", "edge", "recorder", "operator", "viewer"]


def by_level(findings: Iterable[Finding]) -> dict[Level, list[str]]:
    found: dict[Level, list[str]] = {level: [] for level in Level}
    for finding in findings:
        assert finding.mend or finding.level is not Level.WRONG, "what is wrong can be mended"
        found[finding.level].append(finding.text)
    return found


def only_wrong(findings: Iterable[Finding]) -> str:
    found = by_level(findings)
    [text] = found[Level.WRONG]
    return text


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    make_bus_folder(tmp_path / "bus", NAMES)
    return tmp_path / "bus"


def secured(folder: Path, more: str = "") -> LabConfig:
    return parse_lab(f'{more}\n[bus.tls]\nfolder = "{folder}"\n')


def reissue(folder: Path, name: str, days: int, begin: datetime = NOW, signed: Credential | None = None) -> None:
    authority = signed or load((folder / "ca.pem").read_bytes(), (folder / "ca.key").read_bytes())
    write(folder, name, issue_peer(authority, name, HOSTS, begin, days))


def test_good_certificates_are_good(folder: Path) -> None:
    for name in NAMES:
        reissue(folder, name, 300)
    for path in folder.glob("*.key"):
        path.chmod(0o600)
    found = by_level(check_certificates(secured(folder), NOW))
    # The authority itself was made for 30 days, which is soon.
    assert (len(found[Level.GOOD]), len(found[Level.NOTICE]), found[Level.WRONG]) == (len(NAMES), 1, [])


def test_a_lab_without_certificates_needs_none() -> None:
    assert by_level(check_certificates(parse_lab(""), NOW))[Level.WRONG] == []


def test_a_certificate_that_has_ended_is_named(folder: Path) -> None:
    reissue(folder, "edge", 9, NOW - timedelta(days=10))
    assert "edge.pem ended on" in only_wrong(check_certificates(secured(folder), NOW))


def test_a_clock_that_is_behind_shows_in_a_certificate_that_is_not_valid_yet(folder: Path) -> None:
    reissue(folder, "edge", 9, NOW + timedelta(days=1))
    assert "edge.pem is valid from" in only_wrong(check_certificates(secured(folder), NOW))


def test_a_certificate_of_another_authority_is_named(folder: Path) -> None:
    reissue(folder, "sim", 300, signed=make_authority("stranger", NOW, 300))
    assert "sim.pem is not signed by the authority" in only_wrong(check_certificates(secured(folder), NOW))


def test_a_certificate_under_another_name_is_named(folder: Path) -> None:
    for suffix in (".pem", ".key"):
        (folder / f"sim{suffix}").write_bytes((folder / f"viewer{suffix}").read_bytes())
    assert "sim.pem belongs to 'viewer'" in only_wrong(check_certificates(secured(folder), NOW))


def test_a_key_of_another_certificate_is_named(folder: Path) -> None:
    (folder / "sim.key").write_bytes((folder / "edge.key").read_bytes())
    assert "sim.key is the key of another certificate" in only_wrong(check_certificates(secured(folder), NOW))


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("ca.pem", None, "ca.pem can't be read"),
        ("ca.pem", "nothing", "ca.pem is no certificate"),
        ("sim.pem", "nothing", "sim.pem is no certificate"),
        ("sim.key", None, "sim.key can't be read"),
        ("sim.key", "nothing", "sim.key is no private key"),
    ],
)
def test_a_file_that_is_missing_or_something_else_is_named(
    folder: Path, name: str, content: str | None, said: str
) -> None:
    if content is None:
        (folder / name).unlink()
    else:
        (folder / name).write_text(content)
    assert said in only_wrong(check_certificates(secured(folder), NOW))


def test_a_folder_without_a_certificate_is_named(folder: Path) -> None:
    for path in folder.glob("*.pem"):
        if path.name != "ca.pem":
            path.unlink()
    assert "holds none of router, sim, edge" in only_wrong(check_certificates(secured(folder), NOW))


def test_a_router_that_others_reach_by_another_name_is_named(folder: Path) -> None:
    lab = parse_lab(f'[bus]\ntopology = "router"\nrouter = "tls/rig.example:7447"\n[bus.tls]\nfolder = "{folder}"\n')
    assert "others reach it as rig.example" in only_wrong(check_certificates(lab, NOW))


def test_a_key_that_others_may_read_is_noticed(folder: Path) -> None:
    for path in folder.glob("*.key"):
        path.chmod(0o600)
    (folder / "sim.key").chmod(0o644)
    notices = by_level(check_certificates(secured(folder), NOW))[Level.NOTICE]
    assert [text for text in notices if "can be read by others" in text] == [
        f"{folder / 'sim.key'} can be read by others than its owner"
    ]


def test_the_edges_certificate_for_modbus_is_looked_at_too(tmp_path: Path) -> None:
    authority = make_authority("controllers", NOW, 300)
    write(tmp_path, "ca", authority)
    write(tmp_path, "edge", issue_server(authority, HOSTS, NOW - timedelta(days=10), 9))
    files = {"certificate": "edge.pem", "key": "edge.key", "authority": "ca.pem"}
    lines = "\n".join(f'{key} = "{tmp_path / name}"' for key, name in files.items())
    lab = parse_lab(f"[edge.tls]\n{lines}\n")
    assert "edge.pem ended on" in only_wrong(check_certificates(lab, NOW))
    write(tmp_path, "edge", issue_client(make_authority("x", NOW, 9), "edge", "", NOW, 300))
    assert "edge.pem is not signed" in only_wrong(check_certificates(lab, NOW))


def test_a_port_that_another_program_has_is_named() -> None:
    with closing(socket.create_server(("127.0.0.1", 0))) as other:
        port = other.getsockname()[1]
        text = only_wrong(host.check_ports(parse_lab(f"[edge]\nfirst_port = {port}"), set()))
    assert f"rig 'rig1': 127.0.0.1:{port} can't be had" in text


def test_rigs_that_are_open_to_a_network_without_a_certificate_are_noticed() -> None:
    lab = parse_lab('[edge]\nhost = "0.0.0.0"\nfirst_port = 45020\n')
    assert any(
        "may take a rig without a certificate" in text for text in by_level(host.check_ports(lab, ()))[Level.NOTICE]
    )
    lab = parse_lab('[edge]\nhost = "0.0.0.0"\nfirst_port = 45020\n[[rigs]]\nallow = ["10.0.0.0/8"]\n')
    assert by_level(host.check_ports(lab, ()))[Level.NOTICE] == []


def test_too_few_open_files_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    resource = pytest.importorskip("resource")
    monkeypatch.setattr(resource, "getrlimit", lambda _: (256, 256))
    lab = parse_lab("[rigs]\ncount = 64\n")
    assert "256 may be open" in only_wrong(host.check_open_files(lab))
    monkeypatch.setattr(resource, "getrlimit", lambda _: (256, 100_000))
    assert by_level(host.check_open_files(lab))[Level.WRONG] == []


def test_a_machine_that_sleeps_too_long_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    times = iter(range(0, 10**12, 5_000_000))
    monkeypatch.setattr(host.time, "monotonic_ns", lambda: next(times))
    monkeypatch.setattr(host.time, "sleep", lambda _: None)
    [text] = by_level(host.check_punctuality(parse_lab("")))[Level.NOTICE]
    assert "95 % ended within 4.00 ms" in text


@pytest.mark.parametrize(("free_mib", "level"), [(10, Level.WRONG), (100, Level.NOTICE), (1_000_000, Level.GOOD)])
def test_a_disk_is_judged_by_what_is_free(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, free_mib: int, level: Level
) -> None:
    class Usage:
        free = free_mib * 2**20

    monkeypatch.setattr(host.shutil, "disk_usage", lambda _: Usage)
    lab = parse_lab(f'[recorder]\nfolder = "{tmp_path / "later"}"\n')
    [finding] = host.check_disk(lab)
    assert finding.level is level
    assert ("976.6 GiB free" if level is Level.GOOD else f"{free_mib} MiB free") in finding.text


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(host.os, "access", lambda *_: False)
    assert "can't be written" in only_wrong(host.check_disk(parse_lab(f'[recorder]\nfolder = "{tmp_path}"\n')))


def heard(*names: str, **fields: object) -> services.Heard:
    found = services.Heard(set(names))
    for name in names:
        service, _, instance = name.partition("/")
        report = {"software_version": "1.2.3", "wall_ns": 10**18} | fields
        found.healths[name] = Health(service=service, instance=instance, **report), 10**18  # type: ignore[arg-type]
    return found


ALL = ("sim/1", "edge/1", "recorder/1")


def test_a_service_that_is_missing_silent_or_in_trouble_is_named() -> None:
    lab = parse_lab("")
    assert by_level(services.check_services(lab, heard(*ALL)))[Level.WRONG] == []
    assert "no edge and no recorder runs" in only_wrong(services.check_services(lab, heard("sim/1")))
    silent = heard(*ALL)
    del silent.healths["edge/1"]
    assert "edge/1 shows that it lives, but says nothing" in only_wrong(services.check_services(lab, silent))
    troubled = heard(*ALL)
    troubled.healths["recorder/1"][0].alert = "the disk is full"
    assert "recorder/1: the disk is full" in only_wrong(services.check_services(lab, troubled))
    assert by_level(services.check_services(lab, heard()))[Level.NOTICE] == ["nothing of lab 'lab' runs"]


def test_a_service_that_the_system_did_not_grant_real_time_is_noticed_with_what_to_mend() -> None:
    lab = parse_lab("")
    [granted] = services.check_realtime(lab, heard(*ALL, realtime_priority=1))
    assert (granted.level, granted.text) == (Level.GOOD, "granted to edge/1 (priority 1), sim/1 (priority 1)")
    refused = heard("sim/1", "edge/1", realtime_priority=2)
    refused.healths["edge/1"][0].realtime_priority = 0
    refused.healths["edge/1"][0].host = "left"
    [finding] = services.check_realtime(lab, refused)
    assert finding.level is Level.NOTICE
    assert "edge/1 on left was not granted" in finding.text
    assert "rtprio 3" in finding.mend
    [unwanted] = services.check_realtime(parse_lab("realtime = false"), refused)
    assert unwanted.level is Level.GOOD
    assert "not asked for" in unwanted.text


@pytest.mark.parametrize("granted", [True, False])
def test_before_a_lab_runs_this_host_is_asked_for_real_time(granted: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(services, "go_realtime", lambda _: granted)
    [finding] = services.check_realtime(parse_lab(""), heard())
    assert finding.level is (Level.GOOD if granted else Level.NOTICE)
    assert "this host" in finding.text


def test_the_trial_leaves_this_thread_as_it_was() -> None:
    before = realtime_priority()
    list(services.check_realtime(parse_lab(""), heard()))
    assert realtime_priority() == before


def test_another_version_is_wrong_where_it_is_not_compatible() -> None:
    def judged(version: str, own: str) -> Level:
        reports = [Health(service="sim", instance="1", software_version=version)]
        [finding] = services.check_versions(reports, own)
        return finding.level

    assert judged("1.2.3", "1.2.3") is Level.GOOD
    assert judged("1.3.0", "1.2.3") is Level.NOTICE
    assert judged("2.0.0", "1.2.3") is Level.WRONG
    assert judged("0.1.4", "0.1.0") is Level.NOTICE
    assert judged("0.2.0", "0.1.0") is Level.WRONG
    assert judged("", "0.1.0") is Level.WRONG


@pytest.mark.parametrize(
    ("offset_s", "level"), [(0.02, Level.GOOD), (-5.0, Level.NOTICE), (5.0, Level.NOTICE), (7200.0, Level.WRONG)]
)
def test_a_clock_that_is_off_is_told_of(offset_s: float, level: Level) -> None:
    report = Health(service="sim", instance="1", host="left", wall_ns=round(1e18 + offset_s * 1e9))
    [finding] = services.check_clocks([(report, 10**18)])
    assert finding.level is level
    if level is not Level.GOOD:
        assert f"sim/1 on left is {abs(offset_s):.1f} s {'ahead of' if offset_s > 0 else 'behind'}" in finding.text


def test_without_a_router_the_bus_is_what_is_wrong() -> None:
    with closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
        lab = parse_lab(f'[bus]\ntopology = "router"\nrouter = "tcp/127.0.0.1:{port}"\n')
        findings, found = services.check_bus(lab)
    assert "no zenoh router answers" in only_wrong(findings)
    assert "certificates" not in findings[0].mend
    assert found is None


def test_a_host_without_a_certificate_of_a_command_is_told_which_one(folder: Path) -> None:
    for name in ("operator", "viewer"):
        (folder / f"{name}.key").unlink()
    findings, found = services.check_bus(secured(folder))
    assert "holds no operator.key or viewer.key" in only_wrong(findings)
    assert "viewer" in findings[0].mend
    assert found is None
