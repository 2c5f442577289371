"""The textbook priors of ``benchmarks/textbook.py`` take the columns of the scenarios that they are fitted for."""

import dataclasses
import importlib.util
import sys
from pathlib import Path

import pytest

from hybrid_mpc import load_scenario
from hybrid_mpc.check.preflight import check_scenario

FILE = Path(__file__).parents[2] / "benchmarks" / "textbook.py"
found = importlib.util.spec_from_file_location("textbook", FILE)
textbook = sys.modules["textbook"] = importlib.util.module_from_spec(found)
found.loader.exec_module(textbook)


@pytest.mark.parametrize("name", sorted(textbook.TEXTBOOK))
def test_it_takes_the_scenario_s_columns(name):
    plain, own = textbook.TEXTBOOK[name](), load_scenario(name).prior()
    for group in ("inputs", "outputs", "disturbances"):
        assert [(s.name, s.unit) for s in getattr(plain, group)] == [
            (s.name, s.unit) for s in getattr(own, group)
        ]
    free = [sum(p.lower < p.upper for p in prior.parameters) for prior in (plain, own)]
    assert free[0] <= free[1]


@pytest.mark.parametrize("name", sorted(textbook.TEXTBOOK))
def test_it_passes_the_checks_before_a_run(name):
    scenario = load_scenario(name)
    check_scenario(
        dataclasses.replace(
            scenario,
            prior=textbook.TEXTBOOK[name],
            plant=None,
            tasks=(),
            control=None,
            benchmark=None,
            causes={},
        )
    )
