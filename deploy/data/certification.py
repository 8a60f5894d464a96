"""Certify a data set: fit a model set to 70 % of the trajectories and validate it on the other 30 %."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from brakeline.errors import BadData, ErrorBoundError, Unsupported
from brakeline.safety.model.dataset import Dataset
from brakeline.safety.model.fitting import fit_model_set
from brakeline.safety.model.model_set import ONE_STEP, ModelConfig, ModelSet
from brakeline.safety.model.one_step_fitting import Progress, fit_one_step, unheard
from brakeline.safety.model.one_step_update import update_one_step
from brakeline.safety.model.validation import (
    Array,
    ValidationReport,
    most_violations,
    validate_one_step,
    validate_plans,
)
from brakeline.safety.model.windows import FREE, PLAN

HELD_OUT = 0.3  # share of the trajectories that the validation uses
MAX_INFLATION = 1.25  # largest factor that `certify` widens sets by itself: the data do not support a larger one
MAX_ROUNDS = 4  # error bounds that mix data and envelopes do not widen in proportion, so that widening takes rounds
ROUNDING = 1e-6
AUTO = "auto"
PLAN_HINT = " (in a plan window the robot brakes as the filter does: a chosen input, then the description's stop rules)"


def certify(
    data: Dataset, model_config: ModelConfig, until_held: bool = False, progress: Progress = unheard
) -> tuple[ModelSet, ValidationReport]:
    """Fit a model set and validate it on driving that it was not fitted to.

    Mode one-step predicts every window without its fold (cross-conformal calibration, docs/method.md §13). The other
    modes leave out the restless trajectories, fit 70 % of the others and validate the result on the held-out ones.

    If the bound is above the robot's limit (`accept_bound`), widen the envelopes by the smallest factor that brings it
    within the limit (split conformal prediction, docs/method.md §12). The number of violations that the limit allows
    follows from the number of held-out plans alone. Therefore the stated Clopper-Pearson bound also holds for the
    widened sets. Nothing is widened if there are too few plans for the limit, or if the factor would be above
    `MAX_INFLATION`.

    >>> model, report = certify(Dataset.load(RECORDING), ModelConfig())
    >>> model.about["bound_plan"] == f"{report.bound_plan:g}"
    True

    Args:
        model_config: error bound, mode, windows and first inflation.
        until_held: widen the envelopes by any factor, until no held-out plan leaves its set.
        progress: called with the share of the work that is done; by mode one-step only.

    Returns:
        The model set, with the main figures of its validation in `about`, and the validation report.

    Raises:
        BadData, ErrorBoundError: the data do not support a model set; the message gives the reason.
    """
    if model_config.mode == ONE_STEP:
        model, calibration = fit_one_step(data, model_config, progress)
        report = validate_one_step(model, calibration)
        return _stated(model, report, data), report
    data = data.steady()
    fitted, held_out = data.split((1.0 - HELD_OUT, HELD_OUT))
    model = fit_model_set(fitted, model_config)
    report, scores = validate_plans(model, fitted, held_out)
    allowed = 0 if until_held else most_violations(len(scores), data.robot.accept_bound)
    if not until_held and _inflation(scores, allowed) > MAX_INFLATION:
        allowed = -1
    for _ in range(MAX_ROUNDS):
        factor = _inflation(scores, allowed)
        if factor <= 1.0 or not math.isfinite(factor):
            break
        model_config = replace(model_config, inflation=model_config.inflation * factor * (1.0 + ROUNDING))
        model = fit_model_set(fitted, model_config)
        report, scores = validate_plans(model, fitted, held_out)
    return _stated(model, report, data), report


def certify_update(in_use: ModelSet, data: Dataset, outside: float) -> tuple[ModelSet, ValidationReport]:
    """Update a model set of mode one-step to new driving, and validate it there (docs/method.md §15).

    Arguments and errors are those of `update_one_step`; the results those of `certify`.
    """
    model, calibration = update_one_step(in_use, data, outside)
    report = validate_one_step(model, calibration)
    return _stated(model, report, data), report


def _stated(model: ModelSet, report: ValidationReport, data: Dataset) -> ModelSet:
    """Return the model set with the main figures of its validation in `about`."""
    figures = {name: getattr(report, name) for name in ("bound_step", "bound_plan", "bound_episode", "outside_hour")}
    about = {name: f"{value:.6g}" for name, value in figures.items()}
    about |= {f"bound_plan {group.name}": f"{group.bound:.6g}" for group in report.groups}
    about |= {f"bound_step {group.name}": f"{group.bound_step:.6g}" for group in report.groups}
    about |= {"windows": str(report.windows), "violations": str(report.violations)}
    about |= {"minutes": f"{data.periods * data.robot.period / 60.0:.6g}", "inflation": f"{report.inflation:.6g}"}
    return replace(model, about=model.about | about)


def certify_supported(
    data: Dataset,
    model_config: ModelConfig,
    windows: str = AUTO,
    until_held: bool = False,
    progress: Progress = unheard,
) -> tuple[ModelSet, ValidationReport, dict[str, str]]:
    """Certify with plan windows if the data hold enough of them, else with free windows.

    Args:
        model_config: its kind of windows is replaced.
        windows: `plan` or `free` to try one kind only.
        until_held, progress: see `certify`.

    Returns:
        The model set, its validation report, and for each kind that failed the reason.

    Raises:
        Unsupported: no kind of windows supports a model set.
    """
    reasons: dict[str, str] = {}
    free_only = model_config.mode == ONE_STEP  # it needs no plans, and plans are driving like any other
    for kind in (FREE,) if free_only else (PLAN, FREE) if windows == AUTO else (windows,):
        try:
            model, report = certify(data, replace(model_config, windows=kind), until_held, progress)
        except (BadData, ErrorBoundError) as error:
            reasons[kind] = str(error) + (PLAN_HINT if kind == PLAN else "")
        else:
            return model, report, reasons
    raise Unsupported(reasons)


def _inflation(scores: Array, allowed: int) -> float:
    """Return the factor that leaves at most `allowed` of the scores (plans,) above 1; a negative `allowed` gives 1."""
    if not 0 <= allowed < len(scores):
        return 1.0
    return float(np.sort(scores)[-1 - allowed])
