"""The examples in the docstrings of public names run, and print what they say."""

import doctest
import importlib
import inspect

import pytest

import brakeline
from brakeline.deploy.data.data_paths import record_path
from brakeline.messaging.bus import Bus, BusSettings
from brakeline.messaging.free_ports import free_endpoint
from brakeline.messaging.topics import DECIDE
from brakeline.safety.model.model_set import ModelSet
from tests.robots import GROUND
from tests.safety.served import Service

PUBLIC = {name: getattr(brakeline, name) for name in brakeline.__all__ if name != "__version__"}
MODULES = {value.__module__ for value in PUBLIC.values()}


@pytest.fixture(scope="module")
def surroundings(data_folder, tmp_path_factory):
    """Return what the examples name and cannot make: the endpoint of a running service, a recording, and a folder."""
    endpoint = free_endpoint()
    with Bus(BusSettings(listen=(endpoint,)), "safety") as bus:
        bus.serve(DECIDE, Service(ModelSet.load("ground")).answer)
        folder = tmp_path_factory.mktemp("examples")
        yield {"ENDPOINT": endpoint, "RECORDING": record_path(GROUND), "FOLDER": folder}


@pytest.mark.parametrize("module", sorted(MODULES | {"brakeline.envs", "brakeline.extras"}))
def test_examples_print_what_they_say(module, surroundings):
    results = doctest.testmod(importlib.import_module(module), optionflags=doctest.ELLIPSIS, extraglobs=surroundings)
    assert results.failed == 0


def test_every_public_name_has_an_example():
    """Exceptions need none: their messages say what to do."""
    finder = doctest.DocTestFinder()
    without = [
        name
        for name, value in PUBLIC.items()
        if not (inspect.isclass(value) and issubclass(value, Exception))
        and not any(test.examples for test in finder.find(value, name))
    ]
    assert without == []
