"""Layout of the viewer: the arm on the left, plots on the right, events and states below the arm."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Final

import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import TextLogColumnKind as _Kind

from hilrig_replay.analysis.stages import stages_of_role
from hilrig_replay.plots.palette import EFFORT_SYMBOLS, JOINT_COLORS, JOINT_SYMBOLS, legend_in_words
from hilrig_replay.rerun_view import entity_paths as paths
from hilrig_replay.rerun_view.entity_paths import arm_path, entity_path
from hilrig_replay.rerun_view.value_axes import Range

SIM_TIME: Final = "sim_time"
WALL: Final = "wall"
STEP: Final = "step"

TRAIL_S: Final = 4.0
"""Length of the tool's trail, s."""
LIVE_WINDOW_S: Final = 20.0
"""Time range of the plots of a running rig, s."""
_JOINTS: Final = legend_in_words(JOINT_SYMBOLS, JOINT_COLORS)
_EFFORTS: Final = legend_in_words(EFFORT_SYMBOLS, JOINT_COLORS)
_CAMERA_POSITION: Final = (0.80, -0.72, 0.50)
_CAMERA_TARGET: Final = (0.14, 0.02, 0.02)
_BACKGROUND: Final = (24, 28, 33)


def layout(
    roots: Sequence[str] = ("",),
    *,
    live: bool = False,
    client_role: bool = False,
    ranges: Mapping[str, Range] = MappingProxyType({}),
) -> rrb.Blueprint:
    """Blueprint for the rigs under the entity paths `roots`: one scene with all arms, and common plots.

    Args:
        roots: root paths of the rigs.
        live: whether they run now.
        client_role: whether the only rig is the client of its controller.
        ranges: of value axes, by the path of the first entity of a plot; the others are chosen by the viewer.
    """
    trail = [
        rrb.VisibleTimeRange(
            timeline,
            start=rr.TimeRangeBoundary.cursor_relative(seconds=-TRAIL_S),
            end=rr.TimeRangeBoundary.cursor_relative(),
        )
        for timeline in (SIM_TIME, WALL)
    ]
    scene = rrb.Spatial3DView(
        name="Arm",
        origin=entity_path(roots[0], paths.SCENE) if len(roots) == 1 else "/",
        contents=[f"+ {path}/**" for root in roots for path in (entity_path(root, paths.SCENE), f"/{arm_path(root)}")],
        background=rrb.Background(color=_BACKGROUND),
        line_grid=False,
        eye_controls=rrb.EyeControls3D(
            kind=rrb.Eye3DKind.Orbital, position=_CAMERA_POSITION, look_target=_CAMERA_TARGET, eye_up=(0.0, 0.0, 1.0)
        ),
        overrides={entity_path(root, paths.TRAIL): [rrb.VisibleTimeRanges(trail)] for root in roots},
    )

    def plot(name: str, *shown: str, legend: bool = False) -> rrb.TimeSeriesView:
        window = rrb.VisibleTimeRange(
            SIM_TIME,
            start=rr.TimeRangeBoundary.cursor_relative(seconds=-LIVE_WINDOW_S),
            end=rr.TimeRangeBoundary.cursor_relative(),
        )
        return rrb.TimeSeriesView(
            name=name,
            origin="/",
            contents=[f"+ {entity_path(root, path)}/**" for root in roots for path in shown],
            plot_legend=rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=legend),
            axis_x=rrb.TimeAxis(link=rrb.components.LinkAxis.LinkToGlobal),
            axis_y=rrb.ScalarAxis(range=ranges[shown[0]]) if shown[0] in ranges else None,
            time_ranges=[window] if live else None,
        )

    below = rrb.Horizontal(
        rrb.TextLogView(
            name="Events",
            origin="/",
            contents=[f"+ {entity_path(root, paths.EVENTS)}/**" for root in roots],
            columns=rrb.TextLogColumns(
                timeline_columns=[SIM_TIME],
                text_log_columns=[_Kind.LogLevel, _Kind.Body] if len(roots) == 1 else list(_Kind),
            ),
        ),
        rrb.StateTimelineView(
            name="States",
            origin="/",
            contents=[f"+ {entity_path(root, paths.STATES)}/**" for root in roots],
        ),
    )
    single, stages = len(roots) == 1, stages_of_role(client_role)
    plots = rrb.Vertical(
        # Legends are in the titles: a box in a plot covers curves. Of several runs, color identifies the run, and the
        # box in the first plot names them.
        plot(f"Positions: {_JOINTS if single else 'θ'} (°; d3 mm)", paths.POSITION, legend=not single),
        plot("Velocities (°/s; d3 mm/s) and events", paths.VELOCITY, paths.EVENT_MARKERS),
        plot(f"Efforts: {_EFFORTS if single else 'τ'} (N·m; τ3 N; thin: commanded)", paths.EFFORT),
        plot(
            f"Latency, ms: {legend_in_words([one.title for one in stages], [one.color for one in stages])}",
            paths.LATENCY_STAGES,
        )
        if single
        else plot("Loop latency, ms", paths.LOOP_LATENCY),
        rrb.Tabs(
            plot("Age of the acting torque, ms", paths.LOOP_AGE),
            plot("Tick lateness, ms, and events", paths.TICK_LATENESS, paths.EVENT_MARKERS),
            plot("Modbus requests per second", paths.MODBUS, legend=True),
        ),
        row_shares=[1.1, 0.9, 1.0, 1.5, 0.9],
    )
    return rrb.Blueprint(
        rrb.Horizontal(rrb.Vertical(scene, below, row_shares=[2.6, 1.0]), plots, column_shares=[1.0, 1.0]),
        rrb.TimePanel(
            timeline=SIM_TIME,
            state="collapsed",
            play_state="following" if live else "playing",
            loop_mode=None if live else "all",
            fps=50.0,
        ),
        rrb.SelectionPanel(state="hidden"),
        rrb.BlueprintPanel(state="hidden"),
        auto_views=False,
    )
