"""What held-out windows say about a model set: how often a tube would not have held, with 99 % confidence (method §1).

A statement about the distribution that was recorded, and about no other.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaincinv

from safety.dataset import Dataset
from safety.filter import Filter
from safety.model_set import DIRECT, ModelSet, needed
from safety.tube import Tube
from safety.windows import PLAN, Quality, Windows, apart, outputs, quality, windows
from safety.zonotope import facet_normals

Array = NDArray[np.float64]

CONFIDENCE = 0.99
CHUNK = 256  # windows at once: an exact matrix zonotope has thousands of atoms


@dataclass(frozen=True)
class Statement:
    """Of one model set. The unit is a plan window that overlaps no other and whose stop was recorded for a period at
    least; a violation is any part of it outside."""

    certificate: str
    mode: str
    version: str
    samples: int  # plan windows that the predictors were fitted and bounded on
    rank: int
    smallest_singular: float
    condition: float
    windows: int  # held out
    violations: int  # windows of which some step, bulge or the stop latch was outside
    step_violations: int  # windows of which the first step was outside, in any coordinate
    bound_step: float  # probability that a step's measured state is outside, at 99 % confidence
    bound_plan: float  # the same of any part of a plan
    bound_episode: float  # of any step in an episode of 300, from bound_step
    half_width_rest: float  # m, of a full stop, largest axis, position noise of the estimate not included
    half_width_full: float
    comfort: float  # m, kept to obstacles while driving so that turning in place stays possible

    def figures(self) -> dict[str, Any]:
        return asdict(self)


def upper_bound(violations: int, count: int) -> float:
    """Clopper-Pearson: the largest probability with which so few violations are not surprising at 99 % confidence."""
    if count == 0 or violations >= count:
        return 1.0
    return float(betaincinv(violations + 1, count - violations, CONFIDENCE))


def state(model: ModelSet, fitted: Dataset, held_out: Dataset) -> Statement:
    """The statement of a model set made from `fitted` about trajectories that it has not seen."""
    robot, ready, kind = model.robot, Filter(model), model.recipe.windows
    tube = model.tube_of_windows()
    used = windows(fitted, robot.horizon, kind)
    figures: Quality = quality(used.z, "plan windows", model.recipe.fewest)
    whole = windows(held_out, robot.horizon, kind)
    plans = apart(whole.take(~np.isnan(whole.latch)) if kind == PLAN else whole, robot.horizon)
    ends = {tuple(start): row for row, start in enumerate(plans.start)}
    outside = np.zeros(len(plans), dtype=bool)
    first = np.zeros(len(plans), dtype=bool)
    for k in range(1, robot.horizon + 1):
        seen = windows(held_out, k, kind)
        rows = [i for i, start in enumerate(seen.start) if tuple(start) in ends]
        part = seen.take(np.isin(np.arange(len(seen)), rows))
        if k == 1:
            first = _first_outside(model, part)
            outside |= first
        outside |= _outside(model, tube, part, k)
    full = np.asarray(robot.high())
    bound_step = upper_bound(int(first.sum()), len(plans))
    return Statement(
        certificate=model.recipe.certificate,
        mode=model.recipe.mode,
        version=model.version,
        samples=figures.samples,
        rank=figures.rank,
        smallest_singular=figures.smallest,
        condition=figures.condition,
        windows=len(plans),
        violations=int(outside.sum()),
        step_violations=int(first.sum()),
        bound_step=bound_step,
        bound_plan=upper_bound(int(outside.sum()), len(plans)),
        bound_episode=1.0 - (1.0 - bound_step) ** 300,
        half_width_rest=ready.half_width(np.zeros(robot.action_dim)),
        half_width_full=ready.half_width(full),
        comfort=ready.comfort,
    )


def _first_outside(model: ModelSet, w: Windows) -> NDArray[np.bool_]:
    """Is any coordinate of the state after one period outside its predicted set? (T,)"""
    z = w.z if model.recipe.mode == DIRECT else model.first_regressor(w.z)
    half = np.concatenate([model.first.half_widths(z[i : i + CHUNK]) for i in range(0, len(z), CHUNK)])
    return np.asarray((np.abs(outputs_of(model, w) - z @ model.first.C.T) > half).any(1))


def outputs_of(model: ModelSet, w: Windows) -> Array:
    """What the model set's certificates predict of these windows."""
    return outputs(model.robot, w.y) if model.recipe.mode == DIRECT else w.y


def _outside(model: ModelSet, tube: Tube, w: Windows, k: int) -> NDArray[np.bool_]:
    """Is the position after k periods outside the tube (or what else it speaks of), or the path off it between, or the
    stop not one? (T,)"""
    d, more = model.robot.position_dim, list(needed(model.robot))
    normals = facet_normals(tube.directions[k - 1][:, np.abs(tube.directions[k - 1]).any(0)])
    spread = np.abs(normals @ tube.directions[k - 1])  # (facets, L)
    others = outputs_of(model, w)[:, more]
    bad = np.zeros(len(w), dtype=bool)
    for i in range(0, len(w), CHUNK):
        z = w.z[i : i + CHUNK]
        sizes = tube.magnitudes(z)
        made = sizes[:, : tube.generators]
        away = np.abs((w.y[i : i + CHUNK, :d] - z @ tube.position[k - 1].T) @ normals.T)
        outside = (away > made @ spread.T).any(1)
        off = np.abs(others[i : i + CHUNK] - z @ tube.more[k - 1].T)
        outside |= (off > made @ np.abs(tube.more_directions[k - 1]).T).any(1)
        outside |= w.bulge[i : i + CHUNK] > sizes[:, tube.generators + k - 1]
        if k == tube.horizon:
            outside |= w.latch[i : i + CHUNK] > sizes[:, -1]
        bad[i : i + CHUNK] = outside
    return bad
