"""Closed loops on a machine that is not the model: other parameters, other friction, another integrator."""

import numpy as np
import pytest
from closed_loop_parts import POINT, hold, make_ekf, make_safe, sine
from hypothesis import given, settings
from hypothesis import strategies as st
from online_models import PendulumPlant, pendulum_model

from hybrid_mpc import (
    OCP,
    CondensedController,
    Fault,
    SafeController,
    SQPController,
    TrueState,
    simulate,
)


def loop(model, plant, reference, duration=6.0, **options):
    safe = options.pop("safe", None) or make_safe(model)
    estimator = options.pop("estimator", None) or make_ekf(model)
    return simulate(
        plant,
        estimator,
        safe,
        reference,
        dt=0.02,
        duration=duration,
        **{"x0": [0.0, 0.0], "seed": 0, **options},
    )


def viscous(**changes):
    """The model's own parameters and viscous friction only: the plant differs by its integrator alone."""
    same = {"gravity": 2.4, "damping": 0.2, "friction": 0.0, "inertia": 0.14}
    return pendulum_model(**same), PendulumPlant(**{**same, "noise": 0.0, **changes})


@pytest.mark.full
def test_the_steady_error_is_the_one_that_the_weights_ask_for():
    model, plant = viscous(disturbance=0.3)
    safe = make_safe(model, r=0.5, horizon=100)
    result = loop(model, plant, hold, duration=12.0, safe=safe)
    # The cheapest rest: minimise q (phi - 0.4)^2 + r u^2 with u = 2.4 sin(phi) - 0.3, by a fine grid.
    phi = np.linspace(0.3, 0.45, 300001)
    best = phi[np.argmin(300.0 * (phi - 0.4) ** 2 + 0.5 * (2.4 * np.sin(phi) - 0.3) ** 2)]
    assert abs(best - 0.4) > 1e-3
    # A finite horizon with a terminal weight at the reference differs from it a little.
    assert abs(result.x[-1, 0] - best) < 0.15 * abs(best - 0.4)


def test_unstable_upright_position_is_held_and_the_angle_counts_on():
    plant = PendulumPlant()
    up = lambda t: hold(t, np.pi)  # noqa: E731
    result = loop(pendulum_model(), plant, up, duration=5.0, x0=[np.pi - 0.2, 0.0])
    # 0.09 N m of dry friction over a gain of several N m/rad
    assert np.max(np.abs(result.x[-50:, 0] - np.pi)) < 0.03


def test_missing_measurements_are_bridged_by_the_model():
    model, plant = viscous()
    gaps = [Fault(start, start + 0.2, "measurement_dropout") for start in np.arange(2.0, 5.0, 0.4)]
    whole = loop(model, plant, sine, duration=5.0, safe=make_safe(model, r=1e-3))
    gappy = loop(model, plant, sine, duration=5.0, safe=make_safe(model, r=1e-3), faults=gaps)
    assert np.mean(np.isnan(gappy.y[100:])) > 0.4
    late = whole.t > 2.0
    worse = np.max(np.abs(gappy.x[late, 0] - gappy.reference[late, 0]))
    # half of them are missing
    assert worse < np.max(np.abs(whole.x[late, 0] - whole.reference[late, 0])) + 1e-3


@pytest.mark.parametrize("kind", ["rti", "sqp"])
def test_a_stroke_meets_speed_and_place_at_its_instant(kind):
    model, plant = viscous()

    def reference(t):
        return np.column_stack([np.zeros(len(t)), np.where(t < 1.0 + 1e-6, 2.0, 0.0)])

    def weight(t):
        hit, after = np.abs(t - 1.0) < 1e-6, t > 1.0 + 1e-6
        return np.column_stack([1e4 * hit + (t > 1.5), 1e4 * hit + after])

    ocp = OCP(90, [400.0, 1.0], [4.0], [16.0], [-1.2], [1.2], working_point=POINT)
    controller = CondensedController(model, ocp) if kind == "rti" else SQPController(model, ocp)
    safe = SafeController(controller, pendulum_model())
    result = loop(model, plant, reference, 2.4, safe=safe, weight=weight, estimator=TrueState(model))
    assert set(result.source) == {"MPC"}
    # The plant is the model to 1e-8. The weight of the hit makes 1 % of speed cost as much as all of the effort.
    assert np.abs(result.x[50, 1] - 2.0) < 0.02
    assert np.abs(result.x[50, 0]) < 1e-3
    assert np.max(np.abs(result.x[-1])) < 0.05  # it comes to rest
    assert np.max(np.abs(result.u)) <= 1.2


