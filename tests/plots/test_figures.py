"""Every figure: labelled with units, with a legend, written whole and always the same."""

import re
import subprocess
import sys
import warnings
from pathlib import Path

import matplotlib
import numpy as np
import pytest

from hybrid_mpc import InputError, Signal
from hybrid_mpc.plots import analysis, data, estimation, fit, loops, monitor
from hybrid_mpc.plots.style import COLOURS, checked, colour, line_style, name_of, new_figure, number, save

sys.path.insert(0, str(Path(__file__).parents[1] / "report"))
import report_example as example

U, Y = example.INPUTS[0], example.OUTPUTS[0]
INNOVATIONS = {"dt": 0.1, "outputs": (Y,), "mean_band": (0.9, 1.1), "correlation_band": 0.1}


def drawn(ax):
    """Lines of axes by their legend name."""
    return {line.get_label(): line for line in ax.get_lines()}


@pytest.mark.parametrize("name", example.FIGURES)
def test_a_figure_has_units_and_a_legend_and_is_written(name, tmp_path):
    figure = example.FIGURES[name]()
    labels = [ax.get_ylabel() for ax in figure.axes if ax.get_ylabel()]
    across = [ax.get_xlabel() for ax in figure.axes if ax.get_xlabel()]
    assert labels
    assert across or name == "errors"
    for label in labels + across:
        assert re.search(r"\[[^\]]+\]$", label), f"no unit in {label!r}"
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert 0 < len(texts) == len(set(texts))
    assert b"Software" not in save(figure, tmp_path / "a.png").read_bytes()
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]  # no temporary file is left


@pytest.mark.parametrize(
    "name",
    [name if name == "loops" else pytest.param(name, marks=pytest.mark.full) for name in example.FIGURES],
)
def test_the_same_data_are_the_same_bytes(name, tmp_path):
    first, second = (save(example.FIGURES[name](), tmp_path / f"{i}.png").read_bytes() for i in range(2))
    assert first == second


def test_a_figure_is_png_only(tmp_path):
    with pytest.raises(InputError, match="HM-PLOTS-033"):
        save(new_figure(1, 1)[0], tmp_path / "a.svg")


