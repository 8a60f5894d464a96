"""Write results/README.md from the stored cells of all comparisons, as the experiments section of an article.

Every figure comes from the files of the cells and of the tunings, and every statistic from `logs/run_groups.py`: the
score of a run is its share of goals in an evaluation; its task is the arena.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from brakeline.deploy.experiments.compared_methods import NONE, SAC_LEARNER, ComparedMethod, compared
from brakeline.deploy.experiments.comparison_table import (
    cells_by_version,
    evaluation_name,
    markdown_table,
    steps_to_learn,
    version_note,
)
from brakeline.deploy.experiments.stored_cells import stored_cells, stored_tunings
from brakeline.deploy.experiments.tuning_trials import SETTINGS, best_learner, best_threshold, value_in_use
from brakeline.learner.learner_config import TD3Config
from brakeline.logs.proportion_intervals import clopper_pearson
from brakeline.logs.run_groups import aggregate, probability_of_improvement
from brakeline.messaging.robot import Array
from brakeline.messaging.task import RobotWithTask, robot_with_task
from brakeline.safety.model.model_config import DDPC, DIRECT, SAILR

Result = dict[str, Any]


class RobotResults:
    """The cells of one robot, as scores and counts.

    Attributes:
        cells: by method.
        arenas: of the evaluations; training used the first.
    """

    def __init__(self, robot: str, cells: Sequence[Result]) -> None:
        self.name, self.study = robot, cells[0]["study"]
        self.arenas: list[str] = self.study["arenas"]
        self.cells: dict[str, list[Result]] = {}
        for cell in cells:
            self.cells.setdefault(cell["study"]["method"], []).append(cell)

    def evaluations(self, method: str, arena: str) -> list[Result]:
        return [cell["evaluations"][evaluation_name(method, arena)] for cell in self.cells[method]]

    def goals(self, method: str, arenas: Sequence[str] | None = None) -> Array:
        """Return the share of goals (arenas, runs)."""
        shares = [
            [np.mean(evaluation["episodes"]["goal"]) for evaluation in self.evaluations(method, arena)]
            for arena in arenas or self.arenas
        ]
        return np.array(shares, float)

    def collisions(self, method: str, arena: str) -> tuple[int, int]:
        """Return the episodes with a collision, and all episodes, of all runs."""
        episodes = [evaluation["episodes"]["collision"] for evaluation in self.evaluations(method, arena)]
        return sum(map(sum, episodes)), sum(map(len, episodes))

    def interventions(self, method: str, arena: str) -> float:
        """Return the share of steps with an intervention."""
        columns = [evaluation["episodes"] for evaluation in self.evaluations(method, arena)]
        return sum(sum(c["interventions"]) for c in columns) / sum(sum(c["steps"]) for c in columns)

    def decision_ms(self, method: str, arena: str) -> float:
        """Return the mean time of a single decision [ms], policy included."""
        return float(np.mean([evaluation["decision_ms"]["mean"] for evaluation in self.evaluations(method, arena)]))

    def learned(self, method: str) -> Array:
        """Return the steps to 90 % of goals (runs,); the steps of the training for a run that never got there."""
        trainings = [cell["training"] for cell in self.cells[method]]
        return np.array([steps_to_learn(training["episodes"], training["steps"]) for training in trainings])

    def training_collisions(self, method: str) -> list[int]:
        return [sum(cell["training"]["episodes"]["collision"]) for cell in self.cells[method]]


def page(results: Path, robots: Sequence[str]) -> str:
    """Return the page about the robots that have stored cells."""
    stored = {name: cells for name in robots if (cells := stored_cells(results, name))}
    sections = [_section(results, RobotResults(name, cells)) for name, cells in stored.items()]
    configs = [cell["study"].get("model_config", {}) for cells in stored.values() for cell in cells if _ours(cell)]
    modes = sorted({config.get("mode", DIRECT) for config in configs}) or [DIRECT]
    threats = THREATS.format(modes=" and ".join(f"`{mode}`" for mode in modes))
    return "\n".join([HEAD, *sections, threats, COMMANDS])


def _ours(cell: Result) -> bool:
    return compared(cell["study"]["method"]).filter == DDPC


def _section(results: Path, robot_results: RobotResults) -> str:
    robot = robot_with_task(robot_results.study["robot"])
    parts = [
        f"## {robot_results.name}\n\n### Setup\n",
        _setup(robot, robot_results),
        "### Methods\n",
        _methods(robot_results),
        "### Main table\n",
        MAIN.format(episodes=robot_results.study["episodes"], steps=f"{robot_results.study['steps']:,}"),
        *_main(robot_results),
        "### Probability of improvement\n",
        IMPROVEMENT,
        *_improvements(robot_results),
        "### Performance profiles and learning curves\n",
        f"![performance profiles]({robot_results.name}/profiles.png)\n",
        f"![learning curves]({robot_results.name}/curves.png)\n",
        "### Tuning\n",
        *_tuning(results, robot, robot_results),
    ]
    return "\n".join(parts)


def _setup(robot: RobotWithTask, robot_results: RobotResults) -> str:
    study, task = robot_results.study, robot.task
    td3, first = study["td3"], robot_results.arenas[0]
    batch, rays = study.get("backend") == "batch", f"{len(task.rays.directions)} rays up to {task.rays.range:g} m"
    low_high = ", ".join(
        f"{name}: {low:g} to {high:g}"
        for name, low, high in zip(robot.action, robot.action_low, robot.action_high, strict=True)
    )
    errors = ", ".join(f"{name}: {most:g}" for name, most in zip(robot.state, robot.measurement_bound, strict=True))
    arenas = "; ".join(f"`{arena}`: {_arena(task.arenas[arena])}" for arena in robot_results.arenas)
    note = version_note(cells_by_version(cell for cells in robot_results.cells.values() for cell in cells))
    learners = [cells[0]["study"]["td3"] for cells in robot_results.cells.values()]
    differing = [name for name in LEARNER if any(other.get(name) != td3.get(name) for other in learners)]
    rewards = {name: value for name, value in asdict(task.reward).items() if name != "correction_penalty"}
    rows = [
        ("inputs", low_high),
        ("period, horizon", f"{robot.period:g} s, {robot.horizon} periods"),
        ("measured state, largest error", errors),
        ("observation", f"{rays}, {len(task.observation)} others"),
        ("arenas", arenas),
        ("reward", ", ".join(f"{name} {value:g}" for name, value in rewards.items())),
        ("simulator", f"MuJoCo, version {study.get('physics', 1)} of the robot's simulator"),
        (
            "training",
            f"{study['steps']:,} steps in `{first}`, "
            + (f"{study['robots']} robots at once" if batch else "one robot"),
        ),
        ("all learners", ", ".join(f"{name} {td3[name]}" for name in LEARNER if name in td3 and name not in differing)),
        *_own_settings(robot, robot_results, differing),
        *([("versions", note)] if note else []),
        ("evaluation", f"{study['episodes']} fresh episodes for each run and arena, the same for all methods"),
    ]
    return "\n".join([*markdown_table(["", ""], rows), ""])


def _own_settings(robot: RobotWithTask, robot_results: RobotResults, differing: Sequence[str]) -> list[tuple[str, str]]:
    """Return the settings in which the learners of the methods may differ, a row for each set of them.

    differing: names of settings that all learners have, and of which not all have the same value.
    """
    methods: dict[str, list[str]] = {}
    for name, cells in robot_results.cells.items():
        td3 = cells[0]["study"]["td3"]
        settings = [f"{setting} {td3[setting]}" for setting in differing if setting in td3]
        settings += _settings_of(compared(name), cells[0]["study"], robot.task.symmetry != "none")
        text = ", ".join(settings)
        methods.setdefault(text, []).append(compared(name).label)
    return [(f"learner of {'; '.join(labels)}", text) for text, labels in methods.items()]


def _settings_of(method: ComparedMethod, study: dict[str, Any], symmetric: bool) -> list[str]:
    """Return what the learner of a method has of its own; `symmetric`: the task has mirrored steps."""
    td3, sac = study["td3"], method.learner == SAC_LEARNER
    names = ("actor_rate",) if sac else RATES
    settings = [f"{'learning rate' if sac else name} {td3[name]}" for name in names if name in td3]
    if symmetric:
        settings.append("learns from mirrored steps" if td3.get("symmetric") else "no mirrored steps")
    settings += [f"{name} {td3[name]:g}" for name in method.td3 if name in td3 and name not in RATES]
    if method.filter == SAILR:
        settings.append("no penalty for corrections: an intervention ends the episode")
    elif method.filter != NONE:
        settings.append(f"penalty for corrections {study.get('penalty', 1.0):g}")
        changed = {name: td3.get(name, getattr(DEFAULTS, name)) for name in OF_CORRECTIONS}
        settings += [f"{name} {value:g}" for name, value in changed.items() if value != getattr(DEFAULTS, name)]
    return settings


DEFAULTS = TD3Config()
OF_CORRECTIONS = ("penalty_growth", "imitation")
RATES = ("actor_rate", "critic_rate")
LEARNER = ("hidden", "batch", "gamma", "n_step", "tau", "updates_per_step", "warmup")


def _arena(kind: Any) -> str:
    counts = f"{kind.cylinders[0]} to {kind.cylinders[1]} cylinders, {kind.boxes[0]} to {kind.boxes[1]} boxes"
    return f"{2.0 * kind.half_width:g} m wide, {counts}, gaps of {kind.gap:g} m and more"


def _methods(robot_results: RobotResults) -> str:
    heads = ["method", "n", "learner", "obstacles for the filter", "the filter's model", "recorded periods", "source"]
    rows = []
    for name, cells in robot_results.cells.items():
        method, model = compared(name), cells[0]["model"]
        samples = "0" if model is None else f"{int(model['samples']):,}"
        if model is not None and int(model["collisions"]):
            samples += f", with {int(model['collisions']):,} collisions"
        learner = method.learner + (" with a multiplier" if "cost_limit" in method.td3 else "")
        knows, versions = method.model, {cell["model"]["version"] for cell in cells if cell["model"]}
        if len(versions) > 1:
            knows += f"; made {len(versions)} times: {', '.join(sorted(versions))}"
        obstacles = (model or {}).get("obstacles", method.obstacles)
        rows.append([method.label, str(len(cells)), learner, obstacles, knows, samples, method.source])
    return "\n".join([*markdown_table(heads, rows), ""])


def _main(robot_results: RobotResults) -> list[str]:
    heads = ["method", "n", *(f"goals, `{arena}`" for arena in robot_results.arenas), "goals, all arenas"]
    rows = []
    for method, cells in robot_results.cells.items():
        scores = [_iqm(aggregate(robot_results.goals(method, [arena])[0])) for arena in robot_results.arenas]
        rows.append([compared(method).label, str(len(cells)), *scores, _iqm(aggregate(robot_results.goals(method)))])
    lines = [*markdown_table(heads, rows), ""]
    heads = ["method", *(f"collisions, `{arena}`" for arena in robot_results.arenas), "collisions in a training"]
    rows = []
    for method in robot_results.cells:
        counts = [_share(*robot_results.collisions(method, arena)) for arena in robot_results.arenas]
        trained = robot_results.training_collisions(method)
        rows.append([compared(method).label, *counts, f"{np.mean(trained):.1f} ({min(trained)} to {max(trained)})"])
    lines += [*markdown_table(heads, rows), ""]
    heads = ["method", "steps to 90 % of goals", "runs that got there"]
    heads += [f"interventions, `{arena}`" for arena in robot_results.arenas]
    heads += [f"decision [ms], `{arena}`" for arena in robot_results.arenas]
    rows = []
    for method, cells in robot_results.cells.items():
        learned = robot_results.learned(method)
        reached = int((learned < robot_results.study["steps"]).sum())
        shares = [_percent(robot_results.interventions(method, arena)) for arena in robot_results.arenas]
        times = [f"{robot_results.decision_ms(method, arena):.2f}" for arena in robot_results.arenas]
        figures = aggregate(learned)
        speed = f"{figures['iqm']:,.0f}" + (_interval(figures["iqm_interval"], ",.0f") if reached else "")
        rows.append([compared(method).label, speed, f"{reached} of {len(cells)}", *shares, *times])
    return [*lines, *markdown_table(heads, rows), ""]


def _percent(share: float) -> str:
    return f"{100.0 * share:.1f} %"


def _interval(ends: Sequence[float] | None, form: str, scale: float = 1.0) -> str:
    """Format an interval behind its figure. A single run has none."""
    return "" if ends is None else f" [{scale * ends[0]:{form}}, {scale * ends[1]:{form}}]"


def _iqm(figures: Result) -> str:
    """Format the interquartile mean of shares with its interval."""
    return _percent(figures["iqm"]) + _interval(figures["iqm_interval"], ".1f", 100.0)


def _share(count: int, episodes: int) -> str:
    low, high = clopper_pearson(count, episodes) or (0.0, 1.0)
    return f"{count} of {episodes:,}: {100.0 * count / episodes:.2f} % [{100.0 * low:.2f}, {100.0 * high:.2f}]"


def _improvements(robot_results: RobotResults) -> list[str]:
    if DDPC not in robot_results.cells:
        return []
    rows = []
    for method in robot_results.cells:
        if method != DDPC:
            row = probability_of_improvement(robot_results.goals(DDPC), robot_results.goals(method))
            probability = f"{row['probability']:.2f}" + _interval(row["interval"], ".2f")
            rows.append([f"ours over {compared(method).label}", probability])
    return [*markdown_table(["", "probability"], rows), ""]


def _tuning(results: Path, robot: RobotWithTask, robot_results: RobotResults) -> list[str]:
    """Return the table of all tried values; nothing is tried for our filter and TD3."""
    tried = stored_tunings(results / robot_results.name, robot_results.study.get("physics", 1))
    if not tried:
        return [f"No tuning is stored: `brakeline compare {robot_results.name} --tune` runs it.\n"]
    rows = []
    for method, values in tried.items():
        best = (best_learner if method in SETTINGS else best_threshold)(values)["value"]
        cells = robot_results.cells.get(method)
        used = value_in_use(cells[0], robot.footprint) if cells else None
        figures = [_tried(row) for row in values]
        chosen = f"{best:g}", "–" if used is None else f"{used:g}"
        rows.append([compared(method).label, compared(method).tuned, *figures, *chosen])
    most = max(map(len, tried.values()))
    heads = ["method", "setting", *(f"value {i + 1}" for i in range(most)), "best", "in use"]
    padded = [[*row[:-2], *[""] * (len(heads) - len(row)), *row[-2:]] for row in rows]
    return [TUNING, *markdown_table(heads, padded), ""]


def _tried(row: Result) -> str:
    if "oracle_goals" in row:
        return (
            f"**{row['value']:g}**: A* {row['oracle_goals']} goals; greedy {row['greedy_goals']}, "
            f"{row['greedy_collisions']} collisions"
        )
    return (
        f"**{row['value']:g}**: {row['goals']} goals, {row['collisions']} collisions; {row['training_collisions']} in "
        "training"
    )


HEAD = """# Experiments

