"""Compare the filter with a control barrier function on two robots, with the same drivers in the same arenas.

    python -m benchmarks barrier-peers

The robots are the differential drive and the skid steer of examples/own_log: the second one has the same inputs, but is
late and slips. The filter has a model set from 4 or 15 minutes of the robot's log. The barrier has a unicycle that
somebody derived by hand, and the settings of `TUNINGS` with the fewest collisions, then the most goals, then the
nearest approach, in episodes of other seeds: those that are best on this robot, and those that are best on the other.
"""

from __future__ import annotations

from dataclasses import asdict
from itertools import product

from benchmarks.model_peers import MINUTES, OWN_LOG, SEED, Rows, driven, own_log
from benchmarks.timing import Words
from brakeline.deploy.data.certification import certify_supported
from brakeline.deploy.data.rival_pretraining import BarrierConfig
from brakeline.messaging.robot import robot_named
from brakeline.safety.filter.filter import Filter
from brakeline.safety.methods import Method
from brakeline.safety.model.model_config import CBF, ONE_STEP, ModelConfig
from brakeline.safety.rivals.pretrained import Pretrained
from brakeline.safety.rivals.unicycle_barrier import UnicycleBarrier

ROBOTS = ("diff", "skid")
EPISODES = 200  # of the adversary; the planner drives half as many
TUNING_EPISODES = 20
TUNINGS = [BarrierConfig(*values) for values in product((0.02, 0.05), (0.5, 1.0, 2.0, 4.0), (0.0, 0.03, 0.06, 0.1))]


def run() -> Words:
    """Return a row for each robot and method."""
    figures = Rows()
    tunings = {name: tuned(name) for name in ROBOTS}
    for name in ROBOTS:
        for minutes in MINUTES:
            model, _, _ = certify_supported(driven(minutes, SEED, name=name), ModelConfig(mode=ONE_STEP).of_minutes())
            figures[f"{name}: filter, {minutes:g} min"] = decisions(name, Filter(model), EPISODES, SEED)
        for other, tuning in tunings.items():
            row = f"{name}: CBF-QP, tuned on {other} ({tuning.ahead:g} m, {tuning.rate:g}/s, {tuning.margin:g} m)"
            figures[row] = decisions(name, barrier(name, tuning), EPISODES, SEED)
    return figures


def tuned(name: str) -> BarrierConfig:
    """Return the best settings of the barrier on a robot, in episodes of other seeds."""
    errors_of = {}
    for tuning in TUNINGS:
        had = decisions(name, barrier(name, tuning), TUNING_EPISODES, SEED + 5000)
        errors_of[tuning] = had["collisions"], -int(str(had["goals"]).split()[0]), float(had["nearest cm"])
    return min(errors_of, key=errors_of.__getitem__)


def barrier(name: str, tuning: BarrierConfig) -> UnicycleBarrier:
    """Return the barrier of a robot of examples/own_log, which has no task."""
    robot = robot_named(str(OWN_LOG / f"{name}.toml"))
    return UnicycleBarrier(Pretrained(robot, CBF, {}, asdict(tuning)))


def decisions(name: str, method: Method, episodes: int, seed: int) -> dict[str, float | str]:
    """Return how the adversary and the planner of a robot fare behind a method, in the arenas of examples/own_log."""
    table = own_log()
    vehicle = table.VEHICLES[name]
    adversary = table.episodes(vehicle, method, episodes, "adversary", 10_000 + seed)
    planner = table.episodes(vehicle, method, episodes // 2, "planner", 20_000 + seed)
    return {
        "collisions": float(adversary["collisions"] + planner["collisions"]),
        "nearest cm": 1e2 * adversary["nearest"],
        "goals": f"{planner['goals']} of {planner['episodes']}",
        "decide p50 ms": adversary["time_ms_p50"],
    }
