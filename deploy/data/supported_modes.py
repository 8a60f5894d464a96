"""Which model sets a data set supports: from plans where there are enough of them, else from free driving."""

from __future__ import annotations

from dataclasses import replace

from brakeline.deploy.data.certification import certify
from brakeline.safety.model.dataset import BadData, Dataset
from brakeline.safety.model.error_bounds import ErrorBoundError
from brakeline.safety.model.model_set import ModelConfig, ModelSet
from brakeline.safety.model.validation import ValidationReport
from brakeline.safety.model.windows import FREE, PLAN

AUTO = "auto"
NO_PLANS = " (of driving like the filter's plans: a chosen input, then the stop rules of the description)"


class Unsupported(BadData):
    """No kind of windows serves; the message has each with its reason, `reasons` too."""

    def __init__(self, reasons: dict[str, str]) -> None:
        super().__init__("; ".join(f"{kind} windows: {reason}" for kind, reason in reasons.items()))
        self.reasons = reasons


def certify_supported(
    data: Dataset, model_config: ModelConfig, windows: str = AUTO, until_held: bool = False
) -> tuple[ModelSet, ValidationReport, dict[str, str]]:
    """The model set of the first kind of windows that serves, its statement, and why the kinds before it did not.
    until_held: see `certify`.

    Raises:
        Unsupported: none does.
    """
    reasons: dict[str, str] = {}
    for kind in (PLAN, FREE) if windows == AUTO else (windows,):
        try:
            model, statement = certify(data, replace(model_config, windows=kind), until_held)
        except (BadData, ErrorBoundError) as error:
            reasons[kind] = str(error) + (NO_PLANS if kind == PLAN else "")
        else:
            return model, statement, reasons
    raise Unsupported(reasons)
