"""`hilrig ik`: inverse kinematics of a rig's arm."""

import math
from typing import Annotated

import typer

from hilrig_cli.options import AsJson, Config


def ik(
    x: Annotated[float, typer.Argument(metavar="X", help="x of the tool, mm.", show_default=False)],
    y: Annotated[float, typer.Argument(metavar="Y", help="y of the tool, mm.", show_default=False)],
    z: Annotated[float, typer.Argument(metavar="Z", help="z of the tool, mm.", show_default=False)],
    yaw: Annotated[float, typer.Argument(metavar="YAW", help="Angle of the tool about z, °.")] = 0.0,
    config: Config = None,
    rig: Annotated[str, typer.Option(metavar="NAME", help="Rig of the lab; default: its first one.")] = "",
    as_json: AsJson = False,
) -> None:
    """Print every joint combination within the limits that reaches a pose, or the reason if there is no solution.

    Exit code 1: the pose cannot be reached.
    """

    from hilrig_cli.json_output.lab import IkOutput
    from hilrig_cli.json_output.model import print_json
    from hilrig_cli.terminal import TerminalConsole, TerminalTable
    from hilrig_runtime.config.lab import LabConfig, load_lab
    from hilrig_sim.arm.joints import JOINT_SCALE
    from hilrig_sim.arm.kinematics import UnreachableError, inverse
    from hilrig_sim.parameters import rig_parameters

    lab = LabConfig() if config is None else load_lab(config)
    names = [one.name for one in lab.rigs]
    if rig and rig not in names:
        raise lab.no_such_rig(rig)
    arm = rig_parameters(lab, lab.rigs[names.index(rig) if rig else 0]).arm
    try:
        solutions = (inverse(arm, (x / 1e3, y / 1e3, z / 1e3, math.radians(yaw))) * JOINT_SCALE).tolist()
        reason = ""
    except UnreachableError as error:
        solutions, reason = [], str(error)
    if as_json:
        print_json(IkOutput(joints_deg_deg_mm_deg=solutions, reason=reason or None))
    elif reason:
        print(f"no solution: {reason}")
    else:
        table = TerminalTable("elbow", "θ1, °", "θ2, °", "d3, mm", "θ4, °")
        for theta1, theta2, d3, theta4 in solutions:
            side = "straight" if abs(theta2) < 1e-9 else "left" if theta2 < 0 else "right"
            table.add_row(side, *(f"{value:.2f}" for value in (theta1, theta2, d3, theta4)))
        TerminalConsole().print(table)
    if reason:
        raise typer.Exit(1)
