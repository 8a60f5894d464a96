"""A model set from a data set, with its statement about what it was not made from."""

from __future__ import annotations

from dataclasses import replace

from safety.dataset import Dataset
from safety.fitting import make
from safety.model_set import ModelSet, Recipe
from safety.statement import Statement, state

HELD_OUT = 0.3  # of the trajectories, for the statement about a model set


def certified(data: Dataset, recipe: Recipe) -> tuple[ModelSet, Statement]:
    """A model set from 70 % of the trajectories, with its statement about the others.

    Raises:
        BadData, CertificateError: the data do not support it; the message says why.
    """
    fitted, held_out = data.split((1.0 - HELD_OUT, HELD_OUT))
    model = make(fitted, recipe)
    statement = state(model, fitted, held_out)
    about = model.about | {"bound_step": f"{statement.bound_step:.6g}", "bound_plan": f"{statement.bound_plan:.6g}"}
    about |= {"windows": str(statement.windows), "violations": str(statement.violations)}
    return replace(model, about=about), statement
