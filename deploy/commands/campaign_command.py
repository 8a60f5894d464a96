"""Implement `brakeline campaign`: many episodes of many kinds, and a search for the worst ones."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import tyro

from brakeline.deploy.commands import common_options as options
from brakeline.deploy.commands.command_output import console, print_json
from brakeline.deploy.experiments.task_engine import Engine
from brakeline.deploy.progress import say
from brakeline.logs.stacking_table import plain_table
from brakeline.messaging.task import STUDIED

if TYPE_CHECKING:
    from brakeline.deploy.experiments.campaign import CampaignPart
    from brakeline.messaging.task import RobotWithTask

COLLIDED = 3  # exit status


@dataclass(frozen=True)
class CampaignCommand:
    """The options of `brakeline campaign`."""

    robots: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[ROBOT ...]")] = ("ground",)
    """Drive these robots."""
    arenas: tuple[str, ...] = STUDIED
    """Drive in arenas of these names. A robot of your own without an arena of the name dense drives in default."""
    policies: tuple[str, ...] = ("trained", "random", "adversary")
    """Drive by these policies, as `brakeline evaluate` names them."""
    model_sets: tuple[str, ...] = ("auto",)
    """Filter with these model sets: auto (the one in use), one-step, residual, set-membership or matrix-zonotope (in
    the mode direct), or none for no filter."""
    perturbations: tuple[str, ...] = ("as-recorded",)
    """Change the robot like this: as-recorded, noisy, payload, weak-motor, slippery, uneven (ground robots), wind (in
    the air), scan or faulty-scan."""
    episodes: int = 1000
    """Drive this many episodes for each combination of arena, policy, model set and perturbation (a cell). A later
    campaign with more episodes continues after these."""
    search: int = 0
    """Also search for the worst case of each arena, model set and perturbation, for this many episodes."""
    near: float | None = None
    """Store the log of each episode in which the robot comes nearer than this to something [m]. Defaults to 5 % of the
    radius of the robot."""
    accept_bound: options.AcceptBound = None
    engine: options.Unprefixed[Engine] = field(default_factory=lambda: Engine(workers=2))
    again: bool = False
    """Delete the stored results of the same cells first, and drive them again."""
    results: Path = Path("results/campaign")
    """Store the tables in this folder. The cells of earlier campaigns stay in the tables."""
    runs: Path = Path("runs/campaign")
    """Store the rows of all episodes, and the logs of those that came too near, in this folder."""
    quiet: options.Quiet = False
    json: options.Json = False

    extras: ClassVar[tuple[str, ...]] = ("sim", "train", "logs")

    def run(self) -> int:
        """Drive what is missing and write the tables. Returns the exit status: 3 if a filtered robot hit something."""
        self.check_options()
        tables = {robot: self._campaign(robot) for robot in self.robots}
        if self.json:
            print_json(tables)
        driven = [one for table in tables.values() for one in (*table["cells"], *table["searches"])]
        return COLLIDED if any(one["collisions"] for one in driven if one["model_set"] != "none") else 0

    def check_options(self) -> None:
        """Raise ValueError for numbers that make no sense, and for lists without a name: a table would become empty."""
        for option in ("robots", "arenas", "policies", "model_sets", "perturbations"):
            if not getattr(self, option):
                raise ValueError(f"name at least one of the {option.replace('_', ' ')}")
        if self.episodes < 1 or self.search < 0:
            raise ValueError("--episodes is a number from 1 on, and --search a number from 0 on")
        if self.near is not None and not self.near >= 0.0:
            raise ValueError(f"--near is a distance from 0 m on, not {self.near}")

    def _campaign(self, name: str) -> dict[str, Any]:
        """Drive the episodes of a robot, add them to its table, and return their figures."""
        from brakeline.deploy.experiments import campaign
        from brakeline.deploy.experiments.campaign import CampaignPart, cells_of, log_path, parts_of_cell, search_of
        from brakeline.deploy.experiments.experiment_jobs import check_writable, complete
        from brakeline.messaging.atomic_files import write_atomically
        from brakeline.messaging.task import address, robot_with_task, studied_arenas

        robot = robot_with_task(name)
        near = campaign.NEAR * robot.footprint if self.near is None else self.near
        arenas = studied_arenas(robot, self.arenas)
        cells = [
            CampaignPart(address(name), arena, policy, model_set, perturbation, near, 0, 1, self.accept_bound)
            for arena, policy, model_set, perturbation in product(
                arenas, self.policies, self.model_sets, self._perturbations(robot.position_dim)
            )
        ]
        # A mistyped name ends the campaign before it begins; models are made once.
        cells = [self._prepared(robot, cell) for cell in cells]
        own = robot.task.name  # additional tasks of a robot have tables of their own
        path = self.results / f"{own}.json"
        check_writable(self.results)  # before the first of hours of episodes
        campaign.check_addable(campaign.table_of(path), cells, path, bool(self.search))
        parts = [part for cell in cells for part in parts_of_cell(cell, self.episodes)]
        results = complete(parts, self.runs, self.runs, self.engine, self.again, say)
        searched = {(cell.arena, cell.model_set, cell.perturbation): cell for cell in cells if self.search}
        searches = [search_of(cell, self.search) for cell in searched.values()]
        worst = complete(searches, self.runs, self.runs, self.engine, self.again, say)
        worst_cases = [
            one | {"log": log_path(self.runs, job, one["log"])} for job, one in zip(searches, worst, strict=True)
        ]
        driven = cells_of(parts, results, self.runs)
        new = {"cells": driven, "searches": worst_cases}
        earlier = campaign.table_of(path)  # another campaign may have ended in the meantime
        table = {name: campaign.added(earlier[name], entries) for name, entries in new.items()}
        write_atomically(self.results / f"{own}.md", campaign.markdown(own, **table).encode())
        write_atomically(path, f"{json.dumps({'robot': own} | table, indent=1)}\n".encode())
        if not self.json:
            console.print(plain_table(*campaign.cell_table(driven)))
            if worst_cases:
                console.print(plain_table(campaign.SEARCH_HEADS, campaign.search_rows(worst_cases)))
            console.print(f"{self.results}: {own}.md, {own}.json", style="dim", markup=False)
        return {"robot": own} | new

    def _perturbations(self, dimensions: int) -> list[str]:
        """Return the perturbations that this kind of robot has. Raises ValueError for an unknown one."""
        from brakeline.deploy.experiments.campaign import perturbations

        mine, every = perturbations(dimensions), perturbations(2) | perturbations(3)
        for name in self.perturbations:
            if name not in every:
                raise ValueError(f"no perturbation is called {name!r}; there are: {', '.join(every)}")
        return [name for name in self.perturbations if name in mine]

    def _prepared(self, robot: RobotWithTask, cell: CampaignPart) -> CampaignPart:
        """Check the names of a cell, make the model set that it needs, and note the versions of all files."""
        from brakeline.deploy.experiments.evaluate import model_of
        from brakeline.deploy.experiments.experiment_jobs import task_hash
        from brakeline.deploy.policy_loading import policy_hash, policy_named
        from brakeline.messaging.task import arena_kind
        from brakeline.messaging.task_code import is_own_code

        arena_kind(robot, cell.arena)
        if cell.policy.endswith(".csv"):
            raise ValueError(
                f"{cell.policy}: written inputs are one sequence, but a campaign's episodes are independent"
            )
        if is_own_code(cell.policy):
            raise ValueError(
                f"{cell.policy}: a campaign goes on later, and cannot see whether the files that your code reads have "
                "changed: drive it with `brakeline evaluate`"
            )
        policy_named(cell.policy, robot, 0)
        model = model_of(robot, cell.evaluation())
        version = "" if model is None else model.version
        return replace(cell, model=version, weights=policy_hash(cell.policy, robot), task=task_hash(cell.robot))
