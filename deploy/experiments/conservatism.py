"""Measure how conservative each error bound is in both modes (docs/method.md §6).

The table states half-widths of a full stop, the validation on held-out plans, and closed-loop goal rates of A* and of
the stored policy, which was trained with the default error bound. If the set of a full stop is wider than the arena,
the filter cannot verify any motion, and the closed loop is skipped.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from brakeline.deploy.data.certification import certify
from brakeline.deploy.data.data_paths import record_path
from brakeline.deploy.data.simulated_recording import load_or_record
from brakeline.deploy.experiments.comparison_table import markdown_table
from brakeline.deploy.experiments.episode_table import EpisodeTable
from brakeline.deploy.experiments.evaluate import in_process
from brakeline.deploy.experiments.experiment_jobs import configuration, result_path, stored_result
from brakeline.deploy.experiments.trials import fresh_trial
from brakeline.errors import BadData, ErrorBoundError, ResultError
from brakeline.messaging.stated_share import percent
from brakeline.messaging.task import arena_kind, robot_with_task
from brakeline.safety.model.dataset import Dataset
from brakeline.safety.model.model_config import KINDS, MODES, ModelConfig

ORACLE = "astar"
ANY_BOUND = 1.0  # accept every bound: the experiment measures it, in a simulator


@dataclass(frozen=True)
class Conservatism:
    """A job of `deploy/experiments/experiment_jobs.py`."""

    robot: str
    episodes: int = 60
    arena: str = "default"
    policies: tuple[str, ...] = (ORACLE, "trained")
    task: str = ""  # see `experiment_jobs.task_hash`

    @property
    def name(self) -> str:
        return "conservatism"

    def check_recording(self, results: Path) -> None:
        """Raise ResultError if the stored result is of another recording than the one in use."""
        path, recording = result_path(results, self), record_path(robot_with_task(self.robot))
        if not (path.exists() and recording.exists()):
            return
        stored, present = stored_result(path).get("data"), Dataset.load(recording).steady().digest()
        if stored != present:
            raise ResultError(
                f"{path} was measured on another recording ({stored}) than {recording} ({present}): move it away, and "
                "it is measured again, or give --no-conservatism"
            )

    def run(self, folder: Path, say: Callable[[str], object] = lambda text: None) -> dict[str, Any]:
        """Return one row per error bound and mode; a row without a model set gives the reason."""
        robot = robot_with_task(self.robot)
        data = load_or_record(robot).steady()
        rows = []
        for certificate in KINDS:
            for mode in MODES:
                say(f"{certificate}, {mode}")
                model_config = ModelConfig(certificate, mode)
                row: dict[str, Any] = asdict(model_config)
                try:
                    model, statement = certify(data, model_config)
                except (BadData, ErrorBoundError) as error:
                    rows.append(row | {"refused": str(error)})
                    continue
                row |= {"model": model.version, "statement": statement.figures()}
                driving = None
                if statement.half_width_full <= arena_kind(robot, self.arena).half_width:
                    ask = in_process(model, ANY_BOUND)
                    trials = {name: fresh_trial(robot, self.arena, name, ask, self.episodes) for name in self.policies}
                    driving = {name: _figures_of(table) for name, table in trials.items()}
                rows.append(row | {"driving": driving})
        return {"study": configuration(self), "data": data.digest(), "rows": rows}


def _figures_of(table: EpisodeTable) -> dict[str, Any]:
    columns, steps = table.columns(), table.decisions
    return {
        "goals": sum(columns["goal"]),
        "collisions": sum(columns["collision"]),
        "interventions": sum(columns["interventions"]) / max(steps, 1),
        "steps": steps,
        "decision_ms": table.decision_ms(),
    }


def markdown(result: dict[str, Any]) -> str:
    """Return the rows as a Markdown table."""
    policies, episodes = result["study"]["policies"], result["study"]["episodes"]
    heads = ["certificate", "mode", "stop from rest", "from full speed", "plans outside", "at most"]
    heads += [f"{policy}: goals of {episodes}, interventions" for policy in policies]
    rows = []
    for row in result["rows"]:
        figures = [f"refused: {row['refused']}"] if "refused" in row else _figures(row, policies)
        cells = [row["certificate"], row["mode"], *figures]
        rows.append(cells + [""] * (len(heads) - len(cells)))
    note = (
        "Half-widths of a full stop's set on its widest axis; held-out plans outside their tubes, and the bound on "
        "that at 99 % confidence, rounded up."
    )
    return "\n".join([f"# Conservatism: {result['study']['robot']}", "", *markdown_table(heads, rows), "", note])


def _length(metres: float) -> str:
    return f"{1e3 * metres:.1f} mm" if metres < 1.0 else f"{metres:.3g} m"


def _figures(row: dict[str, Any], policies: Sequence[str]) -> list[str]:
    validation, driving = row["statement"], row["driving"]
    figures = [_length(validation[name]) for name in ("half_width_rest", "half_width_full")]
    figures += [f"{validation['violations']} of {validation['windows']}", percent(validation["bound_plan"])]
    if driving is None:
        return [*figures, "not driven: wider than the arena"]
    return figures + [f"{driving[policy]['goals']}, {driving[policy]['interventions']:.1%}" for policy in policies]
