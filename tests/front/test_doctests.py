"""The examples in the docstrings of public names run, and print what they say."""

import doctest
import importlib

import pytest

import brakeline


@pytest.mark.parametrize("module", sorted({*brakeline.PLACES, "brakeline.extras"}))
def test_examples_print_what_they_say(module):
    results = doctest.testmod(importlib.import_module(module), optionflags=doctest.ELLIPSIS)
    assert results.failed == 0
