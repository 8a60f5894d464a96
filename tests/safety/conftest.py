"""One recording of the kinematic robot, and the model sets made from it."""

from pathlib import Path

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
    """Model sets by certificate and mode, each made once for all processes that test, when it is first asked for."""

    def __init__(self, data: Dataset, folder: Path) -> None:
        self._data, self._folder = data, folder

    def __missing__(self, model_config: tuple[str, str]) -> ModelSet:
        path = self._folder / f"{'-'.join(model_config)}.safetensors"
        if not path.exists():
            fit_model_set(self._data, ModelConfig(*model_config)).save(path)
        self[model_config] = ModelSet.load(path)
        return self[model_config]


@pytest.fixture(scope="session")
def models(data: Dataset, shared_folder: Path) -> Made:
    return Made(data, shared_folder / "unicycle")


@pytest.fixture(scope="session")
def model(models: Made) -> ModelSet:
    """The default certificate and mode."""
    return models["residual", "direct"]


@pytest.fixture(scope="session")
def ready(model: ModelSet) -> Filter:
    return Filter(model)
