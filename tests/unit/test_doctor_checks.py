"""Checks of `hilrig doctor`: each reports its level, a text and a fix."""

import os
import shutil
import socket
import time
from collections.abc import Iterable
from contextlib import closing
from datetime import datetime, timedelta
from pathlib import Path
from unittest.mock import Mock

import pytest

from hilrig_cli.doctor import CheckResult, Level, host, services
from hilrig_cli.doctor.certificates import check_certificates
from hilrig_cli.doctor.host_services import check_here, parse_kinds, services_elsewhere
from hilrig_cli.doctor.processes import LocalProcess, RouterState
from hilrig_runtime.config.lab import LabConfig, parse_lab
from hilrig_runtime.errors import InputError, OperationError
from hilrig_runtime.process.discovery import ClockOffset
from hilrig_runtime.security.x509 import Credential, issue_client, issue_peer, issue_server, load, make_authority
from hilrig_runtime.timing.realtime import realtime_priority
from hilrig_schemas import Health
from support.bus_certificates import HOSTS, NOW, make_bus_folder, write

NAMES = ["router", "sim", "edge", "recorder", "operator", "viewer"]


def by_level(results: Iterable[CheckResult]) -> dict[Level, list[str]]:
    texts: dict[Level, list[str]] = {level: [] for level in Level}
    for result in results:
        assert result.fix or result.level is not Level.ERROR, "every error has a fix"
        texts[result.level].append(result.text)
    return texts


def only_error(results: Iterable[CheckResult]) -> str:
    [text] = by_level(results)[Level.ERROR]
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


def test_valid_certificates_are_ok(folder: Path) -> None:
    for name in NAMES:
        reissue(folder, name, 300)
    for path in folder.glob("*.key"):
        path.chmod(0o600)
    found = by_level(check_certificates(secured(folder), NOW))
    # The authority itself expires in 30 days.
    assert (len(found[Level.OK]), len(found[Level.WARNING]), found[Level.ERROR]) == (len(NAMES), 1, [])


def test_lab_without_tls_needs_no_certificates() -> None:
    assert by_level(check_certificates(parse_lab(""), NOW))[Level.ERROR] == []


def test_expired_certificate_is_an_error(folder: Path) -> None:
    reissue(folder, "edge", 9, NOW - timedelta(days=10))
    assert "edge.pem: expired on" in only_error(check_certificates(secured(folder), NOW))


def test_certificate_of_the_future_is_an_error(folder: Path) -> None:
    reissue(folder, "edge", 9, NOW + timedelta(days=1))
    assert "edge.pem: not valid before" in only_error(check_certificates(secured(folder), NOW))


def test_certificate_of_another_authority_is_an_error(folder: Path) -> None:
    reissue(folder, "sim", 300, signed=make_authority("other", NOW, 300))
    assert "sim.pem: not signed by the configured authority" in only_error(check_certificates(secured(folder), NOW))


def test_certificate_with_another_common_name_is_an_error(folder: Path) -> None:
    for suffix in (".pem", ".key"):
        (folder / f"sim{suffix}").write_bytes((folder / f"viewer{suffix}").read_bytes())
    assert "sim.pem: its common name is 'viewer', expected 'sim'" in only_error(
        check_certificates(secured(folder), NOW)
    )


def test_key_of_another_certificate_is_an_error(folder: Path) -> None:
    (folder / "sim.key").write_bytes((folder / "edge.key").read_bytes())
    assert "sim.key: does not match its certificate" in only_error(check_certificates(secured(folder), NOW))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("ca.pem", None, "ca.pem: can't be read"),
        ("ca.pem", "nothing", "ca.pem: not a valid certificate"),
        ("sim.pem", "nothing", "sim.pem: not a valid certificate"),
        ("sim.key", None, "sim.key: can't be read"),
        ("sim.key", "nothing", "sim.key: not a valid private key"),
    ],
)
def test_missing_or_invalid_file_is_an_error(folder: Path, name: str, content: str | None, message: str) -> None:
    if content is None:
        (folder / name).unlink()
    else:
        (folder / name).write_text(content)
    assert message in only_error(check_certificates(secured(folder), NOW))


def test_folder_without_certificates_is_an_error(folder: Path) -> None:
    for path in folder.glob("*.pem"):
        if path.name != "ca.pem":
            path.unlink()
    assert "no certificate of router, sim, edge" in only_error(check_certificates(secured(folder), NOW))


