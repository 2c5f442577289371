"""Filters of many loops in one array: each is the one that it is alone."""

import numpy as np
import pytest
from online_models import linear_model, pendulum_model

from hybrid_mpc import ExtendedKalmanFilter, InputError, SwitchingFilter
from hybrid_mpc.estimate.switching import FilterBank

NAMES = ("t", "x", "h", "d", "innovation", "nis")
PERIODS = 30


def switching(model, transition=((0.9, 0.09, 0.01), (0.5, 0.45, 0.05), (0.45, 0.05, 0.5))):
    n_x, n_u = model.n_x, model.n_u
    return SwitchingFilter(
        [
            ExtendedKalmanFilter(
                model, sigma_y=np.full(model.n_y, 1e-2), sigma_x=np.full(n_x, scale * 1e-3),
                sigma_x0=np.full(n_x, 0.3), sigma_d=np.full(n_u, step), sigma_d0=np.full(n_u, 0.1),
            )
            for scale, step in ((1.0, 1e-3), (10.0, 1e-3), (1.0, 0.3))
        ],
        transition,
    )  # fmt: skip


def pair():
    """Two angles and two speeds; both angles are measured."""
    a = np.block([[np.eye(2), 0.1 * np.eye(2)], [-0.2 * np.eye(2), np.array([[0.9, 0.05], [0.0, 0.95]])]])
    return linear_model(a, np.vstack([np.zeros((2, 2)), 0.1 * np.eye(2)]), np.eye(2, 4))


def compare(several, ys, us):
    """Every loop in a bank and alone, period by period; ``ys`` ``(n, b, n_y)``, ``us`` ``(n, b, n_u)``."""
    bank, b = FilterBank(several, ys[0]), ys.shape[1]
    alone = [several.start(y) for y in ys[0]]
    with np.errstate(over="ignore", invalid="ignore"):
        for k in range(1, len(ys)):
            found = bank.update(ys[k], us[k])
            alone = [several.update(alone[i], ys[k, i], us[k, i]) for i in range(b)]
            for i, (one, wanted) in enumerate(zip(found, alone, strict=True)):
                for name in NAMES:  # sums in another order, over thirty periods of stable filters
                    np.testing.assert_allclose(
                        getattr(one, name), getattr(wanted, name), rtol=1e-6, atol=1e-8,
                        err_msg=f"{name} of loop {i} in period {k}",
                    )  # fmt: skip
    return alone


def samples(model, loops):
    rng = np.random.default_rng(0)
    ys = 0.2 * np.sin(0.1 * np.arange(PERIODS))[:, None, None] + 1e-2 * rng.normal(
        size=(PERIODS, loops, model.n_y)
    )
    return ys, 0.1 * rng.normal(size=(PERIODS, loops, model.n_u))


@pytest.mark.parametrize("make", [pair, lambda: pendulum_model(z=3)])
def test_samples_that_are_missing_or_absurd(make):
    model = make()
    ys, us = samples(model, 6)
    ys[0, 1] = np.nan  # not even a first one
    ys[5:9, 1] = np.nan
    ys[5:9, 2, 0] = np.inf  # where there are two, the other one stays
    ys[7, 3] = 1e200
    ys[20, 3] = -1e200
    ys[7, 4, 0] = 1e200
    ys[7, 5] = 1e5  # improbable, no more
    compare(switching(model), ys, us)


def test_a_lost_prediction_waits_for_a_sample():
    model = pendulum_model(z=3)
    ys, us = samples(model, 3)
    us[5, 0] = np.inf
    us[5, 1] = np.inf
    ys[5:8, 1] = np.nan
    alone = compare(switching(model), ys, us)
    assert all(np.all(np.isfinite(e.x)) for e in alone)


def test_a_mode_that_cannot_be_entered_goes_on_alone():
    model = pair()
    several = switching(model, ((1.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)))
    compare(several, *samples(model, 2))


@pytest.mark.parametrize(
    "c", [[[2.0, 0.0]], [[0.0, 1.0]], [[1.0, 1e-9]], [[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]]]
)
def test_outputs_that_are_not_the_first_states_are_refused(c):
    model = linear_model(np.array([[1.0, 0.1], [-0.1, 0.9]]), np.array([[0.0], [0.1]]), np.array(c))
    with pytest.raises(InputError, match=r"outputs are its first \d states; those of linear are not"):
        FilterBank(switching(model), np.zeros((2, len(c))))
