"""The figures of the tasks: relative costs with their intervals, errors of the strokes."""

import hashlib
import math

import numpy as np
import pytest

from hybrid_mpc import InputError
from hybrid_mpc.plots.loops import CONTROLLERS, costs, strokes
from hybrid_mpc.plots.style import save

NAN = math.nan
ROW = {"prior": (8.0, 1.0), "hybrid": (2.4, 0.2), "oracle": (2.0, 0.1)}


def names(figure):
    return [text.get_text() for text in figure.legends[0].get_texts()]


def points(ax):
    """Single markers: (x, y) of every line of one point."""
    return [(line.get_xdata()[0], line.get_ydata()[0]) for line in ax.lines if len(line.get_xdata()) == 1]


def stroke(controller="hybrid", speed=1.2, error=0.004, timing=0.003):
    return {
        "controller": controller,
        "speed_rad_s": speed,
        "speed_error_rel": error,
        "timing_error_s": timing,
    }


def test_costs_are_relative_to_the_measuring_oracle():
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
        "no oracle": {"prior": (1.0, 0.1)},
        "bad oracle": {"prior": (1.0, 0.1), "oracle": (NAN, NAN)},
    }
    figure = costs(table)
    assert len(points(figure.axes[0])) == 3 + 3 + 1
    assert [text.get_text() for text in figure.axes[0].texts] == ["no cost of the oracle"] * 2
    assert len(figure.axes[0].get_yticklabels()) == 5
    assert save(figure, tmp_path / "a.png").exists()


def test_an_unknown_controller_is_drawn_under_its_name():
    assert names(costs({"track": ROW | {"pid_$": (4.0, 1.0)}}))[-1] == r"pid_\$"


@pytest.mark.parametrize(
    "table", [{}, {"a": {}}, {"a": {"prior": (1.0, 0.1)}}, {"a": {"oracle": (0.0, 0.0)}}]
)
def test_costs_without_an_oracle_are_refused(table):
    with pytest.raises(InputError, match="oracle"):
        costs(table)


def test_strokes_show_units_targets_and_mean_absolute_errors():
    rows = [
        stroke(error=0.004, timing=0.002),
        stroke(error=-0.002, timing=-0.006),
        stroke("prior", 1.9, 0.03),
    ]
    figure = strokes(rows)
    upper, lower = figure.axes
    assert upper.get_ylabel() == "speed error [%]"
    assert lower.get_ylabel() == "timing error [ms]"
    assert lower.get_xlabel().endswith("[rad/s]")
    assert [text.get_text() for text in lower.get_xticklabels()] == ["1.2", "1.9"]
    for ax, target in ((upper, 1.0), (lower, 10.0)):
        box = ax.patches[0].get_window_extent().transformed(ax.transData.inverted())
        np.testing.assert_allclose([box.y0, box.y1], [-target, target], atol=1e-9)
    assert names(figure) == [
        "prior, fitted: 3.00 %, 3.00 ms",
        "MOPGRNN (hybrid): 0.300 %, 4.00 ms",
    ]
    assert any(y == pytest.approx(0.1) for _, y in points(upper))  # the signed mean of +0.4 and -0.2 %


def test_strokes_that_missed_are_counted_and_not_drawn(tmp_path):
    rows = [stroke(), stroke(error=NAN, timing=NAN), stroke("prior", error=None, timing=None)]
    figure = strokes(rows)
    assert names(figure) == [
        "prior, fitted: all 1 missed",
        "MOPGRNN (hybrid): 0.400 %, 3.00 ms, 1 of 2 missed",
    ]
    for ax in figure.axes:
        for line in ax.lines:
            assert np.all(np.isfinite(line.get_ydata()))
    assert save(figure, tmp_path / "a.png").exists()
    assert save(strokes(rows[2:]), tmp_path / "b.png").exists()  # no stroke hit at all


def test_the_longest_legend_fits_into_the_figure():
    rows = [stroke(name, error=0.123, timing=0.0456) for name in CONTROLLERS for _ in range(60)]
    rows += [stroke(name, error=NAN, timing=NAN) for name in CONTROLLERS for _ in range(10)]
    figure = strokes(rows)
    figure.canvas.draw()
    box = figure.legends[0].get_window_extent()
    assert box.x0 >= 0
    assert box.x1 <= figure.bbox.width


def test_strokes_beyond_ten_bands_are_drawn_on_a_logarithmic_axis():
    upper, lower = strokes([stroke(), stroke("prior", error=-0.4, timing=0.01)]).axes
    assert upper.get_yscale() == "symlog"
    assert lower.get_yscale() == "linear"
    low, high = upper.get_ylim()
    assert low < -40 < 40 < high


@pytest.mark.parametrize(
    "rows",
    [[], [{"controller": "prior"}], [stroke(speed=0.0)], [stroke(speed=NAN)]],
)
def test_bad_strokes_are_refused(rows):
    with pytest.raises(InputError, match="strokes"):
        strokes(rows)


def test_same_data_same_bytes(tmp_path):
    figures = [lambda: costs({"track": ROW}), lambda: strokes([stroke(), stroke("prior", error=0.2)])]
    for k, figure in enumerate(figures):
        files = [save(figure(), tmp_path / f"{k}{i}.png") for i in range(2)]
        first, second = (hashlib.sha256(f.read_bytes()).hexdigest() for f in files)
        assert first == second
