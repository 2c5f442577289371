"""Readings of the energy, and the monitor, against a machine whose faults are known."""

from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from monitor_parts import (
    DT,
    NOISE,
    Estimate,
    Exact,
    Observer,
    Run,
    by_hand,
    energy,
    of_force,
    pendulum,
    simulate,
)  # fmt: skip

from hybrid_mpc import ChannelLimit, HybridModel, InputError, Signal, count_alarms, learn_limits, replay
from hybrid_mpc.model.model import step_symbols
from hybrid_mpc.watch.learn import calibrate


@pytest.mark.parametrize("kind", ["sine", "steps"])
@pytest.mark.parametrize("window", [5, 11, 21])
def test_perfect_model_has_no_violation_even_under_torque_steps(kind, window):
    run = simulate(400, kind=kind)
    monitor = energy(window=window)
    trace = replay(monitor, Exact(run), run)
    # The identity is exact; what remains is the fourth-order integrator's dp against dv, h^5 per
    # sub-step of 5 ms (1e-11) over dt^2 (4e-4), with power ~ 10 W: below 1e-5 W. The power itself is ~ 1 W.
    assert np.nanmax(trace.of("violation")) < 1e-5
    assert np.isfinite(trace.of("violation")[window - 1 :]).all()
    assert np.isnan(trace.of("violation")[: window - 1]).all()


def test_violation_is_J_v_times_the_acceleration_error_under_a_constant_push():
    run = simulate(400, kind="sine")
    trace = replay(energy(pendulum(push=0.3)), Exact(run), run)
    # The model's one step feels its own friction: gamma dt / (2 J) = 1.5 % less than 0.3 |v|, plus the
    # cubic's velocity error, of order dt^2 at the kinks of the held input: below 2e-3 W.
    expected = 0.3 * np.abs(run.x[2:-2, 1])
    assert np.all(np.abs(trace.of("violation")[4:] - expected) < 0.02 * expected + 2e-3)
    assert expected.max() > 0.5


def nominal(count, first=0):
    return [simulate(5000, s, noise=NOISE) for s in range(first, first + count)]


def learned(count, rate):
    """Limits from so many nominal runs of 100 s."""
    return learn_limits(
        energy(window=11, free_run=0.6).readings,
        Observer(pendulum()),
        nominal(count),
        false_alarms_per_hour=rate,
    )


@pytest.mark.full
@pytest.mark.parametrize(
    ("count", "least", "most"), [(2, 0, 20), pytest.param(6, 1, 30, marks=pytest.mark.full)]
)
def test_alarm_rate_on_fresh_nominal_data_is_near_the_wanted_rate(count, least, most):
    armed = energy(limits=learned(4, 60.0), window=11, free_run=0.6)
    runs = [replay(armed, Observer(pendulum()), run) for run in nominal(count, 10)]
    n = sum(count_alarms(r.alarm[100:], DT)[0] for r in runs)
    # 10 min at 60/h: 10 expected. Factor 3 for the threshold's own error (80 blocks, |scale| error 10 %
    # at -log(1/12) = 2.5 scales) and Poisson spread: P(n > 30 | 10) < 1e-6; no alarm at all has 5e-5.
    # A third of it: 3.3 expected, 10 with the factor, P(n > 20 | 10) = 0.2 %, and none at all has 4 %.
    assert least <= n <= most


def test_update_is_pure():
    run = simulate(40)
    monitor = energy(pendulum(push=0.2))
    state = monitor.initial()
    for k in range(1, 20):
        estimate = Estimate(run.x[k], np.zeros(0), np.zeros(1))
        state, _ = monitor.update(state, run.y[k], run.u[k - 1], estimate)
    before = state.readings.memory.copy()
    estimate = Estimate(run.x[20], np.zeros(0), np.zeros(1))
    first = monitor.update(state, run.y[20], run.u[19], estimate)
    monitor.update(first[0], run.y[21], run.u[20], estimate)
    second = monitor.update(state, run.y[20], run.u[19], estimate)
    assert first[1].values == second[1].values
    assert np.array_equal(first[0].readings.memory, second[0].readings.memory)
    assert np.array_equal(before, state.readings.memory)


def test_a_missing_measurement_blinds_one_window_and_raises_nothing():
    run = simulate(200)
    y = run.y.copy()
    y[100] = np.nan
    trace = replay(energy(limits=by_hand(of_force(1e-3))), Exact(run), replace(run, y=y))
    assert np.flatnonzero(np.isnan(trace.of("violation")[4:])).tolist() == list(range(96, 101))
    assert np.isfinite(trace.levels).all()  # the sum waits
    assert not trace.alarm.any()


