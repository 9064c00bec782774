"""Metrics of a lab in the text exposition format of Prometheus, version 0.0.4."""

from collections.abc import Callable, Iterable, Iterator
from typing import Final

from hilrig_monitoring.lab_view import LabView, RigStatus, ServiceStatus

CONTENT_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"
_SERVICE_METRICS: Final[tuple[tuple[str, str, str, str, float], ...]] = (
    ("uptime_seconds", "gauge", "Time since the start of the process.", "uptime_ns", 1e-9),
    ("cpu_seconds_total", "counter", "CPU time used by all threads.", "cpu_ns", 1e-9),
    ("resident_bytes", "gauge", "Resident memory.", "resident_bytes", 1),
    ("rigs", "gauge", "Rigs served.", "rigs", 1),
    ("ticks_total", "counter", "Ticks of the service's loop.", "ticks", 1),
    ("overruns_total", "counter", "Ticks that began more than a period late.", "overruns", 1),
    ("missed_steps_total", "counter", "Steps skipped because of overruns.", "missed_steps", 1),
    ("inaccurate_steps_total", "counter", "Steps of a rig with a too large error estimate.", "inaccurate_steps", 1),
    ("lateness_p50_seconds", "gauge", "Tick lateness in the last second, p50.", "lateness_p50_ns", 1e-9),
    ("lateness_p99_seconds", "gauge", "Tick lateness in the last second, p99.", "lateness_p99_ns", 1e-9),
    ("lateness_max_seconds", "gauge", "Tick lateness in the last second, maximum.", "lateness_max_ns", 1e-9),
    ("run_delay_seconds", "gauge", "Time without a processor in the last second.", "run_delay_ns", 1e-9),
    ("realtime_priority", "gauge", "SCHED_FIFO priority; 0: ordinary policy.", "realtime_priority", 1),
    ("received_per_second", "gauge", "Messages received.", "received_hz", 1),
    ("published_per_second", "gauge", "Messages published.", "published_hz", 1),
    ("lost_transport_total", "counter", "Messages lost on the bus.", "lost_transport", 1),
    ("lost_recorder_total", "counter", "Messages dropped because a queue was full.", "lost_recorder", 1),
    ("queue_entries", "gauge", "Entries in the service's queue.", "queue_depth", 1),
    ("connections", "gauge", "Modbus connections open.", "connections", 1),
    ("requests_total", "counter", "Modbus requests answered, also with an exception.", "requests", 1),
    ("malformed_total", "counter", "Malformed messages and connections with malformed frames.", "malformed", 1),
    ("refused_total", "counter", "Connections refused, and writes without lease or permission.", "refused", 1),
    ("recordings", "gauge", "Open recordings.", "recordings", 1),
    ("written_bytes_total", "counter", "Bytes written to recordings.", "bytes_written", 1),
    ("clock_offset_seconds", "gauge", "Largest wall clock offset to another service.", "clock_offset_ns", 1e-9),
    ("clock_uncertainty_seconds", "gauge", "Uncertainty of this offset.", "clock_uncertainty_ns", 1e-9),
)


def exposition(view: LabView, lab: str, now_s: float) -> str:
    """Format all metrics of a view as text; `now_s` is a time of the clock that the view is updated with."""
    return "".join(f"{line}\n" for line in _lines(view, lab, now_s))


def _lines(view: LabView, lab: str, now_s: float) -> Iterator[str]:
    services = view.services()

    def of_services(name: str, kind: str, text: str, value: Callable[[ServiceStatus], float]) -> Iterator[str]:
        # Gauges of a silent service are outdated; its counters remain valid.
        valid = (s for s in services if kind == "counter" or name == "up" or not view.is_silent(s, now_s))
        labeled = ((_labels(lab=lab, service=s.health.service, instance=s.health.instance), value(s)) for s in valid)
        yield from _family(name, kind, text, labeled)

    yield from of_services("up", "gauge", "Whether the service reports.", lambda s: not view.is_silent(s, now_s))
    for name, kind, text, field, scale in _SERVICE_METRICS:
        yield from of_services(name, kind, text, lambda s, field=field, scale=scale: getattr(s.health, field) * scale)  # type: ignore[misc]
    rigs = view.rigs(now_s)

    def of_rigs(name: str, text: str, values: Iterable[bool]) -> Iterator[str]:
        labeled = ((_labels(lab=lab, rig=rig.rig), float(value)) for rig, value in zip(rigs, values, strict=True))
        yield from _family(name, "gauge", text, labeled)

    yield from of_rigs("rig_held", "Whether a controller holds the lease.", [bool(rig.controller) for rig in rigs])
    yield from of_rigs("rig_recording", "Whether the rig is recorded.", [rig.recording for rig in rigs])
    yield from of_rigs("rig_watchdog_tripped", "Whether the watchdog tripped.", [rig.watchdog_tripped for rig in rigs])
    yield from of_rigs("rig_served", "Whether an edge serves the rig.", [rig.served for rig in rigs])
    yield from of_rigs("rig_simulated", "Whether a simulation steps the rig.", [rig.simulated for rig in rigs])

    def quantiles(percentile_ms: Callable[[RigStatus, float], float | None]) -> Iterator[tuple[str, float]]:
        for rig in rigs:
            for share in (0.5, 0.99):
                if (value := percentile_ms(rig, share)) is not None:
                    yield _labels(lab=lab, rig=rig.rig, quantile=f"{share:g}"), value / 1e3

    yield from _family("rig_loop_seconds", "gauge", "Loop latency in the last 10 s.", quantiles(RigStatus.loop_ms))

    def exceptions() -> Iterator[tuple[str, float]]:
        for rig in rigs:
            for (host, function, code), count in sorted(rig.exceptions.items()):
                named = str(function) if function else "other"
                yield _labels(lab=lab, rig=rig.rig, host=host, function=named, code=str(code)), count

    yield from _family("exceptions_total", "counter", "Modbus exception responses.", exceptions())
    text = "Age of the acting command's basis at each step in the last 10 s."
    yield from _family("rig_age_seconds", "gauge", text, quantiles(RigStatus.age_ms))


def _family(name: str, kind: str, text: str, values: Iterable[tuple[str, float]]) -> Iterator[str]:
    yield f"# HELP hilrig_{name} {text}"
    yield f"# TYPE hilrig_{name} {kind}"
    for labels, value in values:
        yield f"hilrig_{name}{{{labels}}} {float(value):.10g}"


def _labels(**labels: str) -> str:
    def escaped(value: str) -> str:
        return value.replace("\\", r"\\").replace('"', r"\"").replace("\n", r"\n")

    return ",".join(f'{name}="{escaped(value)}"' for name, value in labels.items())
