"""`hilrig`: every command, each in a module of its own under `commands`.

A command's module imports what does the work inside its function, so that `hilrig --help` is quick and a machine
that has one service's parts only can run that service.
"""

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
    help="A hardware-in-the-loop rig for robot control: a virtual SCARA arm over Modbus TCP, recorded and replayed.",
    epilog="Exit codes: 0 done, 1 the answer is no, 2 wrong usage or input, 3 an operation failed, "
    "130 Ctrl-C, 141 nobody read the output any more.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)

RUN = "Run a lab"
SERVICES = "Services, one by one"
REVIEW = "Review what was recorded"

app.command(rich_help_panel=RUN)(up.up)
app.command(rich_help_panel=RUN)(demo.demo)
app.command(rich_help_panel=RUN)(live.live)
app.command(rich_help_panel=RUN)(console.console)
app.command(rich_help_panel=RUN)(top.top)
app.command(rich_help_panel=RUN)(metrics.metrics)
app.command(rich_help_panel=RUN)(check.check)
app.add_typer(rig.app, name="rig", rich_help_panel=RUN)
app.command(rich_help_panel=RUN)(doctor.doctor)
app.command(rich_help_panel=RUN)(lease.lease)
app.command(rich_help_panel=RUN)(impair.impair)
app.command(rich_help_panel=RUN)(jitter.jitter)
app.command(rich_help_panel=RUN)(registers.registers)
app.command(rich_help_panel=RUN)(certs.certs)
app.add_typer(record.app, name="record", rich_help_panel=RUN)
app.command(rich_help_panel=SERVICES)(services.sim)
app.command(rich_help_panel=SERVICES)(services.edge)
app.command(rich_help_panel=SERVICES)(services.recorder)
app.command(rich_help_panel=SERVICES)(router.router)
app.command(rich_help_panel=REVIEW)(runs.runs)
app.command(rich_help_panel=REVIEW)(latency.latency)
app.command(rich_help_panel=REVIEW)(replay.replay)
app.command(rich_help_panel=REVIEW)(compare.compare)
app.command(rich_help_panel=REVIEW)(study.study)
app.command(rich_help_panel=REVIEW)(report.report)
app.command(rich_help_panel=REVIEW)(verify.verify)
app.command(rich_help_panel=REVIEW)(figures.figures)
app.command(rich_help_panel=REVIEW)(recover.recover)
app.command(rich_help_panel=REVIEW)(play.play)
app.command(rich_help_panel=REVIEW)(export.export)


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        print(f"hilrig {version('hilrig')}")
        raise typer.Exit


@app.callback()
def _options(
    version: bool = typer.Option(False, "--version", callback=_version, is_eager=True, help="Print the version."),
) -> None:
    pass
