"""The `hilrig` command: registers every command of `commands`.

A command imports its implementation inside its function: `hilrig --help` is fast, and a host with the dependencies
of one service only can run that service.
"""

import inspect

import typer

from hilrig_cli.commands import assign, record, rig
from hilrig_cli.commands.certs import certs
from hilrig_cli.commands.check import check
from hilrig_cli.commands.claim import claim
from hilrig_cli.commands.compare import compare
from hilrig_cli.commands.console import console
from hilrig_cli.commands.demo import demo
from hilrig_cli.commands.doctor import doctor
from hilrig_cli.commands.events import events
from hilrig_cli.commands.example import example
from hilrig_cli.commands.export import export
from hilrig_cli.commands.grade import grade
from hilrig_cli.commands.ik import ik
from hilrig_cli.commands.impair import impair
from hilrig_cli.commands.jitter import jitter
from hilrig_cli.commands.join import join
from hilrig_cli.commands.latency import latency
from hilrig_cli.commands.lease import lease
from hilrig_cli.commands.live import live
from hilrig_cli.commands.metrics import metrics
from hilrig_cli.commands.play import play
from hilrig_cli.commands.recover import recover
from hilrig_cli.commands.registers import registers
from hilrig_cli.commands.replay import replay
from hilrig_cli.commands.report import report
from hilrig_cli.commands.router import router
from hilrig_cli.commands.runs import runs
from hilrig_cli.commands.services import edge, recorder, sim
from hilrig_cli.commands.study import study
from hilrig_cli.commands.top import top
from hilrig_cli.commands.up import up
from hilrig_cli.commands.verify import verify

app = typer.Typer(
    name="hilrig",
    help="Hardware-in-the-loop rig for robot control: a virtual SCARA arm over Modbus TCP, recorded and replayed.",
    epilog="Exit codes: 0 success, 1 check failed, 2 invalid usage or input, 3 operation failed, "
    "130 interrupted (Ctrl-C), 141 output closed (SIGPIPE).",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="rich",
)

PANELS = {
    "Run a lab": (
        up,
        demo,
        live,
        console,
        top,
        metrics,
        check,
        doctor,
        claim,
        lease,
        events,
        impair,
        jitter,
        registers,
        ik,
        certs,
        example,
    ),
    "Run a single service": (sim, edge, recorder, router),
    "Analyze recordings": (
        runs,
        latency,
        replay,
        compare,
        study,
        report,
        grade,
        verify,
        recover,
        join,
        play,
        export,
    ),
}
"""Panels of the help, each with its commands."""

for _panel, _commands in PANELS.items():
    for _command in _commands:
        # A negative coordinate is no option.
        _settings = {"ignore_unknown_options": True} if _command is ik else None
        app.command(rich_help_panel=_panel, context_settings=_settings)(_command)
app.add_typer(rig.app, name="rig", rich_help_panel="Run a lab")
app.add_typer(record.app, name="record", rich_help_panel="Run a lab")
app.add_typer(assign.app, name="assign", rich_help_panel="Analyze recordings")


def _unwrap_help(group: typer.Typer) -> None:
    """Join the lines of each paragraph of the help texts, so that the terminal's width determines the line breaks."""
    for command in group.registered_commands:
        paragraphs = inspect.cleandoc((command.callback and command.callback.__doc__) or "").split("\n\n")
        command.help = "\n\n".join(" ".join(paragraph.split()) for paragraph in paragraphs)


for _group in (app, rig.app, record.app, assign.app):
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
