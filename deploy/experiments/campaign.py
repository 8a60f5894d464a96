"""`brakeline campaign`: a table over robots, arenas, policies, model sets and perturbations; a search for the worst.

runs/campaign/<robot>/<part>.json            a part of a cell: one row per episode; a campaign goes on after them
runs/campaign/<robot>/<part>/<episode>.mcap  the log of an episode that came too near to something
results/campaign/<robot>.md, <robot>.json    the table of all campaigns with this folder
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

from brakeline.deploy.commands.common_options import PhysicsOptions
from brakeline.deploy.experiments.comparison_table import markdown_table
from brakeline.deploy.experiments.task_engine import folder_of
from brakeline.deploy.progress import errors_only
from brakeline.errors import BadText, ResultError
from brakeline.logs.proportion_intervals import ClusteredProportion, clopper_pearson
from brakeline.messaging.structured_text import parse_json
from brakeline.safety.model.model_config import KINDS, ModelConfig

if TYPE_CHECKING:
    from brakeline.deploy.experiments.evaluate import Evaluation

PART = 500  # episodes of a part
AXES = ("arena", "policy", "model set", "perturbation")  # of the cells
PACKAGES = ("brakeline", "mujoco", "numpy")  # whose versions a result states
NOT_STATED = "not stated"
NEAR = 0.05  # of the footprint: an episode that comes nearer is kept

# What differs from the robot that was recorded. Names say the change; a value of None does nothing.
PERTURBATIONS = {
    "as-recorded": PhysicsOptions(),
    "noisy": PhysicsOptions(noise=1.5),
    "scan": PhysicsOptions(perception="scan"),
    "faulty-scan": PhysicsOptions(perception="scan", dropped=0.1, ghosts=0.01),
}
ON_THE_GROUND = {
    "payload": PhysicsOptions(payload=1.0),
    "weak-motor": PhysicsOptions(weak_motor=0.6),
    "slippery": PhysicsOptions(friction=0.3),
    "uneven": PhysicsOptions(process_noise=2.0),
}
IN_THE_AIR = {
    "payload": PhysicsOptions(payload=0.2),
    "weak-motor": PhysicsOptions(weak_motor=0.9),
    "wind": PhysicsOptions(wind=2.0, gust=0.5),
}
MODEL_SETS = ("auto", "one-step", *KINDS)  # the mode one-step, or an error bound in the mode direct


def perturbations(dimensions: int) -> dict[str, PhysicsOptions]:
    """Return the perturbations of a robot by their names, for the number of its position coordinates."""
    return PERTURBATIONS | (IN_THE_AIR if dimensions == 3 else ON_THE_GROUND)


def model_config_of(name: str) -> ModelConfig:
    """Return the configuration of a model set by its name in `MODEL_SETS`. Raises ValueError."""
    if name not in MODEL_SETS:
        raise ValueError(f"no model set is called {name!r}; there are: {', '.join(MODEL_SETS)}")
    return ModelConfig(name, "direct") if name in KINDS else ModelConfig(mode=name)


@dataclass(frozen=True)
class CampaignPart:
    """Some episodes of a cell, as a job of `deploy/experiments/experiment_jobs.py`.

    Attributes:
        robot: name, or the path of a description.
        arena, policy: names.
        model_set: see `MODEL_SETS`; "none" drives without a filter.
        perturbation: see `perturbations`.
        near: distance [m] below which an episode's log is kept.
        first, episodes: number of the first episode, and how many there are.
        model, weights: version of the model set, and hash of the policy's file. Empty: none, or an older result.
        task: see `experiment_jobs.task_hash`.
    """

    robot: str
    arena: str
    policy: str
    model_set: str
    perturbation: str
    near: float
    first: int
    episodes: int
    accept_bound: float | None = None
    model: str = ""
    weights: str = ""
    task: str = ""

    @property
    def cell(self) -> str:
        return f"{self.arena}-{Path(self.policy).stem}-{self.model_set}-{self.perturbation}"

    @property
    def name(self) -> str:
        return f"{self.cell}-{self.first:06d}-{self.episodes}"

    def evaluation(self) -> Evaluation:
        """Return the settings of the cell. Raises ValueError for an unknown model set."""
        from brakeline.deploy.experiments.evaluate import Evaluation
        from brakeline.messaging.robot import robot_named

        physics = perturbations(robot_named(self.robot).position_dim)[self.perturbation]
        filtered = self.model_set != "none"
        return Evaluation(
            policy=self.policy,
            method="ddpc" if filtered else "none",
            model_config=model_config_of(self.model_set) if filtered else ModelConfig(),
            arena=self.arena,
            conditions=physics.conditions(),
            accept_bound=self.accept_bound,
        )

    @errors_only("brakeline.safety")  # the table counts the steps outside their sets, and a changed robot has many
    def run(self, folder: Path, say: Callable[[str], object]) -> dict[str, Any]:
        """Drive the episodes, and keep the logs of those that came too near to something."""
        from brakeline.deploy.experiments.campaign_episodes import CampaignDriver, too_near
        from brakeline.deploy.experiments.experiment_jobs import configuration
        from brakeline.deploy.policy_loading import policy_hash
        from brakeline.messaging.task import robot_with_task

        robot, ended = robot_with_task(self.robot), 0
        driver = CampaignDriver.of(robot, self.evaluation())
        if self.model and (driver.model is None or driver.model.version != self.model):
            raise ResultError(f"the model set of {self.cell} is no longer {self.model}: run the campaign again")
        if self.weights and policy_hash(self.policy, robot) != self.weights:
            raise ResultError(f"{self.policy} has changed since the campaign began: run it again")

        def count_episode() -> None:
            nonlocal ended
            ended += 1
            if ended % 20 == 0:
                say(f"{ended} of {self.episodes} episodes")

        rows = driver.drive(self.first, self.episodes, count_episode)
        near = []
        for number, row in enumerate(rows, self.first):
            if driver.model is not None and too_near(row, self.near):
                log = f"{number}.mcap"
                again = driver.record(number, folder / log)
                near.append({"episode": number, "closest": row["closest"], "again": again["closest"], "log": log})
        columns = {name: [row[name] for row in rows] for name in rows[0]}
        versions = ", ".join(f"{name} {version(name)}" for name in PACKAGES)
        return {"study": configuration(self), "versions": versions, "episodes": columns, "near": near}


@dataclass(frozen=True)
class CampaignSearch:
    """A search for the worst episode of an arena, a model set and a perturbation, as a job.

    Attributes:
        cell: its robot, arena, model set and perturbation.
        episodes: that it may drive.
    """

    cell: CampaignPart
    episodes: int

    @property
    def robot(self) -> str:
        return self.cell.robot

    @property
    def name(self) -> str:
        return f"search-{self.cell.arena}-{self.cell.model_set}-{self.cell.perturbation}-{self.episodes}"

    @errors_only("brakeline.safety")
    def run(self, folder: Path, say: Callable[[str], object]) -> dict[str, Any]:
        """Search, and keep the log of the worst episode."""
        from brakeline.deploy.experiments.experiment_jobs import configuration
        from brakeline.deploy.experiments.worst_case_search import search
        from brakeline.messaging.task import robot_with_task

        log = "worst.mcap"
        worst = search(robot_with_task(self.robot), self.cell.evaluation(), self.episodes, folder / log, say)
        about = {"arena": self.cell.arena, "model_set": self.cell.model_set, "perturbation": self.cell.perturbation}
        return {"study": configuration(self), **about, **worst, "log": log}


def search_of(cell: CampaignPart, episodes: int) -> CampaignSearch:
    """Return the search for the worst episode of a cell. It is the same whatever the cell's policy."""
    return CampaignSearch(replace(cell, policy="", weights="", near=0.0), episodes)


