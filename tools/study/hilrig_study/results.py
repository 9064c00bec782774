"""Result files of a study: a Parquet table with one row per run, and a JSON summary."""

import hashlib
import json
import platform
from dataclasses import asdict
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet
from numpy.typing import NDArray
from pydantic_core import to_jsonable_python
from scipy.special import stdtrit

from hilrig_replay.io.output_file import output_file
from hilrig_sim.arm.joints import JOINT_NAMES
from hilrig_sim.platform_fingerprint import machine_name
from hilrig_study.study_config import StudyConfig
from hilrig_study.sweep import CELL_DTYPE, SweepResult

Floats = NDArray[np.float64]

VERSIONED: Final = ("numpy", "scipy", "pyarrow")
"""Packages whose versions are recorded: results are bit-identical with the same ones."""
PROVENANCE: Final = ("software", "versions", "machine", "date", "seed", "controller_sha256", "units")
"""Keys of `provenance`."""
UNITS: Final = {
    "controller": "",
    "run": "1",
    "gain": "1",
    "delay_ms": "ms",
    "jitter_ms": "ms",
    "loss": "1",
    "step_ms": "ms",
    "poll_ms": "ms",
    "cost": "1",
    "settled": "",
    "failed_s": "s",
    "loop_p50_ms": "ms",
    "loop_p99_ms": "ms",
    **{f"error_rms_{name}": "m" if name == "d3" else "rad" for name in JOINT_NAMES},
    "spectral_radius": "1",
}
"""Unit of each column of `runs.parquet`; 1: a pure number, empty: no number."""


def run_table(study: StudyConfig, swept: SweepResult) -> pa.Table:
    """Return one row per run: parameters, outcome and spectral radius; units are in the names, angles in rad."""
    names = np.array([controller.name for controller in study.controllers])
    columns: dict[str, Any] = {"controller": names[swept.cells["controller"]].tolist()}
    for name in (CELL_DTYPE.names or ())[3:]:
        columns[name] = np.ascontiguousarray(swept.cells[name])
    for name in ("cost", "settled", "failed_s", "loop_p50_ms", "loop_p99_ms"):
        columns[name] = np.ascontiguousarray(swept.results[name])
    for number, joint in enumerate(JOINT_NAMES):
        columns[f"error_rms_{joint}"] = np.ascontiguousarray(swept.results["error_rms"][:, number])
    columns["spectral_radius"] = swept.radius
    table = pa.table(columns)
    fields = [field.with_metadata({"unit": UNITS[field.name]}) for field in table.schema]
    return table.cast(pa.schema(fields))


def provenance(study: StudyConfig, folder: Path) -> dict[str, Any]:
    """Return the data that repeat a figure: versions, date, seed, hash of each controller file, and units.

    Args:
        study: the study.
        folder: folder of the study file, to which controller files are relative.
    """
    files = {one.name: one.file for one in study.controllers if one.file is not None}
    return {
        "software": f"hilrig {version('hilrig')}",
        "versions": {"python": platform.python_version(), **{name: version(name) for name in VERSIONED}},
        "machine": machine_name(),
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
        "seed": study.seed,
        "controller_sha256": {
            name: hashlib.sha256((folder / file).read_bytes()).hexdigest() for name, file in files.items()
        },
        "units": UNITS,
    }


def _is_random(swept: SweepResult, controller: int) -> bool:
    return bool((swept.cells["run"][swept.cells["controller"] == controller] > 0).any())


def settled_interval(swept: SweepResult, controller: int) -> tuple[float, float] | None:
    """Return the 95 % interval (Wilson) of the settled share of a controller; None: no run has random values."""
    rows = swept.cells["controller"] == controller
    if not _is_random(swept, controller):
        return None
    from scipy.stats import binomtest

    found = binomtest(int(swept.results["settled"][rows].sum()), int(rows.sum())).proportion_ci(method="wilson")
    return float(found.low), float(found.high)


def cost_interval(study: StudyConfig, swept: SweepResult, controller: int) -> dict[str, Floats] | None:
    """Return `mean` cost and `half_width` of its 95 % interval (Student) of each cell, (len(y), len(x)) each.

    None: no run of the controller has random values. A cell with a run without a finite cost has no finite values.
    """
    if not _is_random(swept, controller):
        return None
    rows, cost = swept.cells["controller"] == controller, swept.results["cost"]
    with np.errstate(invalid="ignore"):
        mean = swept.plane(study, controller, cost)
        deviation = cost - np.where(rows, mean[swept.cells["iy"], swept.cells["ix"]], 0.0)
        variance = swept.plane(study, controller, deviation**2)
    more = study.runs - 1
    return {"mean": mean, "half_width": stdtrit(more, 0.975) * np.sqrt(variance / more)}


def summary(study: StudyConfig, swept: SweepResult, folder: Path = Path()) -> dict[str, Any]:
    """Return the study, its provenance, and outcome and theory per controller and gain, as JSON values."""
    controllers = []
    for number, controller in enumerate(study.controllers):
        settled = swept.plane(study, number, swept.results["settled"])
        cost = cost_interval(study, swept, number)
        theory = [asdict(entry) for entry in swept.theory if entry.controller == number]
        for entry in theory:
            del entry["controller"]
        controllers.append(
            {
                "name": controller.name,
                "runs": int((swept.cells["controller"] == number).sum()),
                "settled_share": float(settled.mean()),
                "settled_interval": settled_interval(swept, number),
                "cost": cost and {name: np.round(values, 4).tolist() for name, values in cost.items()},
                "theory": theory,
            }
        )
    simulated_s = len(swept.cells) * study.loop.duration_s
    values = {
        "title": study.title,
        "study": study.model_dump(mode="json"),
        **provenance(study, folder),
        "runs": len(swept.cells),
        "simulated_s": simulated_s,
        "seconds": swept.seconds,
        "times_real_time": simulated_s / swept.seconds,
        "controllers": controllers,
    }
    return _plain(values)


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    """Return JSON values, with infinity and NaN replaced by null, since JSON has neither."""
    plain: dict[str, Any] = to_jsonable_python(values, inf_nan_mode="null")
    return plain


def save_results(
    study: StudyConfig, swept: SweepResult, folder: Path, more: dict[str, Any], source: Path = Path()
) -> dict[str, Any]:
    """Write `runs.parquet` and `study.json`, with `more` at its top level, and return the JSON values.

    The schema metadata `hilrig` of the table is the provenance as JSON; each of its fields has a `unit`.

    Args:
        study: the study.
        swept: its results.
        folder: where the files are written.
        more: additional JSON values.
        source: folder of the study file.

    Raises:
        OperationError: a file can't be written.
    """
    written = summary(study, swept, source) | _plain(more)
    origin = {name: written[name] for name in PROVENANCE}
    table = run_table(study, swept)
    table = table.replace_schema_metadata({"hilrig": json.dumps(origin)})
    with output_file(folder / "runs.parquet") as table_file, output_file(folder / "study.json") as summary_file:
        pyarrow.parquet.write_table(table, table_file)
        summary_file.write_text(json.dumps(written, indent=1), encoding="utf-8")
    return written
