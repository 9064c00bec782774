"""Export of a study to the rerun viewer: cost planes as tensors, traces as time series."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from hilrig_replay.io.output_file import output_file
from hilrig_replay.plots.palette import JOINT_COLORS, JOINT_SYMBOLS, rgb
from hilrig_replay.rerun_view.layout import SIM_TIME
from hilrig_replay.rerun_view.sinks import to_file
from hilrig_study.plots import Trace
from hilrig_study.study_config import StudyConfig
from hilrig_study.sweep import SweepResult


def save_study_rrd(study: StudyConfig, swept: SweepResult, shown: Sequence[Trace], path: Path) -> None:
    """Write the study as a rerun recording with a layout.

    Raises:
        InputError: the folder does not exist.
        OperationError: the file can't be written.
    """
    names = [f"{number + 1} {controller.name}" for number, controller in enumerate(study.controllers)]
    planes = [rrb.TensorView(name=f"cost: {name}", origin=_entity("plane", name)) for name in names]
    curves = [
        rrb.TimeSeriesView(name=f"{trace.letter}: {trace.outcome}", origin=_entity("trace", trace.letter))
        for trace in shown
    ]
    text = rrb.TextDocumentView(name="study", origin="/about")
    right: list[rrb.Vertical | rrb.TextDocumentView] = [rrb.Vertical(*curves)] if curves else []
    blueprint = rrb.Blueprint(rrb.Horizontal(rrb.Vertical(*planes, text), *right), collapse_panels=True)
    with output_file(path) as temporary:
        _write(to_file(temporary, study.title, blueprint), study, swept, shown, names)


def _write(
    stream: rr.RecordingStream,
    study: StudyConfig,
    swept: SweepResult,
    shown: Sequence[Trace],
    names: Sequence[str],
) -> None:
    with stream:
        rr.log(
            "about",
            rr.TextDocument(
                f"# {study.title}\nRows: {study.y.label}, {study.y.points[0]:g} to {study.y.points[-1]:g}. "
                f"Columns: {study.x.label}, {study.x.points[0]:g} to {study.x.points[-1]:g}. "
                "Color: log10 of the mean cost; the highest value where a run failed.",
                media_type=rr.MediaType.MARKDOWN,
            ),
            static=True,
        )
        for number, name in enumerate(names):
            cost = swept.plane(study, number, swept.results["cost"])
            finite = cost[np.isfinite(cost)]
            worst = 10 * float(finite.max()) if finite.size else 1.0
            image = np.log10(np.maximum(np.where(np.isfinite(cost), cost, worst), 1e-9))
            rr.log(_entity("plane", name), rr.Tensor(image, dim_names=(study.y.what, study.x.what)), static=True)
        for trace in shown:
            index = rr.TimeColumn(SIM_TIME, duration=trace.time_s)
            for joint, symbol in enumerate(JOINT_SYMBOLS):
                entity = f"{_entity('trace', trace.letter)}/error/{symbol}"
                rr.log(
                    entity, rr.SeriesLines(colors=[rgb(JOINT_COLORS[joint])], names=[f"error {symbol}"]), static=True
                )
                rr.send_columns(entity, indexes=[index], columns=rr.Scalars.columns(scalars=trace.error[:, joint]))
    stream.disconnect()


def _entity(kind: str, name: str) -> str:
    return f"{kind}/{''.join(letter if letter.isalnum() else '_' for letter in name)}"
