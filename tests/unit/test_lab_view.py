"""Status of a lab: `LabView` combines health reports; `hilrig top` and the Prometheus exporter show it."""

import re

import pytest

from hilrig_cli.commands.top import render
from hilrig_monitoring.lab_view import MAX_SERVICES, SILENT_AFTER_S, WINDOW_S, LabView
from hilrig_monitoring.prometheus import exposition
from hilrig_schemas import Health, RigReport


def sim(uptime_s: float = 1.0, cpu_s: float = 0.0, loops_us: tuple[int, ...] = (20_000, 20_100, 40_000)) -> Health:
    ages_us = [20_000, 40_000, 60_000]
    reports = [
        RigReport(rig="rig1", loop_us=loops_us, age_us=ages_us),
        RigReport(rig="rig2", safe=True, age_us=[900_000]),
    ]
    return Health(
        service="sim",
        instance="1",
        host="lab-pc",
        uptime_ns=round(uptime_s * 1e9),
        cpu_ns=round(cpu_s * 1e9),
        rigs=2,
        overruns=3,
        rig_reports=reports,
    )


def edge() -> Health:
    reports = [
        RigReport(rig="rig1", controller="192.168.7.2:4711", session="s", connections=2),
        RigReport(rig="rig2", watchdog_tripped=True),
    ]
    return Health(service="edge", instance="east", host='the "edge"', rigs=2, rig_reports=reports)


def view() -> LabView:
    made = LabView(("rig1", "rig2", "rig3"))
    made.update(sim(1.0, 0.2), 10.0)
    made.update(sim(3.0, 1.2), 11.0)
    made.update(edge(), 11.0)
    made.update(Health(service="recorder", instance="1", rig_reports=[RigReport(rig="rig1", recording=True)]), 11.0)
    return made


def test_rig_status_combines_reports_of_all_services() -> None:
    first, second, third = view().rigs(11.0)
    assert (first.controller, first.connections, first.recording, first.safe) == ("192.168.7.2:4711", 2, True, False)
    assert (first.loop_ms(0.0), first.loop_ms(0.5), first.loop_ms(0.99)) == (20.0, 20.1, 40.0)
    assert (second.watchdog_tripped, second.safe, second.loop_ms(0.5)) == (True, True, None)
    assert (third.served, third.simulated) == (False, False)


def test_age_is_that_of_a_rig_with_a_lease_holder() -> None:
    first, second, _ = view().rigs(11.0)
    assert (first.age_ms(0.5), first.age_ms(0.99)) == (40.0, 60.0)
    # A torque that its last controller left is not a loop.
    assert second.age_ms(0.5) is None


def test_rig_missing_in_the_file_is_shown() -> None:
    made = LabView(())
    made.update(sim(), 1.0)
    assert [rig.rig for rig in made.rigs(1.0)] == ["rig1", "rig2"]


def test_loop_latencies_expire_after_the_window() -> None:
    made = LabView(("rig1",))
    made.update(sim(loops_us=(90_000,)), 0.0)
    made.update(sim(loops_us=(20_000,)), WINDOW_S)
    assert made.rigs(WINDOW_S)[0].loop_ms(0.99) == 90.0
    assert made.rigs(WINDOW_S + 0.1)[0].loop_ms(0.99) == 20.0


def test_cpu_share_is_computed_within_one_process_lifetime() -> None:
    made = view()
    (_, _, service) = made.services()
    assert service.cpu_share == pytest.approx(0.5)
    restarted = sim(0.1, 0.1)
    restarted.incarnation = 2
    made.update(restarted, 12.0)
    assert made.services()[2].cpu_share == 0.0


def test_silent_service_raises_an_alert_and_stops_serving() -> None:
    made = view()
    made.update(sim(3.0, 1.0), 11.5 + SILENT_AFTER_S)
    (rig, *_) = made.rigs(11.5 + SILENT_AFTER_S)
    assert (rig.simulated, rig.served, rig.controller) == (True, False, "")
    assert 'edge/east on the "edge": silent for 4 s' in made.alerts(11.5 + SILENT_AFTER_S)


def test_alert_of_a_service_is_listed() -> None:
    made = LabView()
    made.update(Health(service="recorder", instance="1", host="lab-pc", alert="the disk is full"), 1.0)
    assert made.alerts(1.0) == ["recorder/1 on lab-pc: the disk is full"]


