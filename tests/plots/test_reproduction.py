"""Figures of the reproduction: units, legend, the same bytes for the same data, divergence shown."""

import re

import numpy as np
import pytest

from hybrid_mpc import InputError, Signal
from scenarios.paper.plots import LOOKS, errors_over_sequences, shown_free_run


def curve(mean, diverged=(0, 0)):
    return {"sequences": [3, 6], "mean": mean, "std": [0.1, 0.0], "diverged": diverged, "networks": [16, 16]}


def errors_figure():
    curves = {model: curve([0.5 + 0.1 * i, 0.4]) for i, model in enumerate(LOOKS)}
    curves["rnn"] = curve([np.nan, 0.9], (16, 2))
    return errors_over_sequences({"(a)": curves, "(b)": curves}, "E_sim [s]")


def run_figure():
    t = 0.1 * np.arange(30)
    x = np.column_stack([np.sin(t), np.cos(t)])
    run = {"t": t, "u": x[:, :1], "x": x, "x_hat": 1.1 * x, "balances": x[:, :1], "balances_hat": x[:, 1:]}
    states, inputs = [Signal("phi", "rad"), Signal("phi_dot", "rad/s")], [Signal("u", "N m")]
    return shown_free_run({"phy": run, "mopgrnn": run}, states, inputs)


@pytest.mark.parametrize("make", [errors_figure, run_figure])
def test_labelled_with_units_and_legend(make):
    figure = make()
    labels = [text for ax in figure.axes for text in (ax.get_xlabel(), ax.get_ylabel()) if text]
    assert len(labels) >= 2
    for label in labels:
        assert re.search(r"\[[^\]]+\]$", label), f"no unit in {label!r}"
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert len(texts) == len(set(texts))


def test_diverged_networks_are_written_into_the_figure():
    texts = [text.get_text() for ax in errors_figure().axes for text in ax.texts]
    assert texts == ["16 of 16 diverged", "2 of 16 diverged"] * 2


def test_models_differ_in_colour_and_marker():
    assert len({look[0] for look in LOOKS.values()}) == len(LOOKS)
    assert len({look[2] for look in LOOKS.values() if look[2]}) == len(LOOKS) - 2  # the priors have none


def test_bad_input():
    with pytest.raises(InputError, match="HM-SCENARIOS-020"):
        errors_over_sequences({}, "E_sim [s]")
    with pytest.raises(InputError, match=r"mopgrnn.*HM-SCENARIOS-021"):
        shown_free_run({"phy": {}}, [], [])
