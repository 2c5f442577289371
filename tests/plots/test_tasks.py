"""The figures of the tasks: relative costs with their intervals."""

import math

import numpy as np
import pytest

from hybrid_mpc import InputError
from hybrid_mpc.plots.loops import CONTROLLERS, costs
from hybrid_mpc.plots.style import save

NAN = math.nan
ROW = {"prior": (8.0, 1.0), "hybrid": (2.4, 0.2), "prior_observer": (2.0, 0.1)}


def names(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def points(ax):
    """Single markers: (x, y) of every line of one point."""
    return [(line.get_xdata()[0], line.get_ydata()[0]) for line in ax.lines if len(line.get_xdata()) == 1]


def test_costs_are_relative_to_the_prior_with_observer():
    ax = costs({"track": ROW}).axes[0]
    assert sorted(x for x, _ in points(ax)) == pytest.approx([1.0, 1.2, 4.0])
    intervals = [
        tuple(line.get_xdata())
        for line in ax.lines
        if line.get_linestyle() == "-" and line.get_marker() == "None"
    ]
    assert (3.5, 4.5) in [tuple(round(float(v), 9) for v in pair) for pair in intervals]
    assert ax.get_xscale() == "linear"
    assert ax.get_xlabel().endswith("[-]")


def test_costs_name_every_task_and_every_controller_once():
    table = {f"task_{i}": dict.fromkeys(CONTROLLERS, (1.0 + i, 0.1)) for i in range(3)}
    figure = costs(table)
    assert [text.get_text() for text in figure.axes[0].get_yticklabels()] == ["task 0", "task 1", "task 2"]
    assert names(figure) == [label for label, *_ in CONTROLLERS.values()]
    looks = {
        (line.get_color(), line.get_marker(), line.get_markerfacecolor())
        for line in figure.axes[0].lines
        if line.get_label()[0] != "_"
    }
    assert len(looks) == len(CONTROLLERS)  # no two controllers look alike
    low, high = figure.axes[0].get_ylim()
    assert low > high  # the first task is on top


def test_costs_turn_logarithmic_and_cut_an_interval_that_reaches_zero():
    ax = costs({"push": ROW | {"prior": (40.0, 50.0)}}).axes[0]
    assert ax.get_xscale() == "log"
    drawn = np.concatenate([line.get_xdata() for line in ax.lines if len(line.get_xdata()) == 2])
    assert drawn.min() > 0
    assert ax.get_xlim()[0] > 0.1  # the cut interval does not stretch the axis


def test_what_is_missing_leaves_a_gap(tmp_path):
    table = {
        "full": ROW,
        "single seed": {name: (mean, NAN) for name, (mean, _) in ROW.items()},
        "failed": ROW | {"prior": (NAN, NAN), "hybrid": (math.inf, 1.0)},
        "no baseline": {"prior": (1.0, 0.1)},
        "bad baseline": {"prior": (1.0, 0.1), "prior_observer": (NAN, NAN)},
    }
    figure = costs(table)
    assert len(points(figure.axes[0])) == 3 + 3 + 1
    assert [text.get_text() for text in figure.axes[0].texts] == ["no cost of prior with observer"] * 2
    assert len(figure.axes[0].get_yticklabels()) == 5
    assert save(figure, tmp_path / "a.png").exists()


def test_an_unknown_controller_is_drawn_under_its_name():
    assert names(costs({"track": ROW | {"pid_$": (4.0, 1.0)}}))[-1] == r"pid_\$"


@pytest.mark.parametrize(
    "table", [{}, {"a": {}}, {"a": {"prior": (1.0, 0.1)}}, {"a": {"prior_observer": (0.0, 0.0)}}]
)
def test_costs_without_the_baseline_are_refused(table):
    with pytest.raises(InputError, match="HM-PLOTS-028"):
        costs(table)
