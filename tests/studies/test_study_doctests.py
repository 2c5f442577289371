"""The examples in the docstrings of the studies run and print what they say."""

import doctest
import importlib
import pkgutil

import pytest

from hybrid_mpc import studies

MODULES = [m.name for m in pkgutil.iter_modules(studies.__path__, "hybrid_mpc.studies.")]


@pytest.mark.parametrize("name", [*MODULES, "hybrid_mpc.plots.studies"])
def test_examples(name):
    assert doctest.testmod(importlib.import_module(name)).failed == 0