def test_no_global_figure_no_torch_and_no_casadi():
    code = (
        "import sys; import hybrid_mpc.report; from hybrid_mpc.plots import analysis, animation, data, estimation, "
        "fit, loops, monitor, studies, tune; forbidden = {'torch', 'matplotlib.pyplot', 'casadi'}; "
        "assert not forbidden & set(sys.modules), forbidden & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_the_users_matplotlib_settings_stay():
    before = dict(matplotlib.rcParams)
    example.free_run_figure()
    assert dict(matplotlib.rcParams) == before


def test_one_colour_per_role():
    models = ("measured", "phy_nominal", "phy", "rnn", "hybrid", "oracle")
    assert len({COLOURS[m] for m in models}) == len(models)
    # whichever is deployed: in free runs it has the colour that it has in loops, and dashes tell the two apart
    assert COLOURS["hybrid"] == COLOURS["mopgrnn"] == COLOURS["pgrnn"]
    assert line_style("pgrnn")["linestyle"] != line_style("mopgrnn")["linestyle"]
    assert COLOURS["prior"] == COLOURS["phy"]
    assert line_style("reference")["linestyle"] == line_style("phy_nominal")["linestyle"] == "--"
    assert name_of("my $model") == r"my \$model"


def test_free_run_draws_every_balance_with_its_violation_and_unit():
    figure = example.free_run_figure()
    assert len(figure.axes) == 2 * len(example.STATES) + len(example.INPUTS) + 2 * 2
    for above, below, unit in ((*figure.axes[-4:-2], "W"), (*figure.axes[-2:], "kg/s")):
        balances = [line.get_ydata() for line in above.lines]
        violation = below.lines[0].get_ydata()
        np.testing.assert_array_equal(violation, np.abs(balances[1] - balances[0]))
        for ax in (above, below):
            assert ax.get_ylabel().endswith(f"[{unit}]")


def test_free_run_draws_the_errors_of_prior_and_hybrid_below_each_signal():
    figure = example.free_run_figure()
    for i, state in enumerate(example.STATES):
        above, below = figure.axes[2 * i : 2 * i + 2]
        shown = {line.get_label(): line.get_ydata() for line in above.lines}
        errors = {line.get_label(): line.get_ydata() for line in below.lines if line.get_label()[0] != "_"}
        assert set(errors) == {"prior, fitted", "MOPGRNN"}
        for name, error in errors.items():
            np.testing.assert_allclose(error, shown[name] - shown["measured"])
        assert below.get_ylabel() == f"error\n[{state.unit}]"


def test_states_that_are_no_positions_and_speeds_are_drawn_over_time():
    signals = tuple(Signal(name, "degC") for name in ("hot", "warm", "cold"))
    t = np.arange(5.0)
    piece = example.Piece("a", "train", t, t[:, None], t[:, None], np.column_stack([t, 2 * t, 3 * t]))
    figure = data.coverage([piece], signals)
    assert [ax.get_ylabel() for ax in figure.axes] == ["hot [degC]", "warm [degC]", "cold [degC]"]
    np.testing.assert_array_equal(figure.axes[2].lines[0].get_xydata(), np.column_stack([t, 3 * t]))


def test_a_benchmarks_run_has_every_output_in_its_unit():
    t = np.linspace(0.0, 40.0, 401)
    y = np.column_stack([np.sin(t), 20 + np.cos(t)])
    y[7, 1] = np.nan
    figure = fit.benchmark_run(
        t, y, {"phy": y + 0.1}, t, outputs=(Signal("q", "m"), Signal("T", "degC")), inputs=(U,),
        units=[("mm", 1e3), ("K", 1.0)], shown=20.0,
    )  # fmt: skip
    assert [ax.get_ylabel().replace("\n", " ") for ax in figure.axes] == [
        "q [m]", "error of q [mm]", "T [degC]", "error of T [K]", r"$\tau$ [N m]", "RMS error of q [mm]",
        "RMS error of T [K]",
    ]  # fmt: skip
    error = figure.axes[1].lines[0]
    assert error.get_xdata()[-1] == 20.0
    np.testing.assert_allclose(error.get_ydata(), 100.0)
    np.testing.assert_allclose(figure.axes[6].lines[0].get_ydata(), 0.1)  # the missing sample counts nothing


def test_a_model_that_runs_away_does_not_flatten_the_others():
    t = np.linspace(0.0, 10.0, 101)
    x = example.swing(t)
    figure = fit.free_run(
        t, x, {"rnn": 1e6 * x, "mopgrnn": x}, np.zeros((101, 1)), signals=example.STATES, inputs=example.INPUTS,
    )  # fmt: skip
    low, high = figure.axes[0].get_ylim()
    span = np.ptp(x[:, 0])
    assert high - low <= 2.2 * span + 1e-9  # the range of the measurement and 0.6 of it to either side


def test_a_bar_far_above_the_others_is_cut_and_keeps_its_number():
    figure = fit.errors_bar({"phy_nominal": {"e_sim": 100.0}, "phy": {"e_sim": 1.0}}, {"e_sim": "E [-]"})
    ax = figure.axes[0]
    assert ax.get_ylim()[1] < 3
    assert [text.get_text() for text in ax.texts] == ["100 ▲", "1.00"]


def test_a_missing_error_leaves_a_gap():
    figure = fit.errors_bar({"rnn": {"e_sim": None}, "phy": {"e_sim": 1.0}}, {"e_sim": "E [-]"})
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


@pytest.mark.parametrize("most", [1.06731, 1.9, 2.5, 730.0])
def test_numbers_at_the_monitor_s_axes_have_three_digits(most):
    t = np.linspace(0.0, 1.0, 100)
    values, share = np.sin(t)[:, None] * [1.0, 1.0], most * t
    trace = example.monitor_trace(t, values, values[:, :1], share)
    figure = monitor.channels(trace, values[:, :1], outputs=(Y,), limits=example.LIMITS)
    figure.canvas.draw()
    labels = [label.get_text() for ax in figure.axes for label in ax.get_yticklabels()]
    digits = [re.sub(r"\D", "", label).strip("0") for label in labels]
    assert max(map(len, digits)) <= 3


def test_alarm_intervals():
    t = np.arange(5.0)
    assert monitor.intervals(t, [True, False, True, True, True]) == [(0.0, 1.0), (2.0, 4.0)]
    assert monitor.intervals(t, [False] * 5) == []


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.01234, "0.0123"), (12.34, "12.3"), (123.4, "123"), (1234.5, "1234"), (1.023e-4, "0.000102"),
     (2.5e-13, "2.5e-13"), (0.0, "0"), (float("nan"), "nan")],
)  # fmt: skip
def test_numbers_have_three_digits(value, text):
    assert number(value) == text