def test_router_certificate_without_its_host_name_is_an_error(folder: Path) -> None:
    lab = parse_lab(f'[bus]\ntopology = "router"\nrouter = "tls/rig.example:7447"\n[bus.tls]\nfolder = "{folder}"\n')
    assert "but peers connect to rig.example" in only_error(check_certificates(lab, NOW))


def test_key_readable_by_others_is_a_warning(folder: Path) -> None:
    for path in folder.glob("*.key"):
        path.chmod(0o600)
    (folder / "sim.key").chmod(0o644)
    warnings = by_level(check_certificates(secured(folder), NOW))[Level.WARNING]
    assert [text for text in warnings if "readable by other users" in text] == [
        f"{folder / 'sim.key'}: readable by other users than its owner"
    ]


def test_modbus_certificate_of_the_edge_is_checked(tmp_path: Path) -> None:
    authority = make_authority("controllers", NOW, 300)
    write(tmp_path, "ca", authority)
    write(tmp_path, "edge", issue_server(authority, HOSTS, NOW - timedelta(days=10), 9))
    files = {"certificate": "edge.pem", "key": "edge.key", "authority": "ca.pem"}
    lines = "\n".join(f'{key} = "{tmp_path / name}"' for key, name in files.items())
    lab = parse_lab(f"[edge.tls]\n{lines}\n")
    assert "edge.pem: expired on" in only_error(check_certificates(lab, NOW))
    write(tmp_path, "edge", issue_client(make_authority("x", NOW, 9), "edge", "", NOW, 300))
    assert "edge.pem: not signed" in only_error(check_certificates(lab, NOW))


def test_port_used_by_another_program_is_an_error() -> None:
    with closing(socket.create_server(("127.0.0.1", 0))) as other:
        port = other.getsockname()[1]
        lab = parse_lab(f"[edge]\nfirst_port = {port}")
        text = only_error(host.check_ports(lab, set()))
        stopped = list(host.check_ports(lab, set(), is_edge_stopped=True))
    assert f"rig 'rig1': 127.0.0.1:{port} is unavailable" in text
    assert by_level(stopped)[Level.ERROR] == [], "a stopped edge has its ports"


def test_rigs_without_access_control_are_a_warning() -> None:
    lab = parse_lab('[edge]\nhost = "0.0.0.0"\nfirst_port = 45020\n')
    [text] = by_level(host.check_ports(lab, ()))[Level.WARNING]
    assert "can control a rig without a certificate" in text
    lab = parse_lab('[edge]\nhost = "0.0.0.0"\nfirst_port = 45020\n[[rigs]]\nallow = ["10.0.0.0/8"]\n')
    assert by_level(host.check_ports(lab, ()))[Level.WARNING] == []


def test_low_limit_of_open_files_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    resource = pytest.importorskip("resource")
    monkeypatch.setattr(resource, "getrlimit", lambda _: (256, 256))
    lab = parse_lab("[rigs]\ncount = 64\n")
    assert "limit 256" in only_error(host.check_open_files(lab))
    monkeypatch.setattr(resource, "getrlimit", lambda _: (256, 100_000))
    assert by_level(host.check_open_files(lab))[Level.ERROR] == []


def test_late_sleeps_are_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    times = iter(range(0, 10**12, 5_000_000))
    monkeypatch.setattr(time, "monotonic_ns", lambda: next(times))
    monkeypatch.setattr(time, "sleep", lambda _: None)
    [text] = by_level(host.check_timer_accuracy(parse_lab("")))[Level.WARNING]
    assert "p95 4.00 ms" in text


@pytest.mark.parametrize(("free_mib", "level"), [(10, Level.ERROR), (100, Level.WARNING), (1_000_000, Level.OK)])
def test_level_of_the_disk_check_depends_on_free_space(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, free_mib: int, level: Level
) -> None:
    class Usage:
        free = free_mib * 2**20

    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage)
    lab = parse_lab(f'[recorder]\nfolder = "{tmp_path / "later"}"\n')
    [result] = host.check_disk(lab)
    assert result.level is level
    assert ("976.6 GiB free" if level is Level.OK else f"{free_mib} MiB free") in result.text


def test_folder_without_write_permission_is_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)
    assert "can't be written" in only_error(host.check_disk(parse_lab(f'[recorder]\nfolder = "{tmp_path}"\n')))


