"""What the figures of the linear analysis show, and by which colours and dashes."""

import numpy as np

from hybrid_mpc import Signal
from hybrid_mpc.plots import analysis
from hybrid_mpc.plots import analysis as analysis_loops
from hybrid_mpc.plots.style import colour, line_style

U, Y = Signal("u", "N m"), Signal("phi", "rad")


def lines(figure, axis=0):
    return {line.get_label(): line for line in figure.axes[axis].get_lines()}


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
    assert style["label"] == "MOPGRNN (hybrid), reduced to 2 states"
    assert line_style("run 1, second half")["label"] == "run 1, second half"


def test_a_bode_plot_is_not_squeezed_by_the_nyquist_frequency():
    omega = np.geomspace(1.0, 100.0, 200)
    size, phase = 1 / omega, np.linspace(0.0, -3.5 * np.pi / 2, 200)
    size[-1], phase[-1] = 1e-12, np.pi
    figure = analysis.bode({"prior": (omega, size, phase)}, input_signal=U, output_signal=Y, nyquist=100.0)
    assert 1e-3 < figure.axes[0].get_ylim()[0] < 0.01
    drawn = lines(figure, 1)["prior, fitted"]
    assert drawn.get_xdata().max() < 100.0
    assert drawn.get_ydata().max() <= 0.0
    assert np.all(np.diff(figure.axes[1].get_yticks()) == 90)


def test_loops_that_differ_in_their_filter_share_a_colour():
    one = {"omega": np.array([1.0, 2.0]), "S": np.ones(2, complex), "T": np.zeros(2, complex)}
    names = [f"{loop}, {mode}" for loop in ("a on a", "b on a") for mode in ("quiet", "jump")]
    drawn = lines(analysis_loops.sensitivity_functions(dict.fromkeys(names, one)))
    assert drawn["a on a, quiet"].get_color() == drawn["a on a, jump"].get_color()
    assert drawn["a on a, quiet"].get_color() != drawn["b on a, quiet"].get_color()
    assert drawn["a on a, quiet"].get_linestyle() == drawn["b on a, quiet"].get_linestyle() == "-"
    assert drawn["b on a, jump"].get_linestyle() == "--"
    apart = lines(analysis_loops.nyquist(dict.fromkeys(("x", "y"), np.array([1j, -1.0]))))
    assert apart["x"].get_color() != apart["y"].get_color()
    assert apart["x"].get_linestyle() == apart["y"].get_linestyle()
