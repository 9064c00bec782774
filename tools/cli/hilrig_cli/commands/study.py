"""`hilrig study`: stability of a controller under delay, jitter and loss."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hilrig_cli.options import AsJson

if TYPE_CHECKING:
    from hilrig_cli.terminal import TerminalConsole


def study(
    file: Annotated[
        Path | None,
        typer.Argument(metavar="STUDY.TOML", help="Definition of the study (docs/studies.md)."),
    ] = None,
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the results.")] = Path("study-out"),
    controller: Annotated[
        list[Path] | None,
        typer.Option(metavar="FILE.PY", help="Add a controller: a file that defines class Controller."),
    ] = None,
    live: Annotated[
        bool, typer.Option("--live", help="Also run the study's live points over Modbus TCP, on a separate lab.")
    ] = False,
    from_run: Annotated[
        Path | None,
        typer.Option(
            "--from",
            metavar="RUN.MCAP",
            help="Use the latency of this recording: evaluate which gains are stable, and their margins.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Simulate a control loop over a range of parameters, compare with theory and plot both.

    With --live, selected points are also measured on the real loop. Results: runs.parquet, study.json, a plot of each
    controller (PNG, SVG) and study.rrd. Exit code 1: a live measurement contradicts the prediction; with --from: no
    gain of the study is stable.
    """
    from hilrig_cli.terminal import TerminalConsole
    from hilrig_runtime.errors import InputError

    console = TerminalConsole(stderr=True, quiet=as_json)
    if from_run is not None:
        if live:
            raise InputError("--from and --live can't be combined: use one of them")
        _from_recording(from_run, file, as_json, console)
        return
    if file is None:
        raise InputError("STUDY.TOML or --from RUN.MCAP is required; see examples/studies for an example")
    results = _sweep(file, controller or [], out, live, console)
    if as_json:
        from hilrig_cli.json_output.model import print_json
        from hilrig_cli.json_output.study import StudyOutput

        print_json(StudyOutput.model_validate(results))
    else:
        _print_results(results, out)
    if any(not point["as_predicted"] for point in results.get("live", [])):
        raise typer.Exit(1)