def snapshot(*names: str, **fields: object) -> services.BusSnapshot:
    made = services.BusSnapshot(set(names))
    for name in names:
        service, _, instance = name.partition("/")
        report = {"software_version": "1.2.3", "wall_ns": 10**18} | fields
        made.healths[name] = Health(service=service, instance=instance, **report)  # type: ignore[arg-type]
    return made


ALL_SERVICES = ("sim/1", "edge/1", "recorder/1")


def test_missing_silent_or_alerting_service_is_an_error() -> None:
    lab = parse_lab("")
    assert by_level(services.check_services(lab, snapshot(*ALL_SERVICES)))[Level.ERROR] == []
    errors = by_level(services.check_services(lab, snapshot("sim/1")))[Level.ERROR]
    assert errors == [f"not running: {name}: no process on this host" for name in ("edge", "recorder")]
    silent = snapshot(*ALL_SERVICES)
    del silent.healths["edge/1"]
    assert "edge/1: alive, but sends no health reports" in only_error(services.check_services(lab, silent))
    alerting = snapshot(*ALL_SERVICES)
    alerting.healths["recorder/1"].alert = "the disk is full"
    assert "recorder/1: the disk is full" in only_error(services.check_services(lab, alerting))
    assert by_level(services.check_services(lab, snapshot()))[Level.WARNING] == ["no service of lab 'lab' is running"]


ROUTED = '[bus]\ntopology = "router"\nrouter = "tcp/hub:7447"\n'


def seen_without(name: str, silent_s: float) -> services.BusSnapshot:
    """A snapshot of a lab whose recorder received the last message of a service some time ago."""
    found = snapshot(*(other for other in ALL_SERVICES if other != name))
    found.healths["recorder/1"].peers.add(service=name, host="left", silent_ns=round(silent_s * 1e9))
    return found


def test_service_on_another_host_is_not_to_be_restarted() -> None:
    for is_alive in (False, True):
        found = seen_without("sim/1", 12.3)
        found.alive |= {"sim/1"} if is_alive else set()
        [error] = [one for one in services.check_services(parse_lab(ROUTED), found) if one.level is Level.ERROR]
        assert "sim/1 on left: recorder/1 received its last message 12.3 s ago" in error.text
        assert error.fix.startswith("run hilrig doctor on left first")
        assert "not running" not in error.text, "a cut link looks the same"


@pytest.mark.parametrize("is_alive", [False, True])
def test_stopped_process_of_this_host_is_to_be_continued(is_alive: bool) -> None:
    found = seen_without("sim/1", 12.3)
    found.alive |= {"sim/1"} if is_alive else set()
    local = [LocalProcess("sim", 4711, is_stopped=True)]
    [error] = [one for one in services.check_services(parse_lab(ROUTED), found, local) if one.level is Level.ERROR]
    assert (error.text.partition(":")[0], error.fix) == (
        "sim on this host is stopped (process 4711)",
        "continue it: kill -CONT 4711",
    )


@pytest.mark.parametrize("is_alive", [False, True])
def test_running_process_of_this_host_is_not_to_be_restarted(is_alive: bool) -> None:
    found = seen_without("sim/1", 12.3)
    found.alive |= {"sim/1"} if is_alive else set()
    local = [LocalProcess("sim", 4711, is_stopped=False)]
    [error] = [one for one in services.check_services(parse_lab(ROUTED), found, local) if one.level is Level.ERROR]
    assert "4711" in error.text + error.fix
    assert "do not restart it" in error.fix
    secured = parse_lab("[bus.tls]\n")
    [error] = [one for one in services.check_services(secured, snapshot("edge/1", "recorder/1"), local) if one.fix]
    assert error.fix.endswith("check the certificates below"), "only a valid certificate is answered in a mesh"


