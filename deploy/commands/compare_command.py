"""`brakeline pretrain` and `brakeline compare`."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro
from rich.markdown import Markdown

from brakeline.deploy.commands.common_options import Robot, console, errors, say_json
from brakeline.deploy.data.data_paths import method_path
from brakeline.deploy.data.model_store import method_for, pretrained
from brakeline.deploy.data.rival_pretraining import recipe_for
from brakeline.deploy.experiments import compare, conservatism
from brakeline.deploy.experiments.compare import RESULTS, RUNS, SEEDS, Cell
from brakeline.deploy.experiments.comparison_cells import METHODS, NONE, Study, quick
from brakeline.deploy.experiments.comparison_plots import learning_curves, seeds_as_points
from brakeline.deploy.experiments.comparison_table import markdown, plain, table
from brakeline.deploy.experiments.experiment_jobs import Job, complete
from brakeline.deploy.experiments.rival_tuning import Tried, best, try_all, values_for
from brakeline.learner.learner_config import TD3Config
from brakeline.messaging.task import RobotWithTask, address, robot_with_task
from brakeline.safety.model.model_set import ModelConfig
from brakeline.safety.rivals.pretrained import Pretrained

QUICK = Path("runs/quick")


@dataclass(frozen=True)
class Pretrain:
    method: Annotated[Literal["secas", "sailr"], tyro.conf.Positional]
    """The rival."""
    robot: Robot = "ground"
    samples: int | None = None
    """Steps to drive; default: the recipe's."""
    seed: int | None = None
    tune: bool = False
    """Try values of its one threshold in closed loop, and say which to use; nothing is stored."""
    episodes: int = 60
    """Of each driver and value, when tuning."""
    json: bool = False

    def run(self) -> int:
        robot = robot_with_task(self.robot)
        recipe = recipe_for(self.method, robot)
        changed = {name: value for name in ("samples", "seed") if (value := getattr(self, name)) is not None}
        model = pretrained(robot, self.method, replace(recipe, **changed), again=not self.tune)
        if self.tune:
            return self._tune(model, robot)
        path = method_path(robot, self.method, ModelConfig())
        if self.json:
            say_json({"path": str(path), "version": model.version, "settings": dict(model.settings)} | model.about)
        else:
            console.print(f"{path}: {model.version}")
        return 0

    def _tune(self, model: Pretrained, robot: RobotWithTask) -> int:
        rows = try_all(model, robot, values_for(model, robot), self.episodes, self._say)
        chosen = best(rows)
        if self.json:
            say_json({"tried": [row.figures() for row in rows], "best": chosen.value})
        else:
            console.print(f"best: {chosen.value:g}, of those that cost A* no goal the one with the fewest collisions")
        return 0

    def _say(self, row: Tried) -> None:
        (errors if self.json else console).print(
            f"{row.value:g}: A* {row.oracle_goals} goals of {row.episodes}, {row.oracle_interventions:.1%} "
            f"interventions; greedy {row.greedy_goals} goals, {row.greedy_collisions} collisions"
        )


@dataclass(frozen=True)
class Compare:
    robots: Annotated[tuple[str, ...], tyro.conf.Positional] = ("ground",)
    seeds: tuple[int, ...] = SEEDS
    steps: int | None = None
    """Of training; default: the comparison's own for each robot."""
    episodes: int | None = None
    """Of evaluation, a seed and arena."""
    arenas: tuple[str, ...] = Study.arenas
    """Of the evaluation; training is in the first. Give other --results where there are some of others."""
    methods: tuple[str, ...] = METHODS
    quick: bool = False
    """A minute or two with the same code: few steps, small networks, one seed; into runs/quick, always anew."""
    workers: int = 2
    """Cells at once, each on one core."""
    again: bool = False
    """Run what is there already anew."""
    conservatism: bool = True
    """Also the table of certificates and modes, with the stored policy."""
    penalty: float = 1.0
    """For a correction by the whole range of an input; with --td3 and another --results to try what learning needs."""
    td3: TD3Config = field(default_factory=TD3Config)
    results: Path = RESULTS
    runs: Path = RUNS
    """Where the logs and policies of the cells go."""
    json: bool = False

    def run(self) -> int:
        results, runs, again = self.results, self.runs, self.again
        if self.quick:
            results, runs, again = (
                QUICK / "results" if results == RESULTS else results,
                QUICK / "runs" if runs == RUNS else runs,
                True,
            )
        told: dict[str, Any] = {}
        for name in self.robots:
            robot = address(name)
            self._prepare(robot)
            jobs = self._jobs(robot)
            found = complete(jobs, results, runs, self.workers, again, self._say)
            cells = [result for result, job in zip(found, jobs, strict=True) if isinstance(job, Cell)]
            rest = [result for result, job in zip(found, jobs, strict=True) if not isinstance(job, Cell)]
            told[robot] = self._show(robot, cells, rest, results / robot)
        if self.json:
            say_json(told)
        return 0

    def _prepare(self, robot: str) -> None:
        """What several cells need is made once, before them."""
        for method in self.methods:
            if method != NONE:
                method_for(robot_with_task(robot), method, ModelConfig())

    def _jobs(self, robot: str) -> list[Job]:
        seeds = self.seeds[:1] if self.quick else self.seeds
        wanted = [study for study in compare.studies(robot, seeds) if study.method in self.methods]
        given = {name: value for name in ("steps", "episodes") if (value := getattr(self, name)) is not None}
        wanted = [replace(study, penalty=self.penalty, td3=self.td3, arenas=self.arenas) for study in wanted]
        jobs: list[Job] = [Cell(replace(quick(study) if self.quick else study, **given)) for study in wanted]
        if self.conservatism and not self.quick:
            jobs.append(conservatism.Conservatism(robot))
        return jobs

    def _say(self, name: str, text: str) -> None:
        errors.print(f"[dim]{name}:[/] {text}")

    def _show(self, robot: str, cells: list[dict[str, Any]], rest: list[dict[str, Any]], folder: Path) -> Any:
        figures = table(cells)
        text = markdown(figures)
        (folder / "table.md").write_text(text + "\n")
        (folder / "table.json").write_text(json.dumps(plain(figures), indent=1) + "\n")
        learning_curves(cells, folder / "curves.png")
        seeds_as_points(figures, folder / "seeds.png")
        for result in rest:
            rows = conservatism.markdown(result)
            (folder / "conservatism.md").write_text(rows + "\n")
            text += "\n" + rows
        if not self.json:
            console.print(Markdown(text))
            console.print(f"[dim]{folder}: table.md, table.json, curves.png, seeds.png[/]")
        return plain(figures) | {"conservatism": rest[0]["rows"] if rest else None}
