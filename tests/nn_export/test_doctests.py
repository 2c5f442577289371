"""The examples in the docstrings of nn_export run and print what they say."""

import doctest
import importlib
import pkgutil
import warnings

import pytest

import nn_export

MODULES = sorted(m.name for m in pkgutil.walk_packages(nn_export.__path__, "nn_export."))


@pytest.mark.parametrize("name", MODULES)
def test_examples(name, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # a machine without a compiler is warned, and right
        found = doctest.testmod(importlib.import_module(name))
    assert found.failed == 0


def test_there_are_examples():
    finder = doctest.DocTestFinder()
    examples = [t for name in MODULES for t in finder.find(importlib.import_module(name)) if t.examples]
    assert len(examples) > 15
