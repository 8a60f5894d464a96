"""THE table of the methods that a safety service can serve: the filter and its rivals, behind one interface.

A robot without a filter (method `none`) uses no service. The filter and the rivals are imported when a model is made
ready: with them come compiled kernels and a solver, which take a second to load. Who only reads a model needs neither.
"""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Protocol

from brakeline.errors import BadModel
from brakeline.messaging.robot import Robot
from brakeline.safety.filter.request import Decision, Request
from brakeline.safety.model.model_config import CBF, DDPC, PSF, SAILR, SECAS
from brakeline.safety.model.model_set import ModelSet
from brakeline.safety.model.tensor_file import has_entry
from brakeline.safety.rivals.own_code import OwnCode
from brakeline.safety.rivals.pretrained import ENTRY, Pretrained

Model = ModelSet | Pretrained

IN_USE = "in_use"  # in the archive of a robot: the version that a service put to use last


class Method(Protocol):
    """Turns a request into a decision. It is a pure function of the request and the model."""

    @property
    def robot(self) -> Robot: ...

    @property
    def version(self) -> str:
        """The hash of the model."""

    @property
    def observed(self) -> int:
        """The size of the observation that the method reads; 0: it reads none."""

    def decide(self, request: Request) -> Decision:
        """Return the decision. Raises BadRequest if a value of the request is not valid."""


# The module and the class of each rival, and of CBF the class by the robot's equations.
UNICYCLE, VELOCITIES = ("unicycle_barrier", "UnicycleBarrier"), ("velocity_barrier", "VelocityBarrier")
RIVALS = {
    SECAS: ("secas", "Secas"),
    SAILR: ("sailr", "Sailr"),
    CBF: UNICYCLE,
    PSF: ("predictive_filter", "PredictiveFilter"),
}
METHODS = (DDPC, *RIVALS)


def ready(model: Model) -> Method:
    """Return the method of a model, ready for decisions.

    Raises:
        BadModel: no method has this name, or the model does not fit its robot.
    """
    if isinstance(model, ModelSet):
        from brakeline.safety.filter.filter import Filter

        return Filter(model)
    if isinstance(model, OwnCode):
        return model.ready()
    if model.method not in RIVALS:
        raise BadModel(f"no method is called {model.method!r}; there are: {', '.join(METHODS)}")
    velocities = model.method == CBF and barrier_of_velocities(model.robot)
    module, name = VELOCITIES if velocities else RIVALS[model.method]
    method: Method = getattr(import_module(f"brakeline.safety.rivals.{module}"), name)(model)
    return method


def barrier_of_velocities(robot: Robot) -> bool:
    """Return whether CBF takes a robot as a vehicle that follows velocities. If not, it takes it as a unicycle."""
    return robot.heading is None


def decode(payload: bytes) -> Model:
    """Return the model set or the rival's model in the bytes of a file. Raises BadModel if there is none."""
    return Pretrained.decode(payload) if has_entry(payload, ENTRY) else ModelSet.decode(payload)


def load(path: Path) -> Model:
    """Return the model in a file. Raises BadModel, with the file's name, if there is none."""
    try:
        return decode(path.read_bytes())
    except (OSError, BadModel) as error:
        raise BadModel(f"{path}: {error}") from error


def archive_path(archive: Path, robot: str, version: str) -> Path:
    """Return the path of a version of a robot's model in an archive of models."""
    return archive / robot / "models" / f"{version}.safetensors"
