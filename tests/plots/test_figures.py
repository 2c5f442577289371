"""Every figure: labelled with units, with a legend, written whole and always the same."""

import hashlib
import re
import subprocess
import sys
from pathlib import Path

import matplotlib
import numpy as np
import pytest

from hybrid_mpc import InputError, Signal
from hybrid_mpc.plots import analysis, data, fit, loops, monitor
from hybrid_mpc.plots import fit as training
from hybrid_mpc.plots.style import COLOURS, checked, line_style, name_of, new_figure, number, save

sys.path.insert(0, str(Path(__file__).parents[1] / "report"))
import report_example as example


@pytest.mark.parametrize("name", example.FIGURES)
def test_labelled_with_units_and_legend(name):
    figure = example.FIGURES[name]()
    labels = [ax.get_ylabel() for ax in figure.axes if ax.get_ylabel()]
    assert labels
    assert any(ax.get_xlabel() for ax in figure.axes) or name == "errors"
    for label in labels + [ax.get_xlabel() for ax in figure.axes if ax.get_xlabel()]:
        assert re.search(r"\[[^\]]+\]$", label), f"no unit in {label!r}"
    assert figure.legends
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts
    assert len(texts) == len(set(texts))


@pytest.mark.parametrize("name", example.FIGURES)
def test_same_data_same_bytes(name, tmp_path):
    files = [save(example.FIGURES[name](), tmp_path / f"{i}.png") for i in range(2)]
    first, second = (hashlib.sha256(f.read_bytes()).hexdigest() for f in files)
    assert first == second
    assert b"Software" not in files[0].read_bytes()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["0.png", "1.png"]  # no temporary file is left


def test_a_failed_save_leaves_the_old_file(tmp_path):
    path = tmp_path / "a.png"
    path.write_bytes(b"old")
    figure, axes = new_figure(1, 1)
    axes[0, 0].set_ylabel(r"$\nosuchcommand$")
    with pytest.raises(ValueError, match="nosuchcommand"):
        save(figure, path)
    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]


def test_a_figure_is_png_only(tmp_path):
    with pytest.raises(InputError, match=r"\.png"):
        save(new_figure(1, 1)[0], tmp_path / "a.svg")


