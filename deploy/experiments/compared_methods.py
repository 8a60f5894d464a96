"""THE table of the methods that the comparison trains: a learner, and the filter in front of the robot.

A filter of your own (`FILE.py:CLASS`) is a method too; its learner is TD3.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

from brakeline.messaging.task_code import is_own_code
from brakeline.safety.model.model_config import CBF, DDPC, PSF, SAILR, SECAS

NONE = "none"
EVERY, BATCHES = "every", "batches"
BY_HAND = "equations by hand: a unicycle, in the air a lag"
MAP, RAYS, NOTHING = "the arena's map", "the observed rays", "–"
TD3_LEARNER, SAC_LEARNER = "TD3", "SAC"
# Settings of TD3 that SAC has too; its one learning rate is the actor's.
SAC_SETTINGS = {
    *("hidden", "actor_rate", "batch", "gamma", "n_step", "tau", "reward_scale", "updates_per_step", "symmetric"),
    "warmup",
}


@dataclass(frozen=True)
class ComparedMethod:
    """A method of the comparison.

    Attributes:
        label: in tables.
        filter: the method that decides in training and evaluation; `none`: each proposal is executed.
        obstacles: how the filter gets obstacles.
        model: what the filter knows of the robot.
        source: where the method is from.
        learner: TD3 is our own; SAC is Stable-Baselines3's.
        td3: settings of the learner that differ from the others'.
        tuned_on: robots, and settings that replace those of `td3` there, because a tuning on that robot found them.
        tuned: the setting that was tuned; empty: none.
        robots: on which it is compared. EVERY: all. BATCHES: those that batches simulate.
    """

    label: str
    filter: str
    obstacles: str
    model: str
    source: str
    learner: str = TD3_LEARNER
    td3: Mapping[str, Any] = field(default_factory=dict)
    tuned_on: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    tuned: str = ""
    robots: str = EVERY

    def learner_settings(self, robot: str) -> dict[str, Any]:
        """Return the settings of the learner on a robot that differ from the other methods'."""
        return {**self.td3, **self.tuned_on.get(robot, {})}


METHODS: dict[str, ComparedMethod] = {
    DDPC: ComparedMethod("ours", DDPC, MAP, "sets from recorded driving", "Selim et al. 2022; docs/method.md"),
    SAILR: ComparedMethod(
        *("SAILR", SAILR, RAYS, "critics of braking, from recorded driving", "Wagener et al. 2021"),
        tuned="threshold η",
    ),
    SECAS: ComparedMethod(
        *("SECAS", SECAS, RAYS, "linear constraints, from recorded driving", "Dalal et al. 2018"),
        tuned="margin [m]",
    ),
    NONE: ComparedMethod("TD3", NONE, NOTHING, NOTHING, "Fujimoto et al. 2018"),
    "lagrange": ComparedMethod(
        *("TD3-Lagrange", NONE, NOTHING, NOTHING, "Ray et al. 2019; Tessler et al. 2019"),
        td3={"cost_limit": 0.01, "multiplier_rate": 1.0},
        tuned_on={"quadrotor": {"multiplier_rate": 0.1}},
        tuned="multiplier_rate",
        robots=BATCHES,
    ),
    CBF: ComparedMethod(
        *("CBF-QP", CBF, MAP, BY_HAND, "Ames et al. 2019; Wang et al. 2017"),
        tuned="rate α [1/s]",
        robots=BATCHES,
    ),
    PSF: ComparedMethod(
        *("PSF", PSF, MAP, BY_HAND, "Wabersich and Zeilinger 2021"),
        tuned="margin [m]",
        robots=BATCHES,
    ),
    "sac": ComparedMethod(
        *("SAC", NONE, NOTHING, NOTHING, "Haarnoja et al. 2018; Stable-Baselines3"),
        learner=SAC_LEARNER,
        td3={"actor_rate": 3e-4},
        tuned="learning rate",
        robots=BATCHES,
    ),
    "sac-ddpc": ComparedMethod(
        *("SAC, our filter", DDPC, MAP, "sets from recorded driving", "Haarnoja et al. 2018; Stable-Baselines3"),
        learner=SAC_LEARNER,
        td3={"actor_rate": 3e-4},  # of the tuning of SAC without the filter
        tuned="learning rate",
        robots=BATCHES,
    ),
}


def compared(name: str) -> ComparedMethod:
    """Return the method of this name. Raises ValueError: there is none."""
    if is_own_code(name):
        return ComparedMethod(short_name(name), name, MAP, "code of its own", NOTHING)
    if name not in METHODS:
        raise ValueError(f"no method is called {name!r}; there are: {', '.join(METHODS)}, or FILE.py:CLASS")
    return METHODS[name]


def short_name(method: str) -> str:
    """Return a method's name in the names of files: of code of your own, the class."""
    return method.rpartition(":")[2]


def in_order(methods: Iterable[str]) -> list[str]:
    """Return each of these methods once: in the order of the table, then those of your own."""
    return sorted(set(methods), key=lambda name: ([*METHODS, name].index(name), name))
