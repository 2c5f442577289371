"""The tutorial is what its template gives for the stored numbers of one run of the demo."""

import importlib.util
import json
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def tutorial():
    spec = importlib.util.spec_from_file_location("tutorial", ROOT / "docs/site/tutorial.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_page_is_made_of_the_stored_numbers(tutorial):
    shown = json.loads(tutorial.NUMBERS.read_text())
    assert tutorial.page(shown) == tutorial.PAGE.read_text(), "python docs/site/tutorial.py"


def test_other_numbers_make_another_page(tutorial):
    """Costs that are told apart, alarms and a fit without a warning have words of their own."""
    shown = json.loads(tutorial.NUMBERS.read_text())
    first, second, *_ = shown["loops"]["tasks"]
    first |= {"ratio": 0.5, "low": 0.4, "high": 0.6}
    second |= {"ratio": 1.5, "low": 1.4, "high": 1.6}
    shown["warnings"], shown["watch"]["clean_alarms"] = [], 2
    page = tutorial.page(shown)
    assert (
        f"In `{first['name']}` the hybrid costs 50 % less. In `{second['name']}` the hybrid costs 50 % more."
        in page
    )
    assert "raises 2 false alarms" in page
    assert "The fit warns" not in page


def test_the_numbers_of_a_run_are_those_of_its_results(tutorial, tmp_path):
    """What is stored has the digits that the page shows, and no more."""
    assert tutorial.kept({"a": [1 / 3], "b": 2}) == {"a": [0.333333], "b": 2}
    assert [tutorial.digits(v, 2) for v in (0.0155, 3.04, 80.0)] == ["0.015", "3", "80"]


def test_every_picture_of_the_page_is_kept(tutorial):
    page = tutorial.PAGE.read_text()
    for name in (*tutorial.PICTURES, "report.png"):
        assert f"images/tutorial/{name}" in page
        assert (tutorial.IMAGES / name).stat().st_size < 100_000
