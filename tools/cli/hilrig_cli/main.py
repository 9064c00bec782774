"""The `hilrig` command: registers every command of `commands`.

A command imports its implementation inside its function: `hilrig --help` is fast, and a host with the dependencies
of one service only can run that service.
"""

import inspect

import typer

from hilrig_cli.commands import (
    certs,
    check,
    compare,
    console,
    demo,
    doctor,
    export,
    figures,
    impair,
    jitter,
    latency,
    lease,
    live,
    metrics,
    play,
    record,
    recover,
    registers,
    replay,
    report,
    rig,
    router,
    runs,
    services,
    study,
    top,
    up,
    verify,
)

app = typer.Typer(
    name="hilrig",
    help="Hardware-in-the-loop rig for robot control: a virtual SCARA arm over Modbus TCP, recorded and replayed.",
    epilog="Exit codes: 0 success, 1 check failed, 2 invalid usage or input, 3 operation failed, "
    "130 interrupted (Ctrl-C), 141 output closed (SIGPIPE).",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)

LAB_PANEL = "Run a lab"
SERVICES_PANEL = "Run a single service"
ANALYSIS_PANEL = "Analyze recordings"

app.command(rich_help_panel=LAB_PANEL)(up.up)
app.command(rich_help_panel=LAB_PANEL)(demo.demo)
app.command(rich_help_panel=LAB_PANEL)(live.live)
app.command(rich_help_panel=LAB_PANEL)(console.console)
app.command(rich_help_panel=LAB_PANEL)(top.top)
app.command(rich_help_panel=LAB_PANEL)(metrics.metrics)
app.command(rich_help_panel=LAB_PANEL)(check.check)
app.add_typer(rig.app, name="rig", rich_help_panel=LAB_PANEL)
app.command(rich_help_panel=LAB_PANEL)(doctor.doctor)
app.command(rich_help_panel=LAB_PANEL)(lease.lease)
app.command(rich_help_panel=LAB_PANEL)(impair.impair)
app.command(rich_help_panel=LAB_PANEL)(jitter.jitter)
app.command(rich_help_panel=LAB_PANEL)(registers.registers)
app.command(rich_help_panel=LAB_PANEL)(certs.certs)
app.add_typer(record.app, name="record", rich_help_panel=LAB_PANEL)
app.command(rich_help_panel=SERVICES_PANEL)(services.sim)
app.command(rich_help_panel=SERVICES_PANEL)(services.edge)
app.command(rich_help_panel=SERVICES_PANEL)(services.recorder)
app.command(rich_help_panel=SERVICES_PANEL)(router.router)
app.command(rich_help_panel=ANALYSIS_PANEL)(runs.runs)
app.command(rich_help_panel=ANALYSIS_PANEL)(latency.latency)
app.command(rich_help_panel=ANALYSIS_PANEL)(replay.replay)
app.command(rich_help_panel=ANALYSIS_PANEL)(compare.compare)
app.command(rich_help_panel=ANALYSIS_PANEL)(study.study)
app.command(rich_help_panel=ANALYSIS_PANEL)(report.report)
app.command(rich_help_panel=ANALYSIS_PANEL)(verify.verify)
app.command(rich_help_panel=ANALYSIS_PANEL)(figures.figures)
app.command(rich_help_panel=ANALYSIS_PANEL)(recover.recover)
app.command(rich_help_panel=ANALYSIS_PANEL)(play.play)
app.command(rich_help_panel=ANALYSIS_PANEL)(export.export)


def _unwrap_help(group: typer.Typer) -> None:
    """Join the lines of each paragraph of the help texts, so that the terminal's width determines the line breaks."""
    for command in group.registered_commands:
        paragraphs = inspect.cleandoc((command.callback and command.callback.__doc__) or "").split("\n\n")
        command.help = "\n\n".join(" ".join(paragraph.split()) for paragraph in paragraphs)


for _group in (app, rig.app, record.app):
    _unwrap_help(_group)


def _print_version(requested: bool) -> None:
    if requested:
        from importlib.metadata import version

        print(f"hilrig {version('hilrig')}")
        raise typer.Exit


@app.callback()
def _options(
    version: bool = typer.Option(False, "--version", callback=_print_version, is_eager=True, help="Print the version."),
) -> None:
    pass