@pytest.mark.parametrize(
    ("state", "advice"),
    [
        (RouterState.REFUSES, "check on hub whether the router runs"),
        (RouterState.UNREACHABLE, "check the network link of this host first"),
        (RouterState.ACCEPTS, "check on hub whether the router is stopped"),
    ],
)
def test_router_link_and_services_are_told_apart(
    state: RouterState, advice: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(services, "probe_router", lambda _: state)
    monkeypatch.setattr(services, "collect", Mock(side_effect=OperationError("no zenoh router answers")))
    local = [LocalProcess("sim", 4711, is_stopped=False), LocalProcess("edge", 4712, is_stopped=True)]
    results, joined = services.check_bus(parse_lab(ROUTED), local)
    assert joined is None
    assert state.value in results[0].text
    assert results[0].fix.startswith(advice)
    assert results[1].fix == "do not restart it: it continues when the router answers"
    assert results[2].fix == "continue it: kill -CONT 4712"


def two_edges(*, is_west_alive: bool) -> services.BusSnapshot:
    names = ("sim/1", "edge/east", "recorder/1") + ("edge/west",) * is_west_alive
    found = snapshot(*names)
    served = {"sim/1": ["rig1", "rig2"], "edge/east": ["rig1"], "edge/west": ["rig2"]}
    for name in set(served) & set(names):
        for rig in served[name]:
            found.healths[name].rig_reports.add(rig=rig)
    found.healths["recorder/1"].peers.add(service="edge/west", host="left", silent_ns=12_300_000_000)
    return found


def test_lost_instance_of_several_is_an_error() -> None:
    lab = parse_lab(f"{ROUTED}[rigs]\ncount = 3\n")
    # Rig 3 was removed from the running lab.
    assert by_level(services.check_services(lab, two_edges(is_west_alive=True)))[Level.ERROR] == []
    lost = two_edges(is_west_alive=False)
    [error] = [one for one in services.check_services(lab, lost) if one.level is Level.ERROR]
    assert error.text == (
        "not connected: edge of rig2; edge/west on left: recorder/1 received its last message 12.3 s ago"
    )
    assert error.fix.startswith("run hilrig doctor on left first")
    assert "hilrig edge --instance NAME --rigs rig2" in error.fix


def test_stopped_instance_of_several_is_to_be_continued() -> None:
    lab = parse_lab(f"{ROUTED}[rigs]\ncount = 2\n")
    local = [LocalProcess("edge", 1, is_stopped=False, instance="east"), LocalProcess("edge", 2, True, "west")]
    for is_alive in (True, False):
        found = two_edges(is_west_alive=is_alive)
        found.healths.pop("edge/west", None)
        [error] = [one for one in services.check_services(lab, found, local) if one.level is Level.ERROR]
        assert "edge/west on this host is stopped" in error.text
        assert error.fix == "continue it: kill -CONT 2"


def test_denied_realtime_policy_is_a_warning_with_a_fix() -> None:
    lab = parse_lab("")
    [granted] = services.check_realtime(lab, snapshot(*ALL_SERVICES, realtime_priority=1))
    assert (granted.level, granted.text) == (Level.OK, "granted to edge/1 (priority 1), sim/1 (priority 1)")
    refused = snapshot("sim/1", "edge/1", realtime_priority=2)
    refused.healths["edge/1"].realtime_priority = 0
    refused.healths["edge/1"].host = "left"
    [result] = services.check_realtime(lab, refused)
    assert result.level is Level.WARNING
    assert "edge/1 on left: real-time policy not granted" in result.text
    assert "rtprio 3" in result.fix
    [disabled] = services.check_realtime(parse_lab("realtime = false"), refused)
    assert disabled.level is Level.OK
    assert "not requested" in disabled.text


@pytest.mark.parametrize("granted", [True, False])
def test_realtime_policy_of_the_host_is_tried_without_services(granted: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(services, "go_realtime", lambda _: granted)
    [result] = services.check_realtime(parse_lab(""), snapshot())
    assert result.level is (Level.OK if granted else Level.WARNING)
    assert "this host" in result.text


def test_realtime_trial_does_not_change_this_thread() -> None:
    before = realtime_priority()
    list(services.check_realtime(parse_lab(""), snapshot()))
    assert realtime_priority() == before


def test_incompatible_version_is_an_error() -> None:
    def level_of(version: str, own: str) -> Level:
        reports = [Health(service="sim", instance="1", software_version=version)]
        [result] = services.check_versions(reports, own)
        return result.level

    assert level_of("1.2.3", "1.2.3") is Level.OK
    assert level_of("1.3.0", "1.2.3") is Level.WARNING
    assert level_of("2.0.0", "1.2.3") is Level.ERROR
    assert level_of("0.1.4", "0.1.0") is Level.WARNING
    assert level_of("0.2.0", "0.1.0") is Level.ERROR
    assert level_of("", "0.1.0") is Level.ERROR


@pytest.mark.parametrize(
    ("offset_s", "level"), [(0.02, Level.OK), (-5.0, Level.WARNING), (5.0, Level.WARNING), (7200.0, Level.ERROR)]
)
def test_level_of_the_clock_check_depends_on_the_offset(offset_s: float, level: Level) -> None:
    near = ("edge/1 on right", ClockOffset("edge/1", 9_000_000_000, 9_000_000_000))
    far = ("sim/1 on left", ClockOffset("sim/1", round(offset_s * 1e9), 500_000_000))
    [result] = services.check_clocks([near, far])
    assert result.level is level
    if level is not Level.OK:
        where = "ahead of" if offset_s > 0 else "behind"
        assert f"sim/1 on left is {abs(offset_s):.1f} ± 0.5 s {where} this" in result.text


def test_offset_within_its_uncertainty_is_no_finding() -> None:
    """The reply of a host took 140 s, because a service or link was stopped."""
    clocks = [("sim/1 on left", ClockOffset("sim/1", 69_000_000_000, 70_000_000_000))]
    assert [result.level for result in services.check_clocks(clocks)] == [Level.OK]
    assert list(services.check_clocks([])) == []


def test_missing_router_is_an_error_of_the_bus() -> None:
    with closing(socket.socket()) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
        lab = parse_lab(f'[bus]\ntopology = "router"\nrouter = "tcp/127.0.0.1:{port}"\n')
        results, joined = services.check_bus(lab)
    assert "no zenoh router answers" in only_error(results)
    assert "certificates" not in results[0].fix
    assert joined is None


def test_missing_certificate_of_a_command_is_named(folder: Path) -> None:
    for name in ("operator", "viewer"):
        (folder / f"{name}.key").unlink()
    results, joined = services.check_bus(secured(folder))
    assert "does not contain operator.key or viewer.key" in only_error(results)
    assert "viewer" in results[0].fix
    assert joined is None


ROUTER_HERE = "[bus]\ntopology = 'router'\nrouter = 'tcp/127.0.0.1:7447'\n"


def test_lab_without_a_router_runs_on_this_host() -> None:
    assert services_elsewhere(LabConfig(), services.BusSnapshot(), []) == {}


def test_host_is_not_checked_for_an_edge_with_another_address() -> None:
    # 192.0.2.0/24 is reserved for documentation: no host has such an address.
    lab = parse_lab(f"{ROUTER_HERE}[edge]\nhost = '192.0.2.7'\n")
    assert services_elsewhere(lab, services.BusSnapshot(), []) == {"edge": "edge.host is 192.0.2.7"}
    # Its process proves that it runs here.
    assert services_elsewhere(lab, services.BusSnapshot(), [LocalProcess("edge", 1, is_stopped=False)]) == {}
    [found] = check_here({"edge": "edge.host is 192.0.2.7"}, [], ())
    assert found.text == (
        "services that it is checked for: sim, recorder, router; not checked for edge: edge.host is 192.0.2.7"
    )


def test_host_is_not_checked_for_services_without_certificate(tmp_path: Path) -> None:
    folder = tmp_path / "bus"
    make_bus_folder(folder, ["recorder", "viewer"])
    routed = ROUTER_HERE.replace("tcp/127.0.0.1", "tls/192.0.2.9")
    lab = parse_lab(f"{routed}[bus.tls]\nfolder = '{folder}'\n")
    found = services_elsewhere(lab, services.BusSnapshot(), [])
    missing = f"{folder} has no certificate for it"
    assert found == {"sim": missing, "edge": missing, "router": "bus.router is on 192.0.2.9"}


def test_host_is_not_checked_for_a_service_that_runs_on_another() -> None:
    snapshot = services.BusSnapshot(healths={"sim/1": Health(service="sim", instance="1", host="left")})
    assert services_elsewhere(parse_lab(ROUTER_HERE), snapshot, []) == {"sim": "runs on left"}


def test_named_services_must_run_on_this_host() -> None:
    chosen = parse_kinds("edge, recorder")
    assert set(services_elsewhere(LabConfig(), services.BusSnapshot(), [], chosen)) == {"sim", "router"}
    results = list(check_here({}, [LocalProcess("edge", 1, is_stopped=False)], chosen))
    assert only_error(results) == "recorder is named with --here, but has no process on this host"
    with pytest.raises(InputError, match="--here: expected services of sim, edge, recorder, router"):
        parse_kinds("simulation")
