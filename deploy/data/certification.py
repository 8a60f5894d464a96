"""A model set from a data set, with its statement about what it was not made from."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from brakeline.safety.model.dataset import Dataset
from brakeline.safety.model.fitting import fit_model_set
from brakeline.safety.model.model_set import ModelConfig, ModelSet
from brakeline.safety.model.validation import Array, ValidationReport, most_violations, validate_plans

HELD_OUT = 0.3  # of the trajectories, for the statement about a model set
WIDEST = 1.25  # times: sets that have to be wider for the limit are not what the data support, and are left as they are
TRIES = 4  # bounds that mix data and envelopes do not widen in proportion
ROUNDING = 1e-6


def certify(data: Dataset, model_config: ModelConfig, until_held: bool = False) -> tuple[ModelSet, ValidationReport]:
    """A model set from 70 % of the trajectories, with its statement about the others.

    The envelopes are widened where that brings the statement within the robot's limit (`accept_bound`): by the factor
    that leaves as many held-out plans outside as the limit allows among so many (split conformal prediction,
    docs/method.md §12). How many those are follows from the number of plans alone, so the bound that is stated holds
    for the widened sets: what comes is beyond the score that v of n are above with a probability that has the
    Clopper-Pearson bound of v violations in n plans.
    Where there are too few plans for the limit, or a larger factor than `WIDEST` would be needed, nothing is widened.

    until_held: they are widened until no held-out plan leaves its set, by whatever factor.

    Raises:
        BadData, CertificateError: the data do not support it; the message says why.
    """
    fitted, held_out = data.split((1.0 - HELD_OUT, HELD_OUT))
    model = fit_model_set(fitted, model_config)
    statement, scores = validate_plans(model, fitted, held_out)
    most = 0 if until_held else most_violations(len(scores), data.robot.accept_bound)
    if not until_held and _widening(scores, most) > WIDEST:
        most = -1
    for _ in range(TRIES):
        factor = _widening(scores, most)
        if factor <= 1.0 or not math.isfinite(factor):
            break
        model_config = replace(model_config, inflation=model_config.inflation * factor * (1.0 + ROUNDING))
        model = fit_model_set(fitted, model_config)
        statement, scores = validate_plans(model, fitted, held_out)
    about = model.about | {"bound_step": f"{statement.bound_step:.6g}", "bound_plan": f"{statement.bound_plan:.6g}"}
    about |= {"bound_episode": f"{statement.bound_episode:.6g}", "outside_hour": f"{statement.outside_hour:.6g}"}
    about |= {"windows": str(statement.windows), "violations": str(statement.violations)}
    about |= {"minutes": f"{data.periods * data.robot.period / 60.0:.6g}", "inflation": f"{model_config.inflation:.6g}"}
    return replace(model, about=about), statement


def _widening(scores: Array, most: int) -> float:
    """The factor by which sets have to be wider for no more than `most` of the scores (plans,) to be above 1."""
    if not 0 <= most < len(scores):
        return 1.0
    return float(np.sort(scores)[-1 - most])
