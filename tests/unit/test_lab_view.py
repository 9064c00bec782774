"""What `hilrig top` shows: reports of several services come together, and what is silent is said to be."""

import re
import threading
import urllib.error
import urllib.request
from contextlib import closing

import pytest

from hilrig_cli.commands.top import picture
from hilrig_monitoring.lab_view import SILENT_S, WINDOW_S, LabView
from hilrig_monitoring.prometheus import exposition, metrics_server
from hilrig_schemas import Health, RigReport


def sim(uptime_s: float = 1.0, cpu_s: float = 0.0, loops_us: tuple[int, ...] = (20_000, 20_100, 40_000)) -> Health:
    reports = [RigReport(rig="rig1", loop_us=loops_us), RigReport(rig="rig2", safe=True)]
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
    made.hear(sim(1.0, 0.2), 10.0)
    made.hear(sim(3.0, 1.2), 11.0)
    made.hear(edge(), 11.0)
    made.hear(Health(service="recorder", instance="1", rig_reports=[RigReport(rig="rig1", recording=True)]), 11.0)
    return made


def test_each_rig_has_what_each_service_knows_of_it() -> None:
    first, second, third = view().rigs(11.0)
    assert (first.controller, first.connections, first.recording, first.safe) == ("192.168.7.2:4711", 2, True, False)
    assert (first.loop_ms(0.0), first.loop_ms(0.5), first.loop_ms(0.99)) == (20.0, 20.1, 40.0)
    assert (second.watchdog_tripped, second.safe, second.loop_ms(0.5)) == (True, True, None)
    assert (third.served, third.simulated) == (False, False)


def test_a_rig_that_the_file_does_not_have_is_shown_too() -> None:
    made = LabView(())
    made.hear(sim(), 1.0)
    assert [rig.rig for rig in made.rigs(1.0)] == ["rig1", "rig2"]


def test_loops_are_forgotten_when_the_window_has_passed() -> None:
    made = LabView(("rig1",))
    made.hear(sim(loops_us=(90_000,)), 0.0)
    made.hear(sim(loops_us=(20_000,)), WINDOW_S)
    assert made.rigs(WINDOW_S)[0].loop_ms(0.99) == 90.0
    assert made.rigs(WINDOW_S + 0.1)[0].loop_ms(0.99) == 20.0


def test_the_share_of_a_processor_is_between_two_reports_of_one_run() -> None:
    made = view()
    (_, _, service) = made.services()
    assert service.cpu_share == pytest.approx(0.5)
    restarted = sim(0.1, 0.1)
    restarted.incarnation = 2
    made.hear(restarted, 12.0)
    assert made.services()[2].cpu_share == 0.0


def test_a_silent_service_is_said_to_be_and_its_rigs_are_not_served_any_more() -> None:
    made = view()
    made.hear(sim(3.0, 1.0), 11.5 + SILENT_S)
    (rig, *_) = made.rigs(11.5 + SILENT_S)
    assert (rig.simulated, rig.served, rig.controller) == (True, False, "")
    assert 'edge/east on the "edge": silent for 4 s' in made.troubles(11.5 + SILENT_S)


def test_what_troubles_a_service_is_told() -> None:
    made = LabView()
    made.hear(Health(service="recorder", instance="1", host="lab-pc", alert="the disk is full"), 1.0)
    assert made.troubles(1.0) == ["recorder/1 on lab-pc: the disk is full"]


def test_in_a_low_terminal_the_slowest_loops_stay() -> None:
    from rich.console import Console

    made = LabView()
    for number in range(50):
        made.hear(
            Health(service="sim", instance="1", rig_reports=[RigReport(rig=f"r{number}", loop_us=[number * 1000])]), 1
        )
    reports = [RigReport(rig=f"r{number}") for number in range(50)]
    made.hear(Health(service="sim", instance="1", rig_reports=reports), 1.0)
    console = Console(width=120, height=20, record=True, file=None, quiet=False)
    with console.capture() as capture:
        console.print(picture(made, 1.0, 20))
    text = capture.get()
    assert len(text.splitlines()) <= 20
    assert "r49" in text
    assert "r3 " not in text
    assert re.search(r"and \d+ rigs more", text)


@pytest.mark.parametrize("width", [120, 70, 50])
def test_in_a_narrow_terminal_columns_are_left_out_and_none_is_cut(width: int) -> None:
    from rich.console import Console

    console = Console(width=width)
    with console.capture() as capture:
        console.print(picture(view(), 11.0, None, width))
    text = capture.get()
    assert "…" not in text
    assert all(len(line.rstrip()) <= width for line in text.splitlines())
    for always in ("service", "cpu %", "lost", "rig", "p99 ms", "state", "40.0"):
        assert always in text
    assert ("clock ms" in text) == (width == 120)
    assert ("controller" in text) == (width >= 70)


def test_json_says_the_same() -> None:
    plain = view().as_dict(11.0)
    assert [service["service"] for service in plain["services"]] == ["edge", "recorder", "sim"]
    assert plain["rigs"][0]["loop_p99_ms"] == 40.0
    assert plain["rigs"][1]["loop_p99_ms"] is None
    assert plain["services"][2]["cpu_percent"] == pytest.approx(50)


def test_metrics_are_in_prometheus_text_format() -> None:
    text = exposition(view(), "lab", 11.0)
    sample = re.compile(r'^hilrig_[a-z0-9_]+\{([a-z]+="(\\.|[^"\\])*",?)*\} -?[0-9.e+-]+$')
    for line in text.splitlines():
        assert line.startswith(("# HELP ", "# TYPE ")) or sample.match(line), line
    assert 'hilrig_overruns_total{lab="lab",service="sim",instance="1"} 3' in text
    assert 'hilrig_rig_loop_seconds{lab="lab",rig="rig1",quantile="0.99"} 0.04' in text
    assert 'hilrig_rig_held{lab="lab",rig="rig2"} 0' in text
    families = re.findall(r"^# TYPE (\S+)", text, re.MULTILINE)
    assert len(families) == len(set(families))


def test_of_a_silent_service_counters_stay_and_what_it_was_like_is_not_told() -> None:
    labels = '{lab="lab",service="sim",instance="1"}'
    heard, later = (exposition(view(), "lab", now_s) for now_s in (11.0, 60.0))
    for name in ("up", "overruns_total", "lateness_p99_seconds"):
        assert f"hilrig_{name}{labels} " in heard
    assert f"hilrig_up{labels} 0\n" in later
    assert f"hilrig_overruns_total{labels} 3\n" in later
    assert f"hilrig_lateness_p99_seconds{labels}" not in later


def test_metrics_are_served_at_their_path_alone() -> None:
    with metrics_server(("127.0.0.1", 0), lambda: "a 1\n") as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        address = f"http://127.0.0.1:{server.server_port}"
        with closing(urllib.request.urlopen(f"{address}/metrics", timeout=5)) as answer:
            assert (answer.read(), answer.headers["Content-Type"].split(";")[0]) == (b"a 1\n", "text/plain")
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(f"{address}/", timeout=5)
        server.shutdown()
        thread.join(5)
