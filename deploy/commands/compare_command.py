"""Implement `brakeline compare`: train and evaluate each method from the same seeds."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

import tyro
from rich.markdown import Markdown

from brakeline.deploy.commands.command_output import console, print_json
from brakeline.deploy.commands.common_options import Json, Mode, Quiet, Unprefixed, given_settings
from brakeline.deploy.experiments.compared_methods import SAC_LEARNER, SAC_SETTINGS, compared
from brakeline.deploy.experiments.comparison_cells import (
    RESULTS,
    RUNS,
    CellConfig,
    cell_configs,
    compared_on,
    learning,
    quick,
)
from brakeline.deploy.experiments.experiment_jobs import Job, complete, read, task_hash
from brakeline.deploy.experiments.task_engine import Engine
from brakeline.deploy.progress import say
from brakeline.deploy.run.run_config import SEEDS, Internal
from brakeline.learner.learner_config import TD3Config
from brakeline.messaging.atomic_files import write_atomically
from brakeline.safety.model.model_config import ModelConfig

if TYPE_CHECKING:
    from brakeline.deploy.experiments.conservatism import Conservatism

QUICK = Path("runs/quick")
OUTPUT = {"robots", "results", "quiet", "json"}
USED = {  # options that --table and --tune use
    "table": {"table", "quick", *OUTPUT},
    "tune": {"tune", "methods", "arenas", "engine", "again", "runs", *OUTPUT},
}
OPTIONS = {
    **{"engine": "--workers or --ray", "conservatism": "--no-conservatism", "task_settings": "--no-task-settings"},
    "given": "--td3",
}

Results = list[dict[str, Any]]


@dataclass(frozen=True)
class CompareCommand:
    """The options of `brakeline compare`."""

    robots: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[ROBOT ...]")] = ("ground",)
    """Compare the methods on these robots."""
    seeds: tuple[int, ...] | None = None
    """Train each method once from each of these seeds. Defaults to 0 to 9 where a batch trains, and to 0, 1 and 2 where
    robots train one at a time."""
    steps: int | None = None
    """Train for this many steps. Defaults to the number that the comparison uses for each robot."""
    episodes: int | None = None
    """Evaluate on this many episodes for each seed and arena. Defaults to the number that the comparison uses."""
    arenas: tuple[str, ...] = CellConfig.arenas
    """Evaluate in these arenas, and train in the first. Give another --results folder with other arenas. A robot of
    your own without an arena of the name dense is evaluated in default alone."""
    methods: tuple[str, ...] | None = None
    """Compare these methods: ddpc (this project's own), sailr, secas, none (TD3 without a filter), lagrange, cbf, psf,
    sac, sac-ddpc, or FILE.py:CLASS for a filter of your own, which needs another --results folder (see docs/rivals.md).
    Defaults to all that the robot and the arenas allow."""
    backend: Literal["single", "batch"] | None = None
    """Train and evaluate many robots at once (batch), or one at a time (single). Defaults to batch where the robot and
    the arenas allow it."""
    mode: Mode | None = None
    """Filter with model sets of this mode, where our filter does. Defaults to direct, for a robot of your own to auto,
    the mode that was last put to use. Give another --results folder if you change it."""
    at_once: int | None = None
    """Train this many robots at once, where a batch trains. Defaults to the number in the robot's task. If you change
    it, give another --results folder."""
    quick: bool = False
    """Run the same code within minutes: few steps, small networks, one seed. Writes to runs/quick, always anew.
    """
    engine: Unprefixed[Engine] = field(default_factory=lambda: Engine(workers=2))
    tune: bool = False
    """Instead of comparing, try some values of one setting of each rival, and store the results for the results
    page."""
    table: bool = False
    """Run nothing: write tables, figures and the results page (README.md) from the stored results."""
    again: bool = False
    """Delete the stored results of these trainings (with --tune: of these trials) first, and run them again."""
    conservatism: bool = True
    """Also make the table of error bounds and modes, if a policy of the robot is stored."""
    penalty: float | None = None
    """Subtract this penalty from the learner's reward if the filter corrects an input by its whole range. Defaults to
    the one in the robot's task, for SECAS and SAILR to 1. Give another --results folder if you change it or --td3."""
    task_settings: bool = True
    """Train TD3 behind each filter but SAILR with the learner settings of the robot's task, such as the quadrotor's
    penalty growth and imitation. A --td3 option replaces the task's."""
    td3: TD3Config = field(default_factory=TD3Config)
    given: Internal[tuple[str, ...]] = ()  # names of the settings in `td3` that options give
    results: Path = RESULTS
    """Store the tables and figures in this folder."""
    runs: Path = RUNS
    """Store the logs and policies of the trainings in this folder."""
    quiet: Quiet = False
    json: Json = False

    extras: ClassVar[tuple[str, ...]] = ("sim", "train", "logs")

    @classmethod
    def defaults(cls, arguments: list[str]) -> Self:
        """Return the default options, with the names of the settings of TD3 that `arguments` give."""
        return cls(given=given_settings(arguments, "--td3."))

    def run(self) -> int:
        """Train, evaluate and write the tables. Returns the exit status."""
        from brakeline.deploy.experiments.results_page import page
        from brakeline.deploy.experiments.stored_cells import stored_cells
        from brakeline.deploy.experiments.task_engine import robot_folder
        from brakeline.deploy.experiments.tuning_trials import tuning_jobs
        from brakeline.messaging.task import address

        self._check_options()
        results, runs = self.results, self.runs
        if self.quick:
            results = QUICK / "results" if results == RESULTS else results
            runs = QUICK / "runs" if runs == RUNS else runs
        tables: dict[str, Any] = {}
        robots = [address(robot) for robot in self.robots]
        # A wrong option ends the command before the first of hours of training.
        jobs_of = {} if self.table or self.tune else {robot: self._jobs(robot) for robot in robots}
        jobs_of = {robot: (self._prepared(cells, results), others) for robot, (cells, others) in jobs_of.items()}
        for measured in (measured for _, others in jobs_of.values() for measured in others if not self.again):
            measured.check_recording(results)
        for robot in robots:
            if self.tune:
                trials = tuning_jobs(robot, self._methods(robot), self._arenas(robot))
                complete(trials, results, runs, self.engine, self.again, say)
                continue
            cells, others = jobs_of.get(robot, ([], []))
            self._say_stored(robot, [*cells, *others], results)
            finished = complete([*cells, *others], results, runs, self.engine, self.again or self.quick, say)
            shown = finished[: len(cells)] if self.quick and not self.table else stored_cells(results, robot)
            if not shown:
                raise ValueError(f"{results}: there are no results of {robot}; `brakeline compare` makes them")
            tables[robot] = self._write(shown, finished[len(cells) :], robot_folder(results, robot))
        if not self.quick:
            text = page(results, [folder.name for folder in sorted(results.iterdir()) if folder.is_dir()])
            write_atomically(results / "README.md", text.encode())
        if self.json:
            print_json(tables)
        return 0

    def _say_stored(self, robot: str, jobs: Sequence[Job], results: Path) -> None:
        """Print how many results are stored: if all are, the tables take a minute without further output."""
        if jobs and not (self.again or self.quick):
            stored = sum(read(results, job) is not None for job in jobs)
            advice = ". To train anew, give --again, or another --results folder" if stored else ""
            say(robot, f"{stored} of {len(jobs)} results are stored in {results}{advice}")

    def _check_options(self) -> None:
        """Raise ValueError for options that make no sense, or that do nothing beside --table or --tune."""
        if not (self.robots and self.arenas):
            raise ValueError("name at least one robot and at least one of the --arenas")
        if wrong := [seed for seed in self.seeds or () if not 0 <= seed < SEEDS]:
            raise ValueError(f"a seed is a number from 0 to {SEEDS - 1}, not {wrong[0]}: evaluations have larger ones")
        usual = CompareCommand()
        for mode, used in USED.items():
            if getattr(self, mode):
                names = [item.name for item in fields(self) if getattr(self, item.name) != getattr(usual, item.name)]
                if unused := [OPTIONS.get(name, f"--{name.replace('_', '-')}") for name in names if name not in used]:
                    raise ValueError(f"--{mode} ignores {', '.join(dict.fromkeys(unused))}: leave these options out")

    def _prepared(self, cells: list[CellConfig], results: Path) -> list[CellConfig]:
        """Make the models that several trainings need, and note a model set that does not come with Brakeline.

        Raises ResultError: the cells do not compare with the stored ones.
        """
        from brakeline.deploy.data.model_store import method_for
        from brakeline.deploy.experiments.stored_cells import check_addable
        from brakeline.messaging.task import robot_with_task
        from brakeline.messaging.task_code import is_own_code
        from brakeline.safety.model.model_config import DDPC
        from brakeline.safety.rivals.own_code import OwnCode

        robot, filters = robot_with_task(cells[0].robot), set().union(*(cell.filters() for cell in cells))
        models = {method: method_for(robot, method, cells[0].model_config) for method in sorted(filters)}
        for model in models.values():
            if isinstance(model, OwnCode):
                model.ready()  # code that cannot be loaded ends the command before the first training
        versions = {method: model.version for method, model in models.items()}
        noted = [
            replace(one, model_set=versions[DDPC]) if DDPC in one.filters() and not one.of_shipped_set() else one
            for one in cells
        ]
        noted = [replace(one, code=versions[one.method]) if is_own_code(one.method) else one for one in noted]
        if not self.quick:
            check_addable(results, noted)
        return noted

    def _arenas(self, robot: str) -> tuple[str, ...]:
        """Return the arenas of a robot's cells. Raises UnknownName: it has no such arena."""
        from brakeline.messaging.task import robot_with_task, studied_arenas

        return studied_arenas(robot_with_task(robot), self.arenas)

    def _methods(self, robot: str) -> tuple[str, ...]:
        methods = compared_on(robot, self._arenas(robot)) if self.methods is None else self.methods
        if any(compared(name).learner == SAC_LEARNER for name in methods):
            import_module("stable_baselines3")  # a missing extra is told before hours of other trainings
        return methods

    def _jobs(self, robot: str) -> tuple[list[CellConfig], list[Conservatism]]:
        """Return the cells of a robot, and the other jobs."""
        from brakeline.deploy.experiments.conservatism import Conservatism
        from brakeline.deploy.policy_loading import TRAINED, stored_policies
        from brakeline.messaging.task import check_penalty, robot_with_task

        described = robot_with_task(robot)
        check_penalty(self.penalty, described)
        cells = cell_configs(robot, self._methods(robot), self.seeds, self._arenas(robot), self.backend)
        if not cells:
            raise ValueError("nothing to compare: give at least one of --seeds and of --methods")
        cells = [cell for cell in cells if not self.quick or cell.seed == cells[0].seed]
        numbers: dict[str, Any] = {"steps": self.steps, "episodes": self.episodes, "robots": self.at_once}
        changed = {name: value for name, value in numbers.items() if value is not None}
        if few := [name for name, value in changed.items() if value < 1]:
            raise ValueError(f"the number of {few[0]} is at least 1, not {changed[few[0]]}")
        if self.penalty is not None:
            changed["penalty"] = self.penalty
        settings = described.task.learner if self.task_settings else {}
        ignored = [f"--td3.{name.replace('_', '-')}" for name in self.given if name not in SAC_SETTINGS]
        for label in {compared(cell.method).label for cell in cells if compared(cell.method).learner == SAC_LEARNER}:
            if ignored:
                say(robot, f"{label} has no {', '.join(ignored)}: it learns without")
        if self.mode is not None:
            changed["model_config"] = ModelConfig(mode=self.mode)
        own = [replace(cell, td3=learning(self.td3, cell.method, cell.robot, settings, self.given)) for cell in cells]
        chosen = [replace(quick(cell, self.given) if self.quick else cell, **changed) for cell in own]
        conservatism = self.conservatism and not self.quick and TRAINED in stored_policies(described)
        return chosen, [Conservatism(robot, task=task_hash(robot))] if conservatism else []

    def _write(self, cells: Results, others: Results, folder: Path) -> Any:
        """Write the tables and figures of a robot, and return its figures."""
        from brakeline.deploy.experiments import conservatism
        from brakeline.deploy.experiments.comparison_plots import learning_curves, profiles, seeds_as_points
        from brakeline.deploy.experiments.comparison_table import markdown, plain, table
        from brakeline.deploy.experiments.results_page import RobotResults

        figures = table(cells)
        text = markdown(figures, self.quick)
        write_atomically(folder / "table.md", f"{text}\n".encode())
        write_atomically(folder / "table.json", f"{json.dumps(plain(figures), indent=1)}\n".encode())
        learning_curves(cells, folder / "curves.png")
        seeds_as_points(figures, folder / "seeds.png")
        robot_results = RobotResults(folder.name, cells)
        profiles({method: robot_results.goals(method) for method in robot_results.cells}, folder / "profiles.png")
        for result in others:
            rows = conservatism.markdown(result)
            write_atomically(folder / "conservatism.md", f"{rows}\n".encode())
            text += "\n" + rows
        if not self.json:
            console.print(Markdown(text))
            console.print(
                f"{folder}: table.md, table.json, curves.png, seeds.png, profiles.png", style="dim", markup=False
            )
        return plain(figures) | {"conservatism": others[0]["rows"] if others else None}
