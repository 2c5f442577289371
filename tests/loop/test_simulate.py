"""The simulation itself: what is called when, what is recorded, what is refused."""

from dataclasses import fields

import numpy as np
import pytest
from closed_loop_parts import DT, Recorder, ScriptedReading, hold, make_ekf, make_safe, run, sine
from monitor_parts import energy
from online_models import PendulumPlant, pendulum_model

from hybrid_mpc import (
    OCP,
    ClosedLoopResult,
    CondensedController,
    DelayCompensation,
    Fault,
    HardBound,
    InputError,
    SafeController,
    TrueState,
)
from hybrid_mpc.compare.loops import share_given_way


def test_two_runs_differ_in_nothing_but_durations(model, safe):
    def once(controller):
        monitor = energy(model)
        faults = [Fault(0.2, 0.3, "measurement_dropout"), Fault(0.3, 0.5, "input_gain", 0.5)]
        return run(model, controller, monitor=monitor, faults=faults, seed=3)

    first, again, rebuilt = once(safe), once(safe), once(make_safe(pendulum_model(z=2), horizon=10))
    for other in (again, rebuilt):
        for field in fields(ClosedLoopResult):
            if field.name != "timing_ms":
                np.testing.assert_array_equal(
                    getattr(first, field.name), getattr(other, field.name), field.name
                )
    assert np.isfinite(first.violation).any()


def test_the_record_has_a_row_for_every_period(model, safe):
    result = run(model, safe)
    n = 30
    shapes = {"x": 2, "y": 1, "u": 1, "x_hat": 2, "h": 2, "d": 1, "reference": 2}
    assert {name: getattr(result, name).shape for name in shapes} == {k: (n, v) for k, v in shapes.items()}
    for values in (result.t, result.source, result.status, result.stage_cost, result.alarm):
        assert len(values) == n
    np.testing.assert_array_equal(result.t, np.arange(n) * DT)
    np.testing.assert_array_equal(result.reference, sine(result.t))
    np.testing.assert_array_equal(result.x[0], [0.1, 0.0])
    assert np.all(np.isnan(result.violation))  # there is no monitor
    assert not result.alarm.any()
    parts = [result.timing_ms[name] for name in ("estimate", "solve", "monitor", "prepare")]
    np.testing.assert_allclose(result.timing_ms["total"], np.sum(parts, axis=0), rtol=1e-12)


def test_cost_and_error_are_those_of_the_true_state(model, safe):
    result = run(model, safe)
    du = np.diff(result.u, axis=0, prepend=0.0)
    stage = (
        ((result.x - result.reference) ** 2) @ [300.0, 1.0]
        + 0.05 * result.u[:, 0] ** 2
        + 0.05 * du[:, 0] ** 2
    )
    np.testing.assert_allclose(result.stage_cost, stage, rtol=1e-12)
    assert result.cost == pytest.approx(np.sum(stage) * DT, rel=1e-12)
    assert result.tracking_rmse == pytest.approx(
        np.std(result.x - result.reference, axis=0, mean=0.0), rel=1e-12
    )
    other = run(model, safe, stage_cost=replace_weights(safe.controller.ocp))
    np.testing.assert_allclose(
        other.stage_cost, (result.x[:, 0] - result.reference[:, 0]) ** 2 + result.u[:, 0] ** 2
    )


def test_the_record_tells_which_hard_bounds_gave_way(model, safe):
    """The club starts beyond its bound, so that the first plans cannot keep it; later ones do."""
    bounded = safe.controller.ocp.changed(hard=[HardBound("x", [-np.inf, -np.inf], [0.05, np.inf])])
    controller = SafeController(CondensedController(model, bounded), model, safe_input=[0.0])
    steps = []
    result = run(model, controller, reference=[0.0, 0.0], on_step=steps.append)
    assert result.given_way == tuple(step.decision.solution.given_way for step in steps)
    assert result.given_way[0] == {
        "phi": pytest.approx(0.05, abs=0.02)
    }  # as far as it starts beyond, and its noise
    assert result.given_way[-1] == {}
    share = share_given_way(result)
    assert 0 < share["phi"] < 1
    column = result.to_pandas()["given_way phi"]
    assert (column > 0).mean() == share["phi"]


