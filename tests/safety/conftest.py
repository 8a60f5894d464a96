"""One recording of the kinematic robot, and the model sets made from it."""

import pytest

from brakeline.safety.filter.filter import Filter
from brakeline.safety.model.dataset import Dataset
from brakeline.safety.model.fitting import fit_model_set
from brakeline.safety.model.model_set import ModelConfig, ModelSet
from tests.safety.unicycle import record


@pytest.fixture(scope="session")
def data() -> Dataset:
    return record(trajectories=40, periods=300)


@pytest.fixture(scope="session")
def held_out() -> Dataset:
    return record(trajectories=30, periods=300, seed=1)


class Made(dict[tuple[str, str], ModelSet]):
    """Model sets by certificate and mode, each made when it is first asked for."""

    def __init__(self, data: Dataset) -> None:
        self._data = data

    def __missing__(self, model_config: tuple[str, str]) -> ModelSet:
        self[model_config] = fit_model_set(self._data, ModelConfig(*model_config))
        return self[model_config]


@pytest.fixture(scope="session")
def models(data: Dataset) -> Made:
    return Made(data)


@pytest.fixture(scope="session")
def model(models: Made) -> ModelSet:
    """The default certificate and mode."""
    return models["residual", "direct"]


@pytest.fixture(scope="session")
def ready(model: ModelSet) -> Filter:
    return Filter(model)
