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
from hilrig_cli.options import Command, Group

app = typer.Typer(
    cls=Group,
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
app.add_typer(rig.app, name="rig", cls=Group, rich_help_panel="Run a lab")
app.add_typer(record.app, name="record", cls=Group, rich_help_panel="Run a lab")
app.add_typer(assign.app, name="assign", cls=Group, rich_help_panel="Analyze recordings")


EXAMPLES = {
    "up": "up lab.toml --log-format json",
    "demo": "demo --duration 20 --out demo-out",
    "live": "live rig1 -c lab.toml --web",
    "console": "console -c lab.toml --listen :8050 --password-file password.txt",
    "top": "top -c lab.toml --once",
    "metrics": "metrics -c lab.toml --listen 127.0.0.1:9464",
    "check": "check lab.toml",
    "doctor": "doctor -c lab.toml",
    "claim": "claim ABCDE-FGHJK 192.0.2.10:5020",
    "lease": "lease rig1 rig2 --release -c lab.toml",
    "events": "events -c lab.toml --rig rig1 --severity warning",
    "impair": "impair rig1 --command uniform:20,40 --loss 0.01 -c lab.toml",
    "jitter": "jitter --load --step-ms 10",
    "registers": "registers --csv > registers.csv",
    "ik": "ik 300 100 50 90",
    "certs": "certs certs -c lab.toml --client alice=operator --host 192.0.2.10",
    "example": "example hold_position.py",
    "router": "router -c lab.toml",
    "sim": "sim -c lab.toml",
    "edge": "edge -c lab.toml --instance left --rigs rig1,rig2",
    "recorder": "recorder -c lab.toml",
    "runs": "runs recordings --since 2026-01-31 --sort p99",
    "latency": "latency run.mcap --plot latency.png",
    "replay": "replay run.mcap --web",
    "compare": "compare first.mcap second.mcap --align part_picked --plot both.png",
    "study": "study study.toml --controller my_controller.py",
    "report": "report recordings --out report.html",
    "grade": "grade recordings --assignment 3-two-poses --roster roster.csv",
    "verify": "verify run.mcap",
    "recover": "recover run.mcap.part",
    "join": "join run.mcap run.2.mcap --out joined.mcap",
    "play": "play run.mcap -c lab.toml --speed 0.5",
    "export": "export run.mcap --parquet tables",
    "rig list": "rig list -c lab.toml",
    "rig add": "rig add guest --port 5100 -c lab.toml",
    "rig remove": "rig remove guest -c lab.toml",
    "rig reset": "rig reset rig1 rig2 -c lab.toml",
    "rig codes": "rig codes --until 11:30 --group A --out codes.csv -c lab.toml",
    "record start": "record start rig1 -c lab.toml",
    "record stop": "record stop --all -c lab.toml",
    "assign check": "assign check 3-two-poses --solution solution.py",
}
"""An example of each command, for its help."""


def _complete_help(group: typer.Typer, prefix: str = "") -> None:
    """Add an example to each help text, and join the lines of its paragraphs, so that the terminal breaks them."""
    for command in group.registered_commands:
        assert command.callback is not None
        command.cls = Command
        paragraphs = inspect.cleandoc(command.callback.__doc__ or "").split("\n\n")
        command.help = "\n\n".join(" ".join(paragraph.split()) for paragraph in paragraphs)
        name = command.name or command.callback.__name__
        command.epilog = f"Example: hilrig {EXAMPLES[f'{prefix}{name}']}"


_complete_help(app)
for _name, _group in (("rig", rig.app), ("record", record.app), ("assign", assign.app)):
    _complete_help(_group, f"{_name} ")


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