def replace_weights(ocp):
    return OCP(ocp.horizon, [1.0, 0.0], [1.0], [0.0], ocp.u_min, ocp.u_max)


def test_true_state_is_handed_the_truth(model, safe):
    class Inner(PendulumPlant):
        def hidden(self, state):
            return np.array([0.25, -0.5])

    oracle = TrueState(model)
    fault = Fault(0.0, 1.0, "measurement_dropout")
    result = run(model, safe, plant=Inner(), estimator=oracle, faults=[fault])
    np.testing.assert_array_equal(result.x_hat, result.x)
    np.testing.assert_array_equal(result.h, np.tile([0.25, -0.5], (30, 1)))
    with pytest.raises(InputError, match="HM-ESTIMATE-009"):
        run(model, safe, estimator=oracle)  # a plant without hidden states


class CountingMonitor:
    """Its state is the number of updates; it notes what it is given."""

    def __init__(self):
        self.calls = []

    def initial(self):
        return 0

    def update(self, state, y, u_prev, estimate):
        self.calls.append((state, y.copy(), u_prev.copy(), estimate))
        return state + 1, ScriptedReading(state >= 20, violation_w=float(state), share=2.0 * state)


def test_monitor_sees_each_period_with_the_input_held_before(model, safe):
    monitor, steps = CountingMonitor(), []
    result = run(model, safe, monitor=monitor, on_step=steps.append)
    states, ys, before, estimates = zip(*monitor.calls, strict=True)
    assert states == tuple(range(30))
    np.testing.assert_array_equal(ys, result.y)
    np.testing.assert_array_equal(before, np.vstack([[0.0], result.u[:-1]]))
    assert all(seen is step.estimate for seen, step in zip(estimates, steps, strict=True))
    np.testing.assert_array_equal(result.violation, np.arange(30))
    np.testing.assert_array_equal(result.share, 2 * np.arange(30))
    np.testing.assert_array_equal(result.alarm, np.arange(30) >= 20)
    assert [step.k for step in steps] == list(range(30))


def test_estimator_sees_the_input_held_before(model, safe):
    result = run(model, safe)
    ekf = make_ekf(model)
    again = ekf.run(result.y, result.u)  # the same filter, over the record
    np.testing.assert_array_equal([e.x for e in again], result.x_hat)
    np.testing.assert_array_equal([e.d for e in again], result.d)


def test_a_bare_controller_is_guarded(model, safe):
    bare = run(model, safe.controller)
    np.testing.assert_array_equal(bare.u, run(model, safe).u)
    failing = run(model, safe.controller, reference=lambda t: np.full((len(t), 2), np.nan))
    assert failing.source == ("PLAN",) * 5 + ("HELD",) * 25  # a bare controller declares no safe input
    assert np.all(failing.u[5:] == failing.u[4])
    assert set(failing.status) == {"NOT_FINITE"}


def test_preview_reaches_the_controller():
    model, seen = pendulum_model(), []  # without a network, rest at zero needs no input
    safe = make_safe(model, horizon=10)

    def step_ahead(t):
        seen.append(t.copy())
        return hold(t, 0.0) + np.outer(t > 0.3 - 1e-9, [0.5, 0.0])

    still = {"plant": PendulumPlant(noise=0.0), "x0": [0.0, 0.0], "reference": step_ahead}
    result = run(model, safe, **still)
    assert all(len(t) == 11 for t in seen)
    np.testing.assert_allclose([t[-1] - t[0] for t in seen], 0.2, atol=1e-12)
    assert np.max(np.abs(result.u[:5])) < 1e-9  # rounding: the step is out of sight until t_k + 0.2 s = 0.3 s
    assert np.max(np.abs(result.u[6:14])) > 0.1  # it acts before the step
    ocp = safe.controller.ocp.changed(preview=False)
    blind = run(model, SafeController(CondensedController(model, ocp), pendulum_model()), **still)
    assert np.max(np.abs(blind.u[:15])) < 1e-9
    assert np.max(np.abs(blind.u[15])) > 0.1


