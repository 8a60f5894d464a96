"""One recording of the kinematic robot, and the model sets made from it."""

import pytest

from safety.certificates import KINDS
from safety.dataset import Dataset
from safety.filter import Filter
from safety.fitting import make
from safety.model_set import MODES, ModelSet, Recipe
from tests.safety.unicycle import record


@pytest.fixture(scope="session")
def data() -> Dataset:
    return record(trajectories=40, periods=300)


@pytest.fixture(scope="session")
def held_out() -> Dataset:
    return record(trajectories=30, periods=300, seed=1)


@pytest.fixture(scope="session")
def models(data: Dataset) -> dict[tuple[str, str], ModelSet]:
    return {(kind, mode): make(data, Recipe(kind, mode)) for kind in KINDS for mode in MODES}


@pytest.fixture(scope="session")
def model(models: dict[tuple[str, str], ModelSet]) -> ModelSet:
    """The default certificate and mode."""
    return models["residual", "direct"]


@pytest.fixture(scope="session")
def ready(model: ModelSet) -> Filter:
    return Filter(model)
