"""Figures of a search: what lies where, and what cannot be drawn."""

import math

import numpy as np
import pytest

from hybrid_mpc import InputError
from hybrid_mpc.plots.tune import STATES, history, settings

STATE = ["complete", "diverged", "complete", "pruned", "complete"]
VALUE = [0.3, math.inf, 0.5, 0.6, 0.1]
SEARCHED = {"hidden": [4 * 2**n for n in range(5)], "decay": [10.0**n for n in range(5)]}


def points(ax, label):
    (line,) = [line for line in ax.lines if line.get_label() == STATES.get(label, ("", "", label))[2]]
    return np.column_stack(line.get_data()).tolist()


def test_every_trial_is_a_point_and_the_best_never_rises():
    ax = history(STATE, VALUE, base=0.3).axes[0]
    assert points(ax, "complete") == [[0, 0.3], [2, 0.5], [4, 0.1]]
    assert points(ax, "pruned") == [[3, 0.6]]
    assert points(ax, "diverged") == [[1, ax.get_ylim()[1]]]
    assert points(ax, "best so far") == [[0, 0.3], [2, 0.3], [4, 0.1]]
    assert {y for _, y in points(ax, "initial settings")} == {0.3}


def test_a_panel_a_setting():
    axes = settings(SEARCHED, STATE, VALUE).axes
    assert [ax.get_xlabel() for ax in axes] == ["hidden units z [-]", "decay [-]"]
    assert points(axes[0], "complete") == [[4, 0.3], [16, 0.5], [64, 0.1]]
    assert points(axes[1], "pruned") == [[1000, 0.6]]


def test_what_cannot_be_drawn_is_refused():
    with pytest.raises(InputError, match="HM-PLOTS-035"):
        history(STATE[1:2], VALUE[1:2])
    with pytest.raises(InputError, match="HM-PLOTS-034"):
        settings({}, STATE, VALUE)