def test_a_limit_on_the_speed_is_kept_in_closed_loop():
    model, plant = viscous()
    step = lambda t: hold(t, 0.8)  # noqa: E731
    fast = loop(model, plant, step, 2.0, safe=make_safe(model, r=1e-3))
    ocp = OCP(20, [300.0, 1.0], [1e-3], [0.05], [-6.0], [6.0], x_min=[-9.0, -1.5], x_max=[9.0, 1.5],
              working_point=POINT)  # fmt: skip
    slow = loop(model, plant, step, 2.0, safe=SafeController(CondensedController(model, ocp)),
                estimator=TrueState(model))  # fmt: skip
    assert np.max(fast.x[:, 1]) > 3.0
    assert np.max(slow.x[:, 1]) == pytest.approx(1.5, abs=1e-3)  # one linearization a period
    assert set(slow.source) == {"MPC"}


@pytest.mark.parametrize("sensor", [False, True])
def test_a_limit_on_the_angle_that_can_be_kept_is_kept_to_a_milliradian(sensor):
    model, plant = viscous()
    beyond = lambda t: 0.7 * np.sin(3.0 * t[:, None]) * [1.0, 0.0]  # noqa: E731
    ocp = OCP(30, [300.0, 1.0], [1e-3], [0.05], [-6.0], [6.0], x_min=[-0.5, -9.0], x_max=[0.5, 9.0],
              working_point=POINT)  # fmt: skip
    limited = SafeController(CondensedController(model, ocp))
    # With a sensor the estimate moves with its noise (1 mrad here), so a limit of the estimate is not one of the truth.
    estimator, tolerance = (make_ekf(model), 5e-3) if sensor else (TrueState(model), 1e-3)
    free = loop(model, plant, beyond, 6.0, safe=make_safe(model, r=1e-3))
    result = loop(model, plant, beyond, 6.0, safe=limited, estimator=estimator)
    assert np.max(np.abs(free.x[:, 0])) > 0.6
    assert 0.49 < np.max(np.abs(result.x[:, 0])) < 0.5 + tolerance
    assert set(result.source) == {"MPC"}


FAULTS = st.builds(
    Fault,
    st.floats(0, 0.5), st.floats(0.6, 2.0),
    st.sampled_from(["measurement_offset", "measurement_freeze", "measurement_dropout", "input_gain", "input_offset"]),
    st.floats(-1e3, 1e3),
)  # fmt: skip


class Rough(PendulumPlant):
    """A plant whose sensor now and then returns anything."""

    def measure(self, state, rng):
        odd = rng.choice([0.0, np.nan, np.inf, 1e200, -1e308, 30.0], p=[0.7, 0.1, 0.05, 0.05, 0.05, 0.05])
        return super().measure(state, rng) + odd


@settings(max_examples=12, deadline=None)
@given(
    faults=st.lists(FAULTS, max_size=3),
    x0=st.tuples(st.floats(-4, 4), st.floats(-20, 20)),
    points=st.lists(st.one_of(st.floats(-1e3, 1e3), st.just(np.nan), st.just(1e200)), min_size=4, max_size=4),
    seed=st.integers(0, 2**32 - 1),
)
def test_limits_hold_in_any_closed_loop(faults, x0, points, seed):
    model = pendulum_model(z=2)
    safe = make_safe(model, bound=1.5, du_max=0.4, horizon=10)
    reference = lambda t: np.column_stack([np.interp(t, [0, 0.2, 0.4, 0.6], points), 0 * t])  # noqa: E731
    result = loop(model, Rough(), reference, duration=0.8, safe=safe, faults=faults, x0=x0, seed=seed)
    assert len(result.u) == 40
    assert np.all(np.isfinite(result.u))
    assert np.max(np.abs(result.u)) <= 1.5
    # one rounding of held +- du_max and one of the difference, at most 4 ulp of the bound
    assert np.max(np.abs(np.diff(result.u, axis=0, prepend=0.0))) <= 0.4 + 4 * 1.5 * np.finfo(float).eps
    for source, status in zip(result.source, result.status, strict=True):
        assert (source == "MPC") == (status == "SOLVED")
