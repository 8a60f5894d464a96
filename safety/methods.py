"""THE table of the methods that a safety service can serve: what turns a request into a decision, behind one interface.

`none` is not among them: a robot without a filter asks nobody.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from brakeline.messaging.robot import Robot
from brakeline.safety.filter.filter import Filter
from brakeline.safety.filter.request import Decision, Request
from brakeline.safety.model.model_config import DDPC as DDPC
from brakeline.safety.model.model_set import BadModel, ModelSet
from brakeline.safety.model.tensor_file import has_entry
from brakeline.safety.rivals.pretrained import ENTRY, Pretrained
from brakeline.safety.rivals.sailr import SAILR, Sailr
from brakeline.safety.rivals.secas import SECAS, Secas

Model = ModelSet | Pretrained


class Method(Protocol):
    """A pure function of the request and the model: it keeps nothing about a robot."""

    @property
    def robot(self) -> Robot: ...

    @property
    def version(self) -> str:
        """Of the model: its hash."""

    @property
    def observed(self) -> int:
        """The number of values in the observation that it reads; 0: it reads none."""

    def decide(self, request: Request) -> Decision:
        """Raises BadRequest."""


RIVALS: dict[str, Callable[[Pretrained], Method]] = {SECAS: Secas, SAILR: Sailr}
METHODS = (DDPC, *RIVALS)


def ready(model: Model) -> Method:
    """A model made ready for decisions.

    Raises:
        BadModel: it is of no method here, or does not fit its robot.
    """
    if isinstance(model, ModelSet):
        return Filter(model)
    if model.method not in RIVALS:
        raise BadModel(f"no method is called {model.method!r}; there are: {', '.join(METHODS)}")
    return RIVALS[model.method](model)


def decode(payload: bytes) -> Model:
    """The model in a file, of whichever kind.

    Raises:
        BadModel: of none; the message says why.
    """
    return Pretrained.decode(payload) if has_entry(payload, ENTRY) else ModelSet.decode(payload)


def load(path: Path) -> Model:
    """Raises BadModel, naming the file."""
    try:
        return decode(path.read_bytes())
    except (OSError, BadModel) as error:
        raise BadModel(f"{path}: {error}") from error