@pytest.mark.parametrize(
    "draw",
    [
        lambda: data.recordings([], example.OUTPUTS, example.INPUTS),
        lambda: data.coverage([], example.STATES),
        lambda: fit.curves({}),
        lambda: fit.curves({"rnn": {"loss_error": [1.0]}}),
        lambda: fit.curves({"rnn": {"step": [0.0, 1.0], "loss_error": [1.0]}}),
        lambda: fit.errors_bar({"phy": {"other": 1.0}}, {"e_sim": "E [-]"}),
        lambda: fit.parity({}, {}),
        lambda: loops.closed_loops("x", [0.0], [[0.0, 0.0]], {}, states=example.STATES, inputs=()),
        lambda: loops.solve_times({"hybrid": np.array([])}, 20.0),
        lambda: loops.solve_times({"hybrid": np.array([1.0])}, 0.0),
        lambda: analysis.pole_map({"phy": []}, 0.02),
        lambda: analysis.bode({}, input_signal=Signal("u", "N"), output_signal=Signal("y", "m")),
        lambda: checked("u", np.zeros((3, 2)), 4, 2),
        lambda: estimation.innovations([], np.zeros((2, 1)), **INNOVATIONS),
        lambda: estimation.innovations([np.ones(10)], np.zeros((2, 2)), **INNOVATIONS),
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
    (line,) = data.coverage([turning], states, [(0, 1)]).axes[0].get_lines()
    drawn = line.get_xdata()
    assert np.nanmax(np.abs(drawn)) <= np.pi
    assert np.isnan(drawn).sum() == 2  # 12 rad pass -pi twice: at 3.1 and at 9.4 rad


def test_zeros_are_circles_and_those_outside_are_counted():
    poles, zeros = {"prior": [0.9, 0.5]}, {"prior": [-0.8, 3.0, -12.0]}
    figure = analysis.pole_map(poles, 0.02, zeros=zeros)
    labels = [c.get_label() for c in figure.axes[0].collections]
    assert labels == ["prior, fitted: poles", "prior, fitted: zeros"]
    assert "2 zeros outside of the frame" in figure.axes[0].get_title(loc="left")
    hollow = figure.axes[0].collections[1]
    assert len(hollow.get_facecolor()) == 0
    assert np.array_equal(hollow.get_offsets()[:, 0], zeros["prior"])
    assert "outside" not in analysis.pole_map(poles, 0.02).axes[0].get_title(loc="left")


def test_a_reduced_model_has_the_colour_of_its_own_and_dashes():
    style = line_style("hybrid, reduced to 2 states")
    assert (style["color"], style["linestyle"]) == (colour("hybrid"), "--")
    assert style["label"] == "hybrid, reduced to 2 states"
    assert line_style("run 1, second half")["label"] == "run 1, second half"


def test_a_bode_plot_is_not_squeezed_by_the_nyquist_frequency():
    omega = np.geomspace(1.0, 100.0, 200)
    size, phase = 1 / omega, np.linspace(0.0, -3.5 * np.pi / 2, 200)
    size[-1], phase[-1] = 1e-12, np.pi
    figure = analysis.bode({"prior": (omega, size, phase)}, input_signal=U, output_signal=Y, nyquist=100.0)
    assert 1e-3 < figure.axes[0].get_ylim()[0] < 0.01
    line = drawn(figure.axes[1])["prior, fitted"]
    assert line.get_xdata().max() < 100.0
    assert line.get_ydata().max() <= 0.0
    assert np.all(np.diff(figure.axes[1].get_yticks()) == 90)


def test_responses_of_names_of_your_own_can_be_told_apart():
    response = np.array([1.0, 2.0]), np.ones(2), np.zeros(2)
    figure = analysis.bode({"power1": response, "power2": response}, input_signal=U, output_signal=Y)
    one, other = drawn(figure.axes[0]).values()
    assert one.get_color() != other.get_color()


def test_loops_that_differ_in_their_filter_share_a_colour():
    one = {"omega": np.array([1.0, 2.0]), "S": np.ones(2, complex), "T": np.zeros(2, complex)}
    names = [f"{loop}, {mode}" for loop in ("a on a", "b on a") for mode in ("quiet", "jump")]
    lines = drawn(analysis.sensitivity_functions(dict.fromkeys(names, one)).axes[0])
    looks = {name: (line.get_color(), line.get_linestyle()) for name, line in lines.items()}
    assert looks["a on a, quiet"][0] == looks["a on a, jump"][0] != looks["b on a, quiet"][0]
    assert looks["a on a, quiet"][1] == looks["b on a, quiet"][1] == "-"
    assert looks["b on a, jump"][1] == "--"
    apart = drawn(analysis.nyquist(dict.fromkeys(("x", "y"), np.array([1j, -1.0]))).axes[0])
    assert apart["x"].get_color() != apart["y"].get_color()
    assert apart["x"].get_linestyle() == apart["y"].get_linestyle()


def test_figure_shows_all_samples_and_lags(tmp_path):
    rng = np.random.default_rng(0)
    nis = [rng.chisquare(1, 200), rng.chisquare(1, 120)]
    nis[0][50:60] = np.nan
    r = 0.05 * rng.normal(size=(15, 1))
    figure = estimation.innovations(nis, r, title="costs $1", **INNOVATIONS)
    top, bottom = figure.axes
    assert len(top.lines[0].get_xdata()) == 320
    assert len(top.lines[1].get_xdata()) == 320 - 50 + 1
    np.testing.assert_allclose(
        [bar.get_height() for bar in bottom.patches if bar.get_width() < 0.71][:15], r[:, 0]
    )
    assert "[s]" in top.get_xlabel()
    assert save(figure, tmp_path / "nis.png").stat().st_size > 10_000


def test_innovations_of_a_short_recording_without_any_measurement():
    assert estimation.innovations([np.full(10, np.nan)], np.zeros((2, 1)), **INNOVATIONS).axes


def test_lines_of_low_coherence_are_faint_and_have_no_phase():
    omega = np.array([1.0, 2.0, 4.0, 8.0])
    measured = {
        "omega": omega, "response": np.array([1.0, -1j, 0.1, -0.1]), "coherence": np.array([0.9, 0.9, 0.1, 0.9]),
        "deviation": np.zeros(4), "trusted": np.array([True, True, False, True]),
    }  # fmt: skip
    model = measured | {"trusted": np.ones(4, bool)}
    channel = {"input_signal": Signal("u", "N"), "output_signal": Signal("y", "m"), "source": "test"}
    figure = analysis.measured_bode({"measured": measured, "prior": model}, **channel)
    upper, middle, lower = figure.axes
    for ax, values in ((upper, np.abs(measured["response"])), (lower, measured["coherence"])):
        faint, sure, whole = (line for line in ax.lines if len(line.get_xdata()))
        assert faint.get_alpha() < 0.5
        assert faint.get_zorder() < sure.get_zorder()
        np.testing.assert_array_equal(faint.get_ydata(), values)
        np.testing.assert_array_equal(np.isnan(sure.get_ydata()), ~measured["trusted"])
        np.testing.assert_array_equal(whole.get_ydata(), values)
    np.testing.assert_allclose(middle.lines[0].get_ydata(), [0.0, -90.0, np.nan, -180.0])
    assert any("faint" in text.get_text() for text in figure.legends[0].get_texts())
    clean = analysis.measured_bode({"measured": model}, **channel)
    assert not any("faint" in text.get_text() for text in clean.legends[0].get_texts())


def test_bars_of_two_hybrids_differ_by_their_hatching():
    figure = fit.errors_bar({"pgrnn": {"level": 1.0}, "mopgrnn": {"level": 2.0}}, {"level": "RMSE [m]"})
    first, second = figure.axes[0].patches
    assert first.get_facecolor() == second.get_facecolor()
    assert (first.get_hatch(), second.get_hatch()) == ("///", None)


def test_a_character_that_the_font_lacks_warns_of_nothing(tmp_path):
    figure, _ = new_figure(1, 1)
    figure.suptitle("\x1b[2J 名 \u202e")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert save(figure, tmp_path / "a.png").stat().st_size > 100