def _sweep(file: Path, controllers: list[Path], out: Path, live: bool, console: "TerminalConsole") -> dict[str, Any]:
    from rich.progress import Progress, TimeElapsedColumn

    from hilrig_runtime.errors import InputError, OperationError
    from hilrig_study.study_config import load_study

    chosen = load_study(file).with_files(controllers)
    if live and not chosen.live:
        raise InputError(f"{file}: --live requires live points, but the study has none: add [[live]] with x and y")
    # Imported after the validation, so that errors in the study are reported without delay.
    from hilrig_replay.io.output_file import check_output
    from hilrig_study.plots import Marker, plane_figure, save_plots, traces
    from hilrig_study.rerun_plots import save_study_rrd
    from hilrig_study.results import save_results
    from hilrig_study.sweep import sweep

    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OperationError(f"{out}: results can't be written there: {error.strerror}") from error
    for name in ("runs.parquet", "study.json", "study.rrd"):
        check_output(out / name, [file, *controllers])
    columns = (*Progress.get_default_columns(), TimeElapsedColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task("sweep", total=1.0)
        simulated_traces = traces(chosen, file.parent)
        swept = sweep(chosen, file.parent, lambda share: progress.update(task, completed=share))
    measured: list[dict[str, Any]] = []
    if live:
        import threading
        from collections.abc import Callable, Iterator
        from contextlib import contextmanager

        from hilrig_cli.local.local_lab import free_ports, running_lab
        from hilrig_runtime.config.lab import LabConfig
        from hilrig_study.live.live_points import run_live_points

        def log(line: str) -> None:
            console.print(f"hilrig: {line}", highlight=False, soft_wrap=True)

        @contextmanager
        def start_lab(lab: LabConfig, config: Path) -> Iterator[Callable[[], object]]:
            with running_lab(lab, config, log, threading.Event()) as supervisor:
                yield supervisor.poll

        measured = run_live_points(chosen, file.parent, out, start_lab, free_ports, log)
    with console.status("plotting"):
        plot_paths = []
        for number in range(len(chosen.controllers)):
            name = chosen.controllers[number].name
            markers = [Marker(p["x"], p["y"], p["as_predicted"]) for p in measured if p["controller"] == name]
            figure = plane_figure(chosen, swept, number, simulated_traces, markers)
            plot_paths += save_plots(figure, out / f"plane-{number + 1}")
        save_study_rrd(chosen, swept, simulated_traces, out / "study.rrd")
        extra = {"pictures": [str(path) for path in plot_paths], "live": measured}
        return save_results(chosen, swept, out, extra, file.parent)


def _print_results(results: dict[str, Any], out: Path) -> None:

    from hilrig_cli.terminal import TerminalConsole, TerminalTable

    console = TerminalConsole()
    title = (
        f"{results['title']}: {results['runs']:,} runs, {results['simulated_s']:,.0f} s simulated in "
        f"{results['seconds']:.1f} s ({results['times_real_time']:,.0f} × real time)"
    )
    table = TerminalTable(title=title)
    for column in ("controller", "gain", "stable up to added delay, ms", "delay margin, ms", "jitter margin, ms"):
        table.add_column(column, justify="left" if column == "controller" else "right")
    for controller in results["controllers"]:
        theory = controller["theory"]
        if not theory:
            table.add_row(controller["name"], "–", f"{controller['settled_share']:.0%} of runs settle", "–", "–")
        # About twelve gains are enough for an overview.
        for one in theory[:: max(1, len(theory) // 12)]:
            nominal = one["nominal"] or {}
            until = one["stable_until_ms"]
            table.add_row(
                controller["name"],
                f"{one['gain']:.3g}",
                "all tested" if until is None else "unstable" if until < 0 else f"{until:.1f}",
                _ms(nominal.get("delay_margin_s")),
                _ms(nominal.get("jitter_margin_s")),
            )
    console.print(table)
    for point in results["live"]:
        console.print(
            f"live: {point['controller']} at x {point['x']:g}, y {point['y']:g}: loop p50 "
            f"{point['live']['loop_p50_ms']:.1f} ms (predicted {point['virtual']['loop_p50_ms']:.1f}), error "
            f"{point['live']['error_rms_deg']:.3f}° (predicted {point['virtual']['error_rms_deg']:.3f}): "
            + ("as predicted" if point["as_predicted"] else "NOT as predicted"),
            highlight=False,
        )
    console.print(f"results: {out}", highlight=False)


def _ms(seconds: float | None) -> str:
    return "–" if seconds is None else f"{seconds * 1e3:.1f}"


def _from_recording(path: Path, file: Path | None, as_json: bool, console: "TerminalConsole") -> None:
    from hilrig_cli.json_output.model import print_json
    from hilrig_cli.json_output.study import StudyFromOutput
    from hilrig_replay.io.isolation import isolated
    from hilrig_replay.io.paths import find_run
    from hilrig_replay.io.run import open_run
    from hilrig_study.live.from_recording import evaluate_gains
    from hilrig_study.study_config import load_study

    study = None if file is None else load_study(file)
    with console.status("evaluating gains"), isolated(path):
        evaluation = evaluate_gains(open_run(find_run(path)), study).as_dict()
    if as_json:
        print_json(StudyFromOutput.model_validate(evaluation))
    else:
        _print_gains(evaluation)
    if not any(gain["stable"] for gain in evaluation["gains"]):
        raise typer.Exit(1)


def _print_gains(evaluation: dict[str, Any]) -> None:
    from rich.text import Text

    from hilrig_cli.terminal import TerminalConsole, TerminalTable

    latency, age = evaluation["latency"], evaluation["age_ms"]
    title = (
        f"{evaluation['session']}: loop latency p50 {latency['p50_ms']:.1f}, p99 {latency['p99_ms']:.1f}, "
        f"max {latency['max_ms']:.1f} ms; age p50 {age['p50']:.1f}, p99 {age['p99']:.1f} ms; "
        f"step {evaluation['step_ms']:g} ms"
    )
    table = TerminalTable(title=title)
    for column in ("controller", "gain", "stable", "mean-square growth", "expected cost", "delay margin, ms"):
        table.add_column(column, justify="left" if column == "controller" else "right")
    for gain in evaluation["gains"]:
        cost = gain["expected_cost"]
        table.add_row(
            gain["controller"],
            f"{gain['gain']:.3g}",
            "yes" if gain["stable"] else Text("no", style="red"),
            f"{gain['mean_square_radius']:.4f}",
            "–" if cost is None else f"{cost:.2f}",
            "–" if gain["spare_ms"] is None else f"{'≥ ' if gain['spare_at_least'] else ''}{gain['spare_ms']:.0f}",
        )
    TerminalConsole().print(table)
