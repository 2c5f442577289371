"""The examples in docstrings run and print what they say."""

import doctest
import importlib
import pkgutil

import pytest

import hybrid_mpc
import nn_export
import scenarios

FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE | doctest.IGNORE_EXCEPTION_DETAIL
MODULES = [
    module.name
    for package in (hybrid_mpc, nn_export, scenarios)
    for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
    if not module.name.endswith("__main__")
]


def test_there_are_modules():
    assert len(MODULES) > 200


@pytest.mark.parametrize("name", MODULES)
def test_examples(name):
    assert doctest.testmod(importlib.import_module(name), optionflags=FLAGS).failed == 0
