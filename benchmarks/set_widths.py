"""What a smaller stated share costs: half-widths, bounds and corrections against the share outside and the data.

    python -m benchmarks widths

Model sets are fitted to parts of the shipped recordings, in whole trajectories, the same ones for every form. The
trained policy then drives behind each of them, in fresh episodes of the arena `dense`. The plot is
`docs/figures/widths.svg`.
"""

from __future__ import annotations

from itertools import product
from pathlib import Path

from benchmarks.growth import part_of
from benchmarks.timing import Figures
from brakeline.deploy.data.certification import certify_supported
from brakeline.deploy.data.simulated_recording import data_for
from brakeline.deploy.experiments.batch_evaluation import batch_method, drive_episodes
from brakeline.deploy.experiments.evaluate import FRESH
from brakeline.deploy.policy_loading import network_named
from brakeline.deploy.progress import console, under_way
from brakeline.errors import BrakelineError
from brakeline.logs.episode_stats import EpisodeStats, closed_loop
from brakeline.messaging.task import RobotWithTask, robot_with_task
from brakeline.safety.model.dataset import Dataset
from brakeline.safety.model.model_config import KINDS, ONE_STEP, ModelConfig
from brakeline.safety.model.model_set import ModelSet

PLOT = Path(__file__).parents[1] / "docs" / "figures" / "widths.svg"
ROBOTS = ("ground",)  # the quadrotor's bounds by set membership take minutes for each row
MINUTES = (4.0, 15.0, 60.0, 240.0)
SHARES = (1e-2, 3e-3, 1e-3, 1e-4)
FEW = 60.0  # min: with fewer data, the linear modes need `--few`
EPISODES = 100


def run() -> Figures:
    """Return a row for each robot, form of model set, share outside and minutes of data."""
    figures: Figures = {}
    for name, minutes in product(ROBOTS, MINUTES):
        robot = robot_with_task(name)
        part = part_of(data_for(robot), minutes)
        forms = {f"one-step, {share:g} outside": ModelConfig(mode=ONE_STEP, outside=share) for share in SHARES}
        forms |= {f"{kind}, direct": ModelConfig(kind, "direct") for kind in KINDS}
        for form, config in forms.items():
            title = f"{name}, {minutes:g} min, {form}"
            with under_way(title):
                figures[title] = _row(robot, part, config if minutes > FEW else config.of_minutes())
            console.print(title, {key: float(f"{value:.4g}") for key, value in figures[title].items()})
    _draw(figures)
    return figures


def _row(robot: RobotWithTask, data: Dataset, config: ModelConfig) -> dict[str, float]:
    """Fit, and drive behind the model set. A form that the data do not support has only its minutes."""
    row = {"minutes": data.periods * robot.period / 60.0}
    try:
        model, report, _ = certify_supported(data, config)
    except BrakelineError:
        return row
    row |= {
        "stated, of plans": report.bound_plan,
        "steps outside an hour": report.outside_hour,
        "mm at rest": 1e3 * report.half_width_rest,
        "mm at full speed": 1e3 * report.half_width_full,
    }
    return row | _driven(robot, model)


def _driven(robot: RobotWithTask, model: ModelSet) -> dict[str, float]:
    """Drive the trained policy behind the model set, many robots at once."""
    tables: dict[str, EpisodeStats] = {}
    policy = network_named("trained", robot, 0)
    drive_episodes(
        *(robot, batch_method(model), policy, "dense", FRESH, range(EPISODES)),
        lambda step: tables.setdefault(step.actor, EpisodeStats()).step(step),
        accept_bound=1.0,
    )
    driven = closed_loop(list(tables.values()))
    return {
        "goals": driven["goals"] / driven["episodes"],
        "collisions": driven["collisions"],
        "interventions": driven["interventions"] / driven["steps"],
        "steps outside": driven["containment"]["violations"] / max(driven["containment"]["steps"], 1),
    }


def _draw(figures: Figures) -> None:
    from matplotlib import pyplot

    panels = {"mm at full speed": "half-width of a full stop\nfrom full speed [mm]", "interventions": "interventions"}
    picture, grid = pyplot.subplots(
        len(panels), len(ROBOTS), figsize=(6.0 * len(ROBOTS), 6.0), layout="constrained", squeeze=False
    )
    for column, name in enumerate(ROBOTS):
        forms = dict.fromkeys(title.split(" min, ")[1] for title in figures if title.startswith(name))
        for row, (key, label) in enumerate(panels.items()):
            axes = grid[row][column]
            for form in forms:
                rows = [figures[f"{name}, {minutes:g} min, {form}"] for minutes in MINUTES]
                points = [(one["minutes"], one[key]) for one in rows if key in one]
                if points:
                    axes.plot(*zip(*points, strict=True), "o-" if form.startswith("one") else "s--", label=form)
            axes.set_xscale("log")
            axes.set_xticks(MINUTES, [f"{minutes:g}" for minutes in MINUTES])
            axes.minorticks_off()
            axes.set_ylim(bottom=0.0)
            axes.set_xlabel("minutes of recorded driving")
            axes.set_ylabel(label)
            axes.grid(alpha=0.3)
            if row == 0:
                axes.set_title(name)
    grid[0][0].legend(fontsize=7, frameon=False)
    pyplot.rcParams["svg.hashsalt"] = PLOT.name  # the same figures give the same file
    picture.savefig(PLOT, metadata={"Date": None})