def test_no_global_figure_and_no_torch():
    code = (
        "import sys; import hybrid_mpc.report; from hybrid_mpc.plots import data, fit, loops, "
        "monitor, analysis; assert not {'torch', 'matplotlib.pyplot', 'casadi'} & set(sys.modules), "
        "'a forbidden import'"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_users_matplotlib_settings_stay():
    before = dict(matplotlib.rcParams)
    example.free_run_figure()
    assert dict(matplotlib.rcParams) == before


def test_one_colour_per_role():
    models = ("measured", "phy_nominal", "phy", "rnn", "pgrnn", "mopgrnn", "oracle")
    assert len({COLOURS[m] for m in models}) == len(models)
    assert COLOURS["hybrid"] == COLOURS["mopgrnn"]
    assert COLOURS["prior"] == COLOURS["phy"]
    assert line_style("reference")["linestyle"] == line_style("phy_nominal")["linestyle"] == "--"
    assert name_of("my $model") == r"my \$model"


def test_free_run_draws_the_violation_of_its_balances():
    figure = example.free_run_figure()
    balances = [line.get_ydata() for line in figure.axes[-2].lines]
    drawn = figure.axes[-1].lines[0].get_ydata()
    np.testing.assert_array_equal(drawn, np.abs(balances[1] - balances[0]))


def test_a_model_that_runs_away_does_not_flatten_the_others():
    t = np.linspace(0.0, 10.0, 101)
    x = example.swing(t)
    figure = fit.free_run(
        t,
        x,
        {"rnn": 1e6 * x, "mopgrnn": x},
        np.zeros((101, 1)),
        states=example.STATES,
        inputs=example.INPUTS,
        energy_measured=np.zeros(101),
        energy_model=np.zeros(101),
    )
    low, high = figure.axes[0].get_ylim()
    span = np.ptp(x[:, 0])
    assert high - low <= 2.2 * span + 1e-9  # the range of the measurement and 0.6 of it to either side


def test_a_bar_far_above_the_others_is_cut_and_keeps_its_number():
    figure = fit.errors_bar({"phy_nominal": {"e_sim_s": 100.0}, "phy": {"e_sim_s": 1.0}})
    ax = figure.axes[0]
    assert ax.get_ylim()[1] < 3
    assert [text.get_text() for text in ax.texts] == ["100 ▲", "1.00"]


def test_a_missing_error_leaves_a_gap():
    figure = fit.errors_bar({"rnn": {"e_sim_s": None}, "phy": {"e_sim_s": 1.0}})
    assert [text.get_text() for text in figure.axes[0].texts] == ["1.00"]


def test_recordings_show_every_role():
    figure = data.recordings(example.pieces(), example.OUTPUTS, example.INPUTS, limit=3)
    shown = {text.get_text() for text in figure.legends[0].get_texts()}
    assert shown == {"training", "validation", "test"}


def test_the_enlarged_pole_map_holds_the_slow_poles():
    pole = np.exp(0.02 * (-0.4 + 4.0j))
    figure = analysis.pole_map({"phy": [pole, pole.conj()]}, 0.02)
    zoom = figure.axes[1]
    assert zoom.get_xlim()[0] < pole.real < zoom.get_xlim()[1]
    assert zoom.get_ylim()[0] < -abs(pole.imag)
    assert abs(pole.imag) < zoom.get_ylim()[1]


def test_alarm_intervals():
    t = np.arange(5.0)
    assert monitor.intervals(t, [True, False, True, True, True]) == [(0.0, 1.0), (2.0, 4.0)]
    assert monitor.intervals(t, [False] * 5) == []


def test_numbers_have_three_digits():
    assert [number(v) for v in (0.01234, 12.34, 123.4, 1e-12, float("nan"))] == [
        "0.0123",
        "12.3",
        "123",
        "1e-12",
        "nan",
    ]


@pytest.mark.parametrize(
    "draw",
    [
        lambda: data.recordings([], example.OUTPUTS, example.INPUTS),
        lambda: data.coverage([], example.STATES),
        lambda: training.curves({}),
        lambda: training.curves({"rnn": {"loss_error": [1.0]}}),
        lambda: training.curves({"rnn": {"step": [0.0, 1.0], "loss_error": [1.0]}}),
        lambda: fit.errors_bar({"phy": {"other": 1.0}}),
        lambda: fit.parity({}, {}),
        lambda: loops.closed_loops("x", [0.0], [[0.0, 0.0]], {}, states=example.STATES, inputs=()),
        lambda: loops.solve_times({"hybrid": np.array([])}, 20.0),
        lambda: loops.solve_times({"hybrid": np.array([1.0])}, 0.0),
        lambda: analysis.pole_map({"phy": []}, 0.02),
        lambda: analysis.bode({}, input_signal=Signal("u", "N"), output_signal=Signal("y", "m")),
        lambda: checked("u", np.zeros((3, 2)), 4, 2),
    ],
)
def test_bad_input_is_refused(draw):
    with pytest.raises(InputError):
        draw()


def test_coverage_draws_a_turning_angle_within_half_a_turn_of_zero():
    t = np.linspace(0.0, 1.0, 200)
    turning = example.Piece(
        "a", "train", t, t[:, None], t[:, None], np.column_stack([-12.0 * t, 0 * t - 12.0])
    )
    states = (Signal("phi", "rad", periodic=True), Signal("phi_dot", "rad/s"))
    (line,) = data.coverage([turning], states).axes[0].get_lines()
    drawn = line.get_xdata()
    assert np.nanmax(np.abs(drawn)) <= np.pi
    assert np.isnan(drawn).sum() == 2  # 12 rad pass -pi twice: at 3.1 and at 9.4 rad