`brakeline compare --table` writes this page from the files in this folder. Do not edit it. Each cell is one method,
trained from one seed. A second reader counted every cell's figures again from its logs (`brakeline analyse`) before
the cell was stored.
"""
MAIN = """\
After {steps} training steps; {episodes} fresh episodes for each run and arena. n: number of runs, each from a seed of
its own. Goals and steps to 90 %: interquartile mean, with the 95 % interval of the bootstrap, which resamples runs (the
same in each arena). The interquartile mean drops the lowest and the highest quarter of the values, rounded down: one
run at each end of five, two values at each end of the ten of five runs in two arenas. The tables in `docs/` and
`table.md` have means instead, and their bootstrap resamples the episodes, too.
Interventions: their share of all steps of all runs; `table.md` has the mean of the runs' shares.
Collisions: episodes of all runs, with the exact 95 % interval of Clopper and Pearson, which takes episodes as
independent, although all runs drive the same {episodes}. Steps to 90 %: the training steps until 45 of some 50
episodes, begun one after the other, had reached the goal; a run that never got there counts with all its steps.
Recorded periods (see *Methods*) do not count as training steps. Episodes that an intervention cut (SAILR) do not count.
Decision: mean time of a single decision of policy and filter, on a machine that other work shared in some
runs, but not in all. So do not compare the times of two methods.
"""
IMPROVEMENT = """\
The probability that a run of ours reaches more goals than a run of the other method, over all arenas; ties count half
(Agarwal et al. 2021). 0.5: no difference. [1.00, 1.00] means that each run of ours reached more goals than each run of
the other method. It does not mean that this is certain: if two methods were equal, five runs against five would part
like this in 1 of 126 comparisons.
"""
TUNING = """\
Every rival but TD3 tries four values of one setting (TD3-Lagrange six: the best of the first four was the smallest), in
episodes that evaluate nothing else. A filter trains nothing: it drives 120 episodes with A* and 120 with a greedy
policy. Of the values with which A* reaches the most goals, the best has the fewest collisions of the greedy policy,
then the most of its goals, then the fewest interventions on A*. A learner trains once, from a seed of its own, and
drives 120 episodes. Of the values that reach at most 6 goals (5 % of the episodes) fewer than the value with the most,
the best has the fewest collisions. Behind our filter, SAC is not tuned. The clearance margin of ours follows from its
model set. The penalty for corrections is 1, in the air 12 for the filters that know the map: it was chosen from 1, 4,
12, 40 and 100 by trainings of ours from seed 0, and its growth and the imitation from trainings of ours from seeds 0
and 1 (`docs/results_quadrotor.md`). The other settings of TD3 are the same for all methods, and were chosen on ours
(`deploy/experiments/experiments.md`).
"""
THREATS = """## Threats to validity

