"""A model set from a data set, with its statement about what it was not made from."""

from __future__ import annotations

import math
from dataclasses import replace

from safety.dataset import Dataset
from safety.fitting import make
from safety.model_set import ModelSet, Recipe
from safety.statement import Statement, state

HELD_OUT = 0.3  # of the trajectories, for the statement about a model set
TRIES = 4  # bounds that mix data and envelopes do not widen in proportion
ROUNDING = 1e-6


def certified(data: Dataset, recipe: Recipe, until_held: bool = False) -> tuple[ModelSet, Statement]:
    """A model set from 70 % of the trajectories, with its statement about the others.

    until_held: every envelope is widened by the largest factor that a held-out plan asks for, until none leaves its set
    (split conformal prediction, docs/method.md §12). That what comes is beyond the largest of n factors has a
    probability of at most `1 - 0.01^(1/n)` at 99 % confidence: the statement's bound for n plans without a violation.

    Raises:
        BadData, CertificateError: the data do not support it; the message says why.
    """
    fitted, held_out = data.split((1.0 - HELD_OUT, HELD_OUT))
    model = make(fitted, recipe)
    statement = state(model, fitted, held_out)
    for _ in range(TRIES if until_held else 0):
        if statement.excess <= 1.0 or not math.isfinite(statement.excess):
            break
        recipe = replace(recipe, inflation=recipe.inflation * statement.excess * (1.0 + ROUNDING))
        model = make(fitted, recipe)
        statement = state(model, fitted, held_out)
    about = model.about | {"bound_step": f"{statement.bound_step:.6g}", "bound_plan": f"{statement.bound_plan:.6g}"}
    about |= {"bound_episode": f"{statement.bound_episode:.6g}", "outside_hour": f"{statement.outside_hour:.6g}"}
    about |= {"windows": str(statement.windows), "violations": str(statement.violations)}
    return replace(model, about=about), statement
