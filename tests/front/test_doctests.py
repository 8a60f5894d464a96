"""The examples in the docstrings of public names run, and print what they say."""

import doctest
import importlib

import pytest

import brakeline

MODULES = {getattr(brakeline, name).__module__ for name in brakeline.__all__ if name != "__version__"}


@pytest.mark.parametrize("module", sorted(MODULES | {"brakeline.envs", "brakeline.extras"}))
def test_examples_print_what_they_say(module):
    results = doctest.testmod(importlib.import_module(module), optionflags=doctest.ELLIPSIS)
    assert results.failed == 0