- **Simulation.** No physical robot drove. The simulators' version is in the setup: motion has noise from version 2 of
  the ground robot on.
- **Our own task.** The arenas, the reward and the observation are ours. So is the learner, except SAC, whose
  implementation is Stable-Baselines3's.
- **Own implementations of rivals.** They differ from their authors' versions as `docs/rivals.md` says.
- **Ours is not the article's version.** Ours has model sets of mode {modes} with the error bound `residual`. The
  article's recursion with matrix zonotopes gives sets that are too wide for these tasks (`conservatism.md` beside the
  tables).
- **Knowledge.** Filters that read the arena's map know more than those that read rays, and methods differ in recorded
  data and in models by hand: see *Methods*. The equations by hand describe these
  simulated robots well.
- **Recorded periods** come before the training, and no count of training steps contains them. With them, a method that
  learns from a recording may need more periods of driving than one without.
- **Tuning.** Each rival tuned one setting over four values (TD3-Lagrange six), in `default`. Penalty, its growth and
  imitation were chosen on trainings of ours whose seeds are in the table. More tuning may help every method, also ours.
  Where the best value is the first or the last that was tried, a better one may lie beyond it. Learners were tuned from
  one seed. Filters were tuned with A* and a greedy policy, not with a policy that learns behind them, which may need
  another value. In the air, SECAS learns with a penalty of 1, not 12. With 12, one training of it reached fewer goals
  (`docs/results_quadrotor.md`).
