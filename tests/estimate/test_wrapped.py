"""Wrapped samples of a periodic output, in any unit: estimates are those of the unwrapped samples."""

import math
from dataclasses import replace

import numpy as np
import pytest
from wrapped_machine import SIGMAS, boat, problem, samples, wrapped

from hybrid_mpc import (
    CondensedController,
    DelayCompensation,
    ExtendedKalmanFilter,
    InputError,
    Loop,
    MovingHorizonEstimator,
    SafeController,
    Signal,
    SwitchingFilter,
    UnscentedKalmanFilter,
    simulate,
)
from hybrid_mpc.loop.plant import ModelPlant
from hybrid_mpc.machine.signals import nearest_turn

ROUNDING = 1e-8
"""Of degrees: the wrapped sample has lost 1e-13 of its digits, and the filters' gains do not enlarge it much."""


def observers():
    model = boat()
    loud = ExtendedKalmanFilter(model, **SIGMAS | {"sigma_d": [3.0]})
    quiet = ExtendedKalmanFilter(model, **SIGMAS)
    return {
        "extended": quiet,
        "switching": SwitchingFilter([quiet, loud], [[0.98, 0.02], [0.3, 0.7]]),
        "unscented": UnscentedKalmanFilter(model, **SIGMAS),
        "moving horizon": MovingHorizonEstimator(model, periods=6, **SIGMAS),
    }


def along(observer, y, u, w):
    estimates = [observer.start(y[0], w=w[0])]
    for k in range(1, len(y)):
        estimates.append(observer.update(estimates[-1], y[k], u[k - 1], w=w[k]))
    return estimates


@pytest.mark.parametrize("kind", ["extended", "switching", "unscented", "moving horizon"])
def test_wrapped_samples_give_the_estimates_of_unwrapped_ones(kind):
    y, u, wind = samples()
    assert np.ptp(y[np.isfinite(y[:, 0]), 0]) > 500.0  # the boat turns more than once
    observer, folded = observers()[kind], y.copy()
    folded[:, 0] = wrapped(y[:, 0])
    plain, found = along(observer, y, u, wind), along(observer, folded, u, wrapped(wind))
    assert plain[0].x[0] == pytest.approx(folded[0, 0])  # the start is as measured
    for a, b in zip(plain, found, strict=True):
        assert np.allclose(a.x, b.x, rtol=0, atol=ROUNDING)
        assert np.allclose(a.d, b.d, rtol=0, atol=ROUNDING)
        assert np.allclose(a.innovation, b.innovation, rtol=0, atol=ROUNDING, equal_nan=True)
        assert np.allclose(a.w, b.w, rtol=0, atol=ROUNDING)


def test_an_output_that_is_not_periodic_keeps_its_sample():
    model = boat()
    flat = replace(model, outputs=tuple(replace(s, periodic=False) for s in model.outputs))
    observer = ExtendedKalmanFilter(flat, **SIGMAS)
    after = observer.update(observer.start([359.0, 0.0], w=[0.0]), [1.0, 0.0], [0.0])
    assert after.innovation[0] == pytest.approx(-358.0, abs=1.0)


def test_the_period_is_that_of_the_unit():
    found = {unit: Signal("a", unit, periodic=True).period for unit in ("rad", "deg", "rev", "turn", "mrad")}
    assert found == {
        "rad": 2 * math.pi,
        "deg": 360.0,
        "rev": 1.0,
        "turn": 1.0,
        "mrad": pytest.approx(2000 * math.pi),
    }
    assert Signal("a", "rad", periodic=True).radians == 1.0
    assert Signal("a", "m").period == math.inf
    for unit in ("m", "-", "furlong", "rad/s"):
        with pytest.raises(InputError, match="HM-MACHINE-047"):
            Signal("a", unit, periodic=True)
    half = nearest_turn([180.0, 181.0, math.nan, math.inf], np.zeros(4), np.full(4, 360.0))
    assert half[:2].tolist() == [180.0, -179.0]
    assert np.isnan(half[2])
    assert half[3] == math.inf


def closed_loop(folded: bool, **options: object) -> tuple[np.ndarray, np.ndarray, Loop]:
    model = boat()
    loop = Loop(observers()["extended"], SafeController(CondensedController(model, problem())), **options)
    x, headings, inputs = np.array([350.0, 0.0]), [], []
    for k in range(80):
        wind = 358.0 + 5.0 * np.sin(0.2 * k)
        y, w = (np.array([wrapped(x[0]), x[1]]), [wrapped(wind)]) if folded else (x, [wind])
        u = loop.start(y, w) if k == 0 else loop.step(y, w)
        loop.finish()
        headings.append(x[0])
        inputs.append(u[0])
        x = np.array(model.step(x, [], u, wind, [])[0]).ravel()
    return np.array(headings), np.array(inputs), loop


def course(t: np.ndarray) -> np.ndarray:
    return np.column_stack([np.where(t < 5.0, 350.0, 380.0), 0.0 * t])


def test_a_loop_with_a_compass_does_not_turn_a_circle():
    plain, u, _ = closed_loop(False, reference=course)
    found, v, loop = closed_loop(True, reference=course)
    assert np.allclose(plain, found, rtol=0, atol=1e-6)
    assert np.allclose(u, v, rtol=0, atol=1e-6)
    assert plain.max() < 400.0
    assert plain[-1] == pytest.approx(380.0, abs=1.0)
    assert loop.state.y[0] == pytest.approx(380.0, abs=1.0)  # what the monitor reads has no jumps


def test_a_set_point_is_reached_the_short_way_on_request():
    found, *_ = closed_loop(True, reference=lambda t: wrapped(course(t)), nearest_turn=True)
    plain, *_ = closed_loop(True, reference=course)
    assert np.allclose(plain, found, rtol=0, atol=1e-6)
    counted, *_ = closed_loop(True, reference=[20.0, 0.0])
    assert counted.min() < 60.0  # without the option a reference counts turns
    turning, *_ = closed_loop(
        True, nearest_turn=True, reference=lambda t: np.column_stack([350.0 + 12.0 * t, 12.0 + 0.0 * t])
    )
    assert turning[-1] > 700.0  # a reference that turns on purpose


@pytest.mark.parametrize("delay", [0, 2])
def test_a_simulation_goes_the_short_way_and_its_cost_is_that_of_this_way(delay):
    model = boat()

    def run(reference, **options):
        observer = observers()["extended"]
        return simulate(
            ModelPlant(model, (0.0, 0.0)), DelayCompensation(observer, input_delay=delay) if delay else observer,
            CondensedController(model, problem()), reference, dt=model.dt, duration=20.0, x0=[350.0, 0.0], seed=0,
            w=[358.0], input_delay=delay, **options,
        )  # fmt: skip

    counted, found = run([380.0, 0.0]), run([20.0, 0.0], nearest_turn=True)
    assert np.allclose(counted.x, found.x, rtol=0, atol=1e-6)
    assert found.x[-1, 0] == pytest.approx(380.0, abs=1.0)
    assert found.reference[:, 0] == pytest.approx(380.0)
    assert found.cost == pytest.approx(counted.cost)