def test_weights_are_previewed_and_counted(model, safe):
    seen = []

    def weight(t):
        seen.append(t.copy())
        return np.column_stack([1.0 + (t > 0.3 - 1e-9), 0.5 + 0 * t])

    result = run(model, safe, weight=weight)
    assert all(len(t) == 11 for t in seen)
    du = np.diff(result.u, axis=0, prepend=0.0)[:, 0]
    error = (result.x - result.reference) ** 2 * weight(result.t)
    stage = error @ [300.0, 1.0] + 0.05 * result.u[:, 0] ** 2 + 0.05 * du**2
    np.testing.assert_allclose(result.stage_cost, stage, rtol=1e-12)
    ones = run(model, safe, weight=lambda t: np.ones((len(t), 2)))
    np.testing.assert_array_equal(ones.u, run(model, safe).u)
    assert not np.array_equal(ones.u, result.u)


def test_a_preview_that_ends_with_the_run_holds_its_last_value(model, safe):
    end = 0.6
    ends = lambda f: lambda t: np.where((t > end + 1e-9)[:, None], np.nan, f(t))  # noqa: E731
    held = lambda f: lambda t: f(np.minimum(t, end))  # noqa: E731
    weight = lambda t: np.column_stack([1 + t, 1 + t])  # noqa: E731
    got = run(model, safe, reference=ends(sine), weight=ends(weight))
    want = run(model, safe, reference=held(sine), weight=held(weight))
    np.testing.assert_allclose(got.u, want.u, atol=1e-12)  # 0.6 s and 30 periods of 0.02 s differ by rounding
    assert set(got.source) == {"MPC"}


@pytest.mark.parametrize(("sensor", "inputs"), [(0, 0), (2, 0), (0, 2), (1, 1)])
def test_delays_shift_what_arrives_and_what_acts(model, safe, sensor, inputs):
    acted = []
    plant = Recorder(PendulumPlant(noise=0.0), acted)
    ekf = DelayCompensation(make_ekf(model), sensor_delay=sensor, input_delay=inputs)
    monitor = CountingMonitor()
    result = run(
        model, safe, plant=plant, estimator=ekf, sensor_delay=sensor, input_delay=inputs, monitor=monitor
    )
    n = len(result.t)
    np.testing.assert_array_equal(result.y[sensor:, 0], result.x[: n - sensor, 0])
    np.testing.assert_array_equal(result.y[:sensor, 0], 0.1)  # the sensor saw the machine rest
    np.testing.assert_array_equal(np.ravel(acted)[inputs:], result.u[: n - inputs, 0])
    np.testing.assert_array_equal(np.ravel(acted)[:inputs], 0.0)
    # What the monitor is given belongs together: measurement, input before it and estimate of one instant.
    for k in range(sensor + 1, n):
        _, y, u, estimate = monitor.calls[k]
        assert y[0] == result.x[k - sensor, 0]
        assert u[0] == acted[k - sensor - 1][0]
        assert estimate.t == pytest.approx((k - sensor) * DT)
    # The cost is that of the input that acts.
    now = np.ravel(acted)
    stage = ((result.x - result.reference) ** 2) @ [300.0, 1.0]
    stage += 0.05 * now**2 + 0.05 * np.diff(now, prepend=0.0) ** 2
    np.testing.assert_allclose(result.stage_cost, stage, rtol=1e-12)


def test_a_late_solve_is_the_shifted_plan(model, safe):
    steps = []
    result = run(model, safe, late=lambda t: 0.3 - 1e-9 < t < 0.38, on_step=steps.append)
    late = [k for k, status in enumerate(result.status) if status == "LATE"]
    assert late == [15, 16, 17, 18]
    assert [result.source[k] for k in late] == ["PLAN"] * 4
    plan = steps[14].decision.solution.u
    np.testing.assert_array_equal(result.u[15:19], plan[1:5])
    assert result.source[19] == "MPC"
    never = run(model, safe, late=lambda t: True)
    assert set(never.status) == {"LATE"}
    assert set(never.source) == {"PLAN", "FALLBACK"}