@pytest.mark.parametrize(("torque", "excess"), [(0.15, 0.0), (-0.15, 0.0), (0.35, 0.15), (-0.35, 0.15)])
def test_at_rest_only_what_friction_cannot_hold_counts(torque, excess):
    n = 60
    run = Run(np.arange(n) * DT, np.zeros((n, 1)), np.full((n, 1), torque), np.zeros((n, 2)))
    monitor = energy(pendulum(friction=0.1, dry=0.2), rest_speed=0.2)
    trace = replay(monitor, Exact(run), run)
    # dry friction holds 0.2 (tanh(10) = 1 - 4e-9); viscous friction, 0.02 at the rest speed of 0.2 rad/s, holds nothing
    np.testing.assert_allclose(np.abs(trace.of("force of phi"))[20:], excess, atol=1e-6)
    np.testing.assert_allclose(trace.of("violation")[20:], 0.0, atol=1e-12)  # no power at rest


def test_any_channel_s_alarm_is_an_alarm_and_is_named():
    run = simulate(300, fault=pendulum(push=0.3), at=150)
    never = ChannelLimit("violation", "W", 1, 1e9, 1e9)
    assert not replay(energy(limits=by_hand(never)), Exact(run), run).alarm.any()
    both = by_hand(never, of_force(5.0, scale=0.01, drift=1.0))
    trace = replay(energy(limits=both), Exact(run), run)
    assert not trace.alarm[:150].any()
    assert trace.alarm[165:].any()
    assert list(trace.by_channel()) == ["force of phi"]
    assert trace.named(0.0, 6.0) == ("force of phi",)


def test_bad_input_speaks():
    with pytest.raises(InputError, match=r"3\.0.*HM-WATCH-021"):
        calibrate([np.ones(100)], 0.02)
    with pytest.raises(InputError, match="HM-WATCH-011"):
        energy(window=10)
    model = pendulum()
    x, _, u, w, p = step_symbols(model)
    with pytest.raises(InputError, match="HM-WATCH-016"):
        energy(replace(model, output=ca.Function("o", [x, u, w, p], [x[1]])))
    run = simulate(10)
    monitor = energy(model)
    with pytest.raises(InputError, match="HM-WATCH-034"):
        replay(monitor, Exact(run), replace(run, t=2 * run.t))
    with pytest.raises(InputError, match="HM-WATCH-013"):
        monitor.update(
            monitor.initial(), np.zeros(2), np.zeros(1), Estimate(np.zeros(2), np.zeros(0), np.zeros(1))
        )
    with pytest.raises(InputError, match="HM-WATCH-002"):
        of_force(1.0, 2.0)
    with pytest.raises(InputError, match="HM-WATCH-029"):
        energy(model, rest_speed=0.0)


def windy() -> HybridModel:
    """The pendulum with a second torque, which is measured and not commanded."""
    model = pendulum()
    x, h, u, _, p = step_symbols(model)
    w, rate = ca.MX.sym("w"), ca.MX.sym("rate", 2)
    return HybridModel.of(
        "windy", DT, model.states, model.inputs, model.outputs, x=x, u=u, w=w, p=p,
        x_next=model.step(x, h, u + w, [], p)[0], xdot=model.xdot(x, h, u + w, [], p), y=x[0], rate=rate,
        energy=model.balances[0].residual(x, rate, u + w, [], p), disturbances=(Signal("wind", "N m"),),
        parameters=model.parameters,
    )  # fmt: skip


@pytest.mark.parametrize("free_run", [0.0, 0.6])
def test_what_disturbs_and_is_measured_is_no_violation(free_run):
    """The wind is 0.6 N m at most; a monitor that takes the operating point's, none, is off by it times the speed."""
    model, run = windy(), simulate(400, kind="sine")
    wind = 0.6 * np.sin(2 * np.pi * 0.3 * run.t)[:, None]
    blown = SimpleNamespace(t=run.t, y=run.y, u=run.u - wind, w=wind)  # together the torque that acted

    class Knowing(Exact):
        def start(self, y, t, *, w):
            self.told = [w]
            return SimpleNamespace(**vars(super().start(y, t)), w=w)

        def update(self, estimate, y, u_prev, *, w):
            self.told.append(w)
            return SimpleNamespace(**vars(super().update(estimate, y, u_prev)), w=w)

    monitor, estimator = energy(model, window=11, free_run=free_run), Knowing(run)
    trace = replay(monitor, estimator, blown)
    assert np.array_equal(estimator.told, wind)
    # as of a perfect model above; without wind it is 0.6 N m times 3 rad/s
    assert np.nanmax(trace.of("violation")) < 1e-5
    assert np.nanmax(np.abs(trace.of("force of phi"))) < 1e-5
    if free_run:
        calm = replay(energy(window=11, free_run=free_run), Exact(run), run)
        assert (
            np.nanmax(np.abs(trace.values[:, 2] - calm.values[:, 2])) < 1e-9
        )  # the same run, but for rounding
