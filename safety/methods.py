"""THE table of the methods that a safety service can serve: what turns a request into a decision, behind one interface.

`none` is not among them: a robot without a filter asks nobody.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from messaging.robots import Robot
from safety.filter import Filter
from safety.model_set import BadModel, ModelSet
from safety.recipe import DDPC as DDPC
from safety.request import Decision, Request
from safety.rivals.pretrained import ENTRY, Pretrained
from safety.rivals.sailr import SAILR, Sailr
from safety.rivals.secas import SECAS, Secas
from safety.tensors import holds

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
    return Pretrained.decode(payload) if holds(payload, ENTRY) else ModelSet.decode(payload)


def load(path: Path) -> Model:
    """Raises BadModel, naming the file."""
    try:
        return decode(path.read_bytes())
    except (OSError, BadModel) as error:
        raise BadModel(f"{path}: {error}") from error
