"""Read the stored cells of a comparison, and check that they compare."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from brakeline.deploy.experiments.compared_methods import NONE, compared, in_order, short_name
from brakeline.deploy.experiments.comparison_cells import CellConfig
from brakeline.deploy.experiments.comparison_table import evaluation_name
from brakeline.deploy.experiments.experiment_jobs import configuration, stored_result
from brakeline.deploy.experiments.task_engine import robot_folder
from brakeline.errors import ResultError
from brakeline.learner.learner_config import TD3Config
from brakeline.safety.model.model_config import DDPC

SAME = ("robot", "steps", "episodes", "arenas", "physics", "backend", "robots")  # in all cells of a robot
SAME_IF_STATED = ("task", "model_set")
CELL = re.compile(r"-s\d+\.json$")
SEVERAL = "{folder}: {method} has cells of several settings: run the older again, or give another --results"


def stored_cells(results: Path, robot: str) -> list[dict[str, Any]]:
    """Return the stored cells of a robot, by method and seed.

    Raises:
        ResultError: a file is damaged or a copy, or cells differ in more than the method and its settings.
    """
    folder = robot_folder(results, robot)
    cells = [_named_cell(path) for path in _paths(folder)]
    order = in_order(cell["study"]["method"] for cell in cells)
    cells.sort(key=lambda cell: (order.index(cell["study"]["method"]), cell["study"]["seed"]))
    _check_comparable([cell["study"] for cell in cells], folder)
    _check_episodes(cells, folder)
    for method in order:
        models = [cell["model"] or {} for cell in cells if cell["study"]["method"] == method]
        if (
            len({json.dumps([model.get("settings"), str(model.get("samples"))], sort_keys=True) for model in models})
            > 1
        ):
            raise ResultError(SEVERAL.format(folder=folder, method=method))
    return cells


def stored_tunings(folder: Path, physics: int) -> dict[str, list[dict[str, Any]]]:
    """Return the stored values of each method's setting in the folder of a robot, in their order.

    Args:
        folder: of the robot.
        physics: version of the simulator that made the cells beside them.

    Raises:
        ResultError: a file is damaged, a copy, or of another version of the simulator.
    """
    tried: dict[str, list[dict[str, Any]]] = {}
    for path in sorted(folder.glob("tuning-*.json")):
        result = stored_result(path)
        study, value = result["study"], f"{result['value']:g}"
        if path.stem != f"tuning-{study['method']}-{value}":
            raise ResultError(f"{path} holds the value {value} of {study['method']}: move it away")
        version = study.get("cell", study).get("physics", 1)
        if version != physics:
            raise ResultError(
                f"{path} is of version {version} of the simulator, the cells of {physics}: run it again with --tune "
                "--again, or move it away"
            )
        tried.setdefault(study["method"], []).append(result)
    return {method: sorted(values, key=lambda row: float(row["value"])) for method, values in tried.items()}


def check_addable(results: Path, cells: Sequence[CellConfig]) -> None:
    """Raise ResultError if cells to run would not compare with the stored ones that they do not replace."""
    folder, names = robot_folder(results, cells[0].robot), {cell.name for cell in cells}
    studies = [_named_cell(path)["study"] for path in _paths(folder) if path.stem not in names]
    _check_comparable([*studies, *map(configuration, cells)], folder)


def _paths(folder: Path) -> list[Path]:
    return [path for path in sorted(folder.glob("*-s*.json")) if CELL.search(path.name)]


def _named_cell(path: Path) -> dict[str, Any]:
    """Return the cell in a file. Raises ResultError: it is damaged, or a copy of another cell."""
    cell = stored_result(path)
    name = f"{short_name(cell['study']['method'])}-s{cell['study']['seed']}"
    if path.stem != name:
        raise ResultError(f"{path} holds the cell {name}, which would count twice: move it away")
    return cell


def _check_episodes(cells: Sequence[dict[str, Any]], folder: Path) -> None:
    """Raise ResultError if a cell lacks an evaluation or a figure, or has another number of episodes than others."""
    counts: dict[str, set[int]] = {}
    for cell in cells:
        path = folder / f"{short_name(cell['study']['method'])}-s{cell['study']['seed']}.json"
        trials = [evaluation_name(cell["study"]["method"], arena) for arena in cell["study"]["arenas"]]
        missing = [f"evaluation {trial}" for trial in trials if trial not in cell.get("evaluations", {})]
        if missing := (["training"] if "training" not in cell else []) + missing:
            raise ResultError(f"{path} has no {missing[0]}: run it again with --again, or move it away")
        _check_columns(cell["training"]["episodes"], f"{path}: the episodes of the training")
        for trial, evaluation in cell["evaluations"].items():
            _check_columns(evaluation["episodes"], f"{path}: the episodes of {trial}")
            counts.setdefault(trial, set()).add(len(evaluation["episodes"]["goal"]))
    if several := [f"{trial} ({', '.join(map(str, sorted(n)))})" for trial, n in counts.items() if len(n) > 1]:
        raise ResultError(f"{folder}: the cells have more than one number of episodes in {several[0]}")


def _check_columns(episodes: dict[str, list[float]], what: str) -> None:
    """Raise ResultError if the columns of episodes have several lengths, or hold a value that is not finite."""
    columns = [np.asarray(values, float) for values in episodes.values()]
    if len({len(column) for column in columns}) > 1 or not all(np.isfinite(column).all() for column in columns):
        raise ResultError(
            f"{what} have columns of several lengths, or a value that is not finite: run it again with --again, or "
            "move it away"
        )


def _check_comparable(studies: Sequence[dict[str, Any]], folder: Path) -> None:
    """Raise ResultError if cells differ in more than the method and its settings."""
    for name in (*SAME, *SAME_IF_STATED):
        values = {str(study.get(name)) for study in studies if name in SAME or study.get(name)}
        if len(values) > 1:
            raise ResultError(
                f"{folder}: the cells have more than one {name} ({', '.join(sorted(values))}): move the older "
                "ones away, or give another --results"
            )
    for study in studies:
        states_set = compared(study["method"]).filter == DDPC or study["method"] == NONE
        if study.get("task") and states_set and not study.get("model_set"):
            raise ResultError(
                f"{folder}: {study['method']}-s{study['seed']} does not state the model set that filtered the robot: "
                "run it again with --again, or move it away"
            )
    for method in {study["method"] for study in studies}:
        if len({_settings(study) for study in studies if study["method"] == method}) > 1:
            raise ResultError(SEVERAL.format(folder=folder, method=method))


def _settings(study: dict[str, Any]) -> str:
    """Return the settings of a cell's filter and learner, without defaults of the learner: older cells lack some."""
    td3 = {name: value for name, value in study["td3"].items() if value != getattr(TD3Config(), name, None)}
    return json.dumps(
        [study.get("model_config"), study.get("penalty", 1.0), study.get("code", ""), td3], sort_keys=True
    )