def test_low_terminal_keeps_the_slowest_loops() -> None:
    from rich.console import Console

    made = LabView()
    for number in range(50):
        made.update(
            Health(service="sim", instance="1", rig_reports=[RigReport(rig=f"r{number}", loop_us=[number * 1000])]), 1
        )
    reports = [RigReport(rig=f"r{number}") for number in range(50)]
    made.update(Health(service="sim", instance="1", rig_reports=reports), 1.0)
    console = Console(width=120, height=20, record=True, file=None, quiet=False)
    with console.capture() as capture:
        console.print(render(made, 1.0, 20))
    text = capture.get()
    assert len(text.splitlines()) <= 20
    assert "r49" in text
    assert "r3 " not in text
    assert re.search(r"and \d+ more rigs", text)


@pytest.mark.parametrize("width", [120, 70, 50])
def test_narrow_terminal_drops_whole_columns(width: int) -> None:
    from rich.console import Console

    console = Console(width=width)
    with console.capture() as capture:
        console.print(render(view(), 11.0, None, width))
    text = capture.get()
    assert "…" not in text
    assert all(len(line.rstrip()) <= width for line in text.splitlines())
    for always in ("service", "cpu %", "lost", "rig", "p99 ms", "state", "40.0"):
        assert always in text
    assert ("clock ms" in text) == (width == 120)
    assert ("controller" in text) == (width >= 70)


def test_json_contains_the_same_values() -> None:
    plain = view().as_dict(11.0)
    assert [service["service"] for service in plain["services"]] == ["edge", "recorder", "sim"]
    assert plain["rigs"][0]["loop_p99_ms"] == 40.0
    assert plain["rigs"][1]["loop_p99_ms"] is None
    assert plain["rigs"][0]["age_p99_ms"] == 60.0
    assert plain["services"][2]["cpu_percent"] == pytest.approx(50)


def test_metrics_are_in_prometheus_text_format() -> None:
    text = exposition(view(), "lab", 11.0)
    sample = re.compile(r'^hilrig_[a-z0-9_]+\{([a-z]+="(\\.|[^"\\])*",?)*\} -?[0-9.e+-]+$')
    for line in text.splitlines():
        assert line.startswith(("# HELP ", "# TYPE ")) or sample.match(line), line
    assert 'hilrig_overruns_total{lab="lab",service="sim",instance="1"} 3' in text
    assert 'hilrig_rig_loop_seconds{lab="lab",rig="rig1",quantile="0.99"} 0.04' in text
    assert 'hilrig_rig_age_seconds{lab="lab",rig="rig1",quantile="0.99"} 0.06' in text
    assert 'hilrig_rig_held{lab="lab",rig="rig2"} 0' in text
    families = re.findall(r"^# TYPE (\S+)", text, re.MULTILINE)
    assert len(families) == len(set(families))


def test_silent_service_keeps_its_counters_only() -> None:
    labels = '{lab="lab",service="sim",instance="1"}'
    current, later = (exposition(view(), "lab", now_s) for now_s in (11.0, 60.0))
    for name in ("up", "overruns_total", "lateness_p99_seconds"):
        assert f"hilrig_{name}{labels} " in current
    assert f"hilrig_up{labels} 0\n" in later
    assert f"hilrig_overruns_total{labels} 3\n" in later
    assert f"hilrig_lateness_p99_seconds{labels}" not in later


def test_reports_of_rigs_of_another_certificate_are_ignored() -> None:
    made = LabView(("rig1", "rig2"), lambda source, rig: (source, rig) != ("edge/east", "rig1"))
    forged = edge()
    forged.rig_reports[1].loop_us.append(1)
    made.update(forged, 1.0)
    first, second = made.rigs(1.0)
    assert (first.served, first.controller) == (False, "")
    assert (second.served, second.watchdog_tripped) == (True, True)
    assert second.loops_us == [], "the simulation reports latencies"


def test_kind_of_service_without_a_report_is_an_alert() -> None:
    """It was stopped, killed or cut off before the view was opened."""
    made = LabView(("rig1",))
    observer = edge()
    observer.peers.add(service="sim/1", host="lab-pc", silent_ns=12_000_000_000)
    made.update(observer, 1.0)
    assert made.alerts(1.0) == [], "the others report within a second"
    made.update(observer, 3.0)
    assert made.alerts(3.0) == [
        "no sim reports: run hilrig doctor; edge/east received the last message of sim/1 12 s ago",
        "no recorder reports: run hilrig doctor",
    ]


def test_services_are_bounded() -> None:
    made = LabView()
    for number in range(MAX_SERVICES + 9):
        made.update(Health(service="sim", instance=str(number)), 1.0)
    assert len(made.services()) == MAX_SERVICES