def log_path(runs: Path, job: CampaignPart | CampaignSearch, log: str) -> str:
    """Return the path of a log of a job. Older results have the whole path."""
    return log if "/" in log else str(folder_of(runs, job) / log)


def parts_of_cell(cell: CampaignPart, episodes: int) -> list[CampaignPart]:
    """Cut a cell of so many episodes into parts. A longer campaign later goes on after the same parts."""
    return [replace(cell, first=first, episodes=min(PART, episodes - first)) for first in range(0, episodes, PART)]


def cells_of(parts: Sequence[CampaignPart], results: Sequence[dict[str, Any]], runs: Path) -> list[dict[str, Any]]:
    """Return the figures of each cell, in the order of the parts. runs: folder of the parts' logs."""
    cells: dict[str, tuple[CampaignPart, list[dict[str, Any]]]] = {}
    for part, result in zip(parts, results, strict=True):
        near = [one | {"log": log_path(runs, part, one["log"])} for one in result["near"]]
        cells.setdefault(part.cell, (part, []))[1].append(result | {"near": near})
    return [_figures(part, own) for part, own in cells.values()]


def _figures(cell: CampaignPart, results: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Return the figures of a cell over all its parts, with 95 % intervals (`logs/proportion_intervals.py`)."""
    columns = {
        name: [value for result in results for value in result["episodes"][name]] for name in results[0]["episodes"]
    }
    closest, episodes, interventions = min(columns.pop("closest")), len(columns["steps"]), ClusteredProportion()
    count = {name: int(sum(values)) for name, values in columns.items()}
    for hits, steps in zip(columns["interventions"], columns["steps"], strict=True):
        interventions.add(hits, steps)
    touched = sum(map(any, zip(columns["collision"], columns["contact_moving"], strict=True)))
    return {
        "arena": cell.arena,
        "policy": Path(cell.policy).stem,
        "model_set": cell.model_set,
        "perturbation": cell.perturbation,
        "model": cell.model or "none",
        "weights": cell.weights,
        "versions": sorted({result.get("versions", NOT_STATED) for result in results}),
        "episodes": episodes,
        "steps": count["steps"],
        "goals": count["goal"],
        "goals_interval": clopper_pearson(count["goal"], episodes),
        "collisions": touched,
        "collisions_interval": clopper_pearson(touched, episodes),
        "contacts_standing": count["contact_standing"],
        "timeouts": count["timeout"],
        "interventions": count["interventions"],
        "interventions_interval": interventions.interval(),
        **{name: count[name] for name in ("failsafes", "compared", "violations")},
        "violations_interval": clopper_pearson(count["violations"], count["compared"]),
        "closest": closest,
        "near": [episode for result in results for episode in result["near"]],
    }


def table_of(path: Path) -> dict[str, Any]:
    """Return the table of earlier campaigns in a file, without cells if there is none. Raises ResultError: damaged."""
    if not path.exists():
        return {"cells": [], "searches": []}
    try:
        table = parse_json(path.read_bytes())
        cells, searches = table["cells"], table["searches"]
        for one in (*cells, *searches):
            _cell_key(one)
    except (BadText, KeyError, TypeError) as error:
        raise ResultError(f"{path} holds no table of a campaign: move it away, or give another --results") from error
    return {"cells": cells, "searches": searches}


def check_addable(table: dict[str, Any], cells: Sequence[CampaignPart], path: Path, searched: bool = False) -> None:
    """Raise ResultError if earlier cells or searches would stand beside cells of another model set or policy.

    searched: whether the campaign searches for the worst cases of the cells, too.
    """
    driven_again = {(cell.arena, Path(cell.policy).stem, cell.model_set, cell.perturbation) for cell in cells}
    if searched:
        driven_again |= {(cell.arena, "", cell.model_set, cell.perturbation) for cell in cells}
    versions = {cell.model_set: cell.model or "none" for cell in cells}
    weights = {Path(cell.policy).stem: cell.weights for cell in cells}
    for one in (*table["cells"], *table["searches"]):
        if _cell_key(one) in driven_again:
            continue
        what, now = "", versions.get(one["model_set"])
        model = one.get("model") or one.get("study", {}).get("cell", {}).get("model") or now  # older searches have none
        if now not in (None, model):
            what = f"the model set {model}, which is now {now}"
        elif one.get("weights") and one["weights"] != weights.get(one["policy"], one["weights"]):
            what = f"an earlier policy {one['policy']}"
        if what:
            raise ResultError(
                f"{path} holds {'cells' if 'policy' in one else 'searches'} of {what}: drive these again in the same "
                "campaign, move the file away, or give another --results"
            )


def added(earlier: Sequence[dict[str, Any]], new: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the cells, or the searches, of earlier campaigns and new ones. A new one replaces the same earlier one."""
    return list({_cell_key(one): one for one in (*earlier, *new)}.values())


def _cell_key(cell: dict[str, Any]) -> tuple[str, ...]:
    """Return what names a cell in a table, or a search, which has no policy."""
    return cell["arena"], cell.get("policy", ""), cell["model_set"], cell["perturbation"]


SEARCH_HEADS = ("arena", "model set", "perturbation", "episodes", "collisions", "closest [mm]", "log")


def cell_table(cells: Sequence[dict[str, Any]]) -> tuple[list[str], list[list[str]]]:
    """Return the heads and the texts of the table of cells.

    The column of walkers that ran into the standing robot is left out where there are none, and the one of versions if
    one version drove all cells.
    """
    versions = ["; ".join(cell.get("versions", [NOT_STATED])) for cell in cells]
    columns = {
        **{name: [cell[name.replace(" ", "_")] for cell in cells] for name in AXES},
        "episodes": [f"{cell['episodes']:,}" for cell in cells],
        "goals": [_percent(cell["goals"], cell["episodes"], cell["goals_interval"]) for cell in cells],
        "collisions": [
            f"{cell['collisions']}: {_percent(cell['collisions'], cell['episodes'], cell['collisions_interval'])}"
            for cell in cells
        ],
        "run into, standing": [str(cell.get("contacts_standing", 0)) for cell in cells],
        "interventions": [
            _percent(
                cell["interventions"],
                cell["steps"] if cell["model_set"] != "none" else 0,
                cell["interventions_interval"],
            )
            for cell in cells
        ],
        "steps outside": [
            _percent(cell["violations"], cell["compared"], cell["violations_interval"]) for cell in cells
        ],
        "closest [mm]": [f"{1e3 * cell['closest']:.1f}" for cell in cells],
        "near misses": [str(len(cell["near"])) for cell in cells],
    }
    if not any(cell.get("contacts_standing") for cell in cells):
        del columns["run into, standing"]
    if len({*versions}) > 1 or any(";" in text for text in versions):
        columns["driven by"] = versions
    return list(columns), [list(row) for row in zip(*columns.values(), strict=True)]


def search_rows(searches: Sequence[dict[str, Any]]) -> list[list[str]]:
    """Return the texts of the table of searches, below `SEARCH_HEADS`."""
    return [
        [
            *(search[name] for name in ("arena", "model_set", "perturbation")),
            f"{search['episodes']:,}",
            str(search["collisions"]),
            f"{1e3 * search['closest']:.1f}",
            search["log"],
        ]
        for search in searches
    ]


def markdown(robot: str, cells: Sequence[dict[str, Any]], searches: Sequence[dict[str, Any]] = ()) -> str:
    """Return the tables of a robot as Markdown."""
    lines = [
        f"# {robot}",
        "",
        "Fresh episodes, each independent of the others. In brackets: 95 % intervals, exact (Clopper–Pearson) for "
        "episodes and steps, clustered by episode for interventions. A step is outside if the measured state left the "
        "set that the filter predicted.",
        "",
        *markdown_table(*cell_table(cells)),
        "",
    ]
    if searches:
        lines += [
            "## Worst cases that a search found",
            "",
            "CMA-ES moves the obstacles and chooses the proposed inputs so that the robot comes as near as possible.",
            "",
            *markdown_table(SEARCH_HEADS, search_rows(searches)),
            "",
        ]
    return "\n".join(lines)


def _percent(count: int, of: int, interval: Sequence[float] | None) -> str:
    if not of or interval is None:
        return "–"
    return f"{100.0 * count / of:.2f} % [{100.0 * interval[0]:.2f}, {100.0 * interval[1]:.2f}]"
