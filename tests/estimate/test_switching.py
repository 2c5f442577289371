"""Several filters side by side: exact where there is nothing to choose, quick and quiet where there is."""

import numpy as np
import pytest
from online_models import linear_model, pendulum_model, random_linear

from hybrid_mpc import ExtendedKalmanFilter, InputError, SwitchingFilter

TWO = [[0.99, 0.01], [0.5, 0.5]]


def filter_of(model, step, noise=0.01, first=0.01):
    n_x, n_u = model.n_x, model.n_u
    return ExtendedKalmanFilter(
        model, sigma_y=np.full(model.n_y, 0.1), sigma_x=np.full(n_x, noise), sigma_x0=np.full(n_x, 0.3),
        sigma_d=np.full(n_u, step), sigma_d0=np.full(n_u, first),
    )  # fmt: skip


@pytest.fixture(scope="module")
def integrator():
    """Angle and speed on a grid of 0.1 s, driven by the input; the angle is measured."""
    return linear_model(
        np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.005], [0.1]]), np.array([[1.0, 0.0]])
    )


def recorded(model, load, seed, n=400):
    """Outputs of the model under an unknown load ``load(k)``, with the noise that the filters assume."""
    rng, x, ys = np.random.default_rng(seed), np.zeros(model.n_x), []
    for k in range(n):
        ys.append(model.output(x, 0.0, model.w, model.p).full().ravel() + 0.1 * rng.normal(size=1))
        x = model.step(x, np.zeros(0), load(k), model.w, model.p)[0].full().ravel() + 0.01 * rng.normal(
            size=model.n_x
        )
    return np.array(ys)


def estimates(estimator, ys):
    out = [estimator.start(ys[0])]
    for y in ys[1:]:
        out.append(estimator.update(out[-1], y, np.zeros(1)))
    return out


@pytest.mark.parametrize("transition", [[[1.0]], TWO])
def test_filters_that_do_not_differ_are_one_filter(transition):
    model, *_ = random_linear(3, n_x=3, n_u=2, n_y=2, n_h=2)
    single = filter_of(model, 0.05)
    several = SwitchingFilter([filter_of(model, 0.05) for _ in transition], transition)
    rng = np.random.default_rng(0)
    ys, us = rng.normal(size=(50, 2)), rng.normal(size=(50, 2))
    ys[7], ys[9, 0] = np.nan, np.nan
    a, b = single.start(ys[0]), several.start(ys[0])
    for y, u in zip(ys[1:], us, strict=False):
        a, b = single.update(a, y, u), several.update(b, y, u)
    for name in ("x", "h", "d", "P", "innovation", "nis"):  # rounding only: numbers of order one
        np.testing.assert_allclose(getattr(b, name), getattr(a, name), rtol=0, atol=1e-10)


def test_it_follows_a_jump_as_the_quick_filter_and_is_quiet_as_the_quiet_one(integrator):
    quiet, quick = filter_of(integrator, 0.0), filter_of(integrator, 1.0)
    switching = SwitchingFilter([quiet, quick], [[0.998, 0.002], [0.5, 0.5]])
    start, load, errors = 250, 3.0, {}
    for name, e in (("quiet", quiet), ("quick", quick), ("switching", switching)):
        before, after = [], []
        for seed in range(5):
            ys = recorded(integrator, lambda k: load * (k >= start), seed)
            d = np.array([v.d[0] for v in estimates(e, ys)])
            before.append(np.sqrt(np.mean(d[50:start] ** 2)))
            after.append(np.sqrt(np.mean((d[start + 20 :] - load) ** 2)))
        errors[name] = np.mean(before), np.mean(after)
    # Wide margins: five runs of 400 samples leave a few per cent of scatter in such means.
    assert errors["switching"][0] < 0.3 * errors["quick"][0]
    assert errors["switching"][1] < 0.8 * errors["quick"][1]
    assert errors["switching"][1] < 0.2 * errors["quiet"][1]


def test_an_improbable_jump_leaves_the_quiet_filter_quiet(integrator):
    # Mixed in as a thousandth it would put a variance of 1e-3 into the quiet filter in every period.
    quiet = filter_of(integrator, 0.0)
    switching = SwitchingFilter([quiet, filter_of(integrator, 1.0)], [[0.999, 0.001], [0.9, 0.1]])
    ys = recorded(integrator, lambda k: 0.0, 3, n=100)
    alone, both = estimates(quiet, ys)[-1], estimates(switching, ys)[-1]
    np.testing.assert_allclose(both.modes[0].P, alone.P, rtol=1e-9)


def test_probabilities_say_when_the_load_came(integrator):
    switching = SwitchingFilter([filter_of(integrator, 0.0), filter_of(integrator, 1.0)], TWO)
    found = estimates(switching, recorded(integrator, lambda k: 3.0 * (k >= 100), 1, n=200))
    assert all(e.probability.sum() == pytest.approx(1.0, abs=1e-12) for e in found)
    jump = np.array([e.probability[1] for e in found])
    # 3 * 0.1^2 / 2 in the first period, 0.06 after two, 0.14 after three: above the noise of 0.1 by then.
    assert 100 < np.argmax(jump) <= 115


def test_missing_measurements_leave_the_prediction(integrator):
    switching = SwitchingFilter([filter_of(integrator, 0.0), filter_of(integrator, 1.0)], TWO)
    predicted = switching.predict(switching.start([0.2]), [0.1])
    assert switching.correct(predicted, [np.nan]) is predicted
    assert np.all(np.isfinite(switching.start([np.nan]).x))


def test_a_lost_filter_starts_anew():
    model = pendulum_model(z=4)
    first = np.full(2, 0.1)
    filters = [
        ExtendedKalmanFilter(model, sigma_y=[1e-3], sigma_x=[1e-3, 1e-2], sigma_x0=first, sigma_d=[s])
        for s in (1e-3, 0.1)
    ]
    switching = SwitchingFilter(filters, TWO)
    lost = switching.update(switching.start([0.3]), np.array([0.3]), np.array([np.inf]))
    assert lost.x[0] == pytest.approx(0.3)
    assert np.all(np.isfinite(lost.P))
    absurd = switching.update(switching.start([0.3]), np.array([1e300]), np.zeros(1))
    after = switching.update(absurd, np.array([0.2]), np.zeros(1))
    for _ in range(3):
        after = switching.update(after, np.array([0.2]), np.zeros(1))
    assert np.all(np.isfinite(after.x))
    assert abs(after.x[0] - 0.2) < 0.05


def test_bad_input_is_refused(integrator):
    quiet, other = filter_of(integrator, 0.0), filter_of(pendulum_model(), 0.0)
    with pytest.raises(InputError, match="HM-ESTIMATE-018"):
        SwitchingFilter([quiet, other], TWO)
    with pytest.raises(InputError, match="HM-ESTIMATE-018"):
        SwitchingFilter([], np.zeros((0, 0)))
    for bad in ([[1.0]], [[0.9, 0.2], [0.5, 0.5]], [[1.1, -0.1], [0.5, 0.5]]):
        with pytest.raises(InputError, match=r"\(2, 2\).*HM-ESTIMATE-019"):
            SwitchingFilter([quiet, quiet], bad)
    with pytest.raises(InputError, match="HM-ESTIMATE-020"):
        SwitchingFilter([quiet, quiet], TWO).predict(quiet.start([0.0]), [0.0])