- **SAC.** If *SAC* and *SAC, our filter* have different learning rates (see *Setup*), their rows differ in more than
  the filter.
- **Robots at once.** There are 16, so that the first episodes, which begin together, do not hide how few steps a method
  needs.
- **Rooms.** The trainings that chose penalty, its growth, imitation and turning aside were evaluated in rooms of the
  tables (the first 200 or all 500 of an arena), and the rivals' values in other rooms. This favours ours. The campaigns
  (`docs/campaigns.md`) drive the stored policies in 10,000 rooms of each arena, which contain these 500.
- **Turning aside.** Our filter turns a blocked robot aside (`docs/method.md`, section 4). The rivals' filters do not;
  the same could be done with them.
- **Learners** make an update for each step. More updates may lead to 90 % of goals in fewer steps.
- **Episodes are not independent**: those of one run share a policy, and all runs share their rooms. The intervals of
  goals resample runs; those of collisions do not. If only the 500 rooms of an arena counted, 0 collisions would mean
  less than 0.74 % (95 %) instead of 0.15 %.
- **Few runs.** Over few runs, a bootstrap interval is too narrow. If the scores are normally distributed, the interval
  of five runs contains the true mean in about 83 % of the cases, and the interquartile mean in about 90 %, instead of
  95 %; for three runs, it is 74 %.
- **Cut episodes.** SAILR's interventions end an episode of its training: its steps to 90 % of goals are of the others,
  which look easier than they were.
- **Evaluation without exploration, training with it.** Collisions in training include those of random warm-up steps.
"""
COMMANDS = """## Commands

| to make | run |
|---|---|
| the tuning of a robot's rivals; it goes on where it ended | `brakeline compare ground --tune` |
| all cells of a robot, likewise | `brakeline compare ground` |
| some cells | `brakeline compare ground --methods ddpc none --seeds 0 1` |
| this page, the tables and the figures, from the stored cells | `brakeline compare ground quadrotor --table` |
| the check of one cell by its logs | `brakeline analyse runs/compare/ground/ddpc-s0/training.mcap` |
"""
