"""The monitor of any machine: two tanks, a motor and a heated body, whose balances and outputs are no pendulum's."""

from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from machines import MachinePlant, dc_motor, thermal, two_tanks

from hybrid_mpc import (
    ExtendedKalmanFilter,
    HybridModel,
    InputError,
    Monitor,
    ResidualReadings,
    Signal,
    learn_limits,
    replay,
)
from hybrid_mpc.watch.readings import Validity

MACHINES = {
    "tanks": (two_tanks, (4e-5,), 1e-3, 1e-6),
    "motor": (dc_motor, (2.0,), 1e-2, 1e-2),
    "thermal": (thermal, (3.0, 3.0), 5e-2, 1e-2),
}
"""Model, half the swing of each input, deviation of the sensors, and that of the disturbances a period."""


def observer(model, sigma, step):
    return ExtendedKalmanFilter(
        model, sigma_y=[sigma] * model.n_y, sigma_x=[1e-2 * sigma] * model.n_x, sigma_x0=[10 * sigma] * model.n_x,
        sigma_d=[step] * model.n_d, sigma_d0=[step] * model.n_d,
    )  # fmt: skip


def recording(make, swing, sigma, n, seed, *, broken=None, **plant):
    """Inputs that are held for a while around the operating point; ``broken(k, y)`` is done to the measurement."""
    model, rng = make(), np.random.default_rng(seed)
    machine = MachinePlant(make(), sigma=sigma, **plant)
    x, u_all, y_all = model.x0, np.empty((n, model.n_u)), np.empty((n, model.n_y))
    for k in range(n):
        if k % 20 == 0:
            u = model.u0 + np.array(swing) * rng.uniform(-1, 1, model.n_u)
        y = machine.measure(x, rng)
        y_all[k] = y if broken is None else broken(k, y, y_all[k - 1])
        u_all[k] = u
        x = machine.step(x, u, model.dt)
    return SimpleNamespace(t=model.dt * np.arange(n), u=u_all, y=y_all, w=np.tile(model.w, (n, 1)))


@pytest.fixture(
    scope="module", params=["tanks", *(pytest.param(n, marks=pytest.mark.full) for n in ("motor", "thermal"))]
)
def watched(request):
    make, swing, sigma, step = MACHINES[request.param]
    model = make()
    runs = [recording(make, swing, sigma, 3000, seed) for seed in range(3)]
    limits = learn_limits(
        ResidualReadings(model), observer(model, sigma, step), runs, false_alarms_per_hour=0.1 / model.dt
    )
    return request.param, limits


def trace_of(name, limits, run, **options):
    make, _, sigma, step = MACHINES[name]
    return replay(Monitor(ResidualReadings(make()), limits, **options), observer(make(), sigma, step), run)


@pytest.mark.parametrize("n", [1000, pytest.param(3000, marks=pytest.mark.full)])
def test_unseen_nominal_runs_raise_few_alarms(watched, n):
    """A rate of 0.1 over dt an hour is one in 36000 periods; in 3000 unseen ones a second alarm has a probability of
    0.3 %, and thresholds from 9000 periods are known to some tens of per cent of the rate."""
    name, limits = watched
    make, swing, sigma, _ = MACHINES[name]
    alarm = trace_of(name, limits, recording(make, swing, sigma, n, 11)).alarm[200:]
    assert np.sum(np.diff(alarm.astype(int)) > 0) <= 1


def test_a_load_that_the_model_does_not_know_is_found(watched):
    """A load of half the input's swing from the beginning: the observer follows it, and the monitor sees it yet."""
    name, limits = watched
    make, swing, sigma, _ = MACHINES[name]
    load = 0.5 * np.array(swing)
    found = trace_of(name, limits, recording(make, swing, sigma, 800, 12, load=load))
    assert np.mean(found.alarm[400:]) > 0.5
    assert found.share[-1] > 0.0


def test_a_frozen_sensor_is_named(watched):
    name, limits = watched
    make, swing, sigma, _ = MACHINES[name]
    run = recording(
        make, 2 * np.array(swing), sigma, 600, 13, broken=lambda k, y, held: held if k >= 400 else y
    )
    frozen = trace_of(name, limits, run, resolution=[sigma] * make().n_y).frozen
    assert not frozen[:400].any()
    assert frozen[400:].any()


def test_a_sensor_at_the_end_of_its_range_is_not_frozen():
    make, swing, sigma, _ = MACHINES["thermal"]
    model = make()
    top = float(model.x0[0]) + 0.5
    run = recording(make, 3 * np.array(swing), sigma, 600, 14, broken=lambda k, y, held: np.minimum(y, top))
    assert np.mean(run.y == top) > 0.1
    limited = tuple(type(s)(s.name, s.unit, saturation=(0.0, top)) for s in model.outputs)
    known = Monitor(ResidualReadings(replace(model, outputs=limited)), resolution=[1e-3, 1e-3])
    assert not replay(known, observer(model, sigma, 1e-2), run).frozen.any()


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300])
def test_rubbish_raises_nothing_and_makes_it_blind(watched, value):
    name, limits = watched
    make, swing, sigma, _ = MACHINES[name]
    run = recording(make, swing, sigma, 300, 15)
    run.y[100:] = value
    with np.errstate(all="ignore"):
        found = trace_of(name, limits, run)
    assert found.validity[[0, 99]].tolist() == [Validity.WARM_UP, Validity.VALID]
    if not np.isfinite(value):
        assert (found.validity[100:] != Validity.VALID).all()
    assert found.alarm[-1]


def test_the_violation_of_a_mechanical_machine_is_its_power():
    """M v (a - a_model): for a mass of 2 kg at 3 m/s that is 0.5 m/s^2 quicker than its model, 3 W."""
    x, u, q, rate = ca.MX.sym("x", 2), ca.MX.sym("u"), Signal("q", "m"), ca.MX.sym("rate", 2)
    rates = ca.vertcat(x[1], u / 2.0)
    cart = HybridModel.of(
        "cart", 0.01, (q, Signal("v", "m/s")), (Signal("F", "N"),), (q,), x=x, u=u, x_next=x + 0.01 * rates,
        xdot=rates, y=x[0], rate=rate, energy=(2.0 * rate[1] - u) * x[1],
    )  # fmt: skip
    monitor = Monitor(ResidualReadings(cart))
    named = [(channel.name, channel.unit) for channel in monitor.readings.channels]
    assert named == [("q", "m"), ("energy", "W"), ("free run of q", "m")]
    state, none = monitor.initial(), np.zeros(0)
    for now in ([1.0, 3.0], [1.03, 3.005]):
        estimate = SimpleNamespace(x=np.array(now), h=none, w=none)
        state, reading = monitor.update(state, np.array(now[:1]), np.zeros(1), estimate)
    np.testing.assert_allclose(reading.values[:2], [0.0, 3.0], atol=1e-12)


def test_what_does_not_fit_is_refused():
    model = two_tanks()
    make, swing, sigma, step = MACHINES["motor"]
    limits = learn_limits(
        ResidualReadings(dc_motor()),
        observer(dc_motor(), sigma, step),
        [recording(make, swing, sigma, 1500, 0)],
        false_alarms_per_hour=1.0,
    )
    assert "1.5 x the highest nominal level" in limits.method  # for one an hour 3.5 s are too short
    with pytest.raises(
        InputError,
        match=r"residuals.*HM-WATCH-006",
    ):
        Monitor(ResidualReadings(model), limits)
    with pytest.raises(InputError, match="HM-WATCH-031"):
        Monitor(ResidualReadings(model), resolution=[0.0])
    short = recording(make, swing, sigma, 20, 0)
    with pytest.raises(InputError, match="HM-WATCH-018"):
        learn_limits(ResidualReadings(dc_motor()), observer(dc_motor(), sigma, step), [short])
    trace = replay(Monitor(ResidualReadings(dc_motor()), limits), observer(dc_motor(), sigma, step), short)
    assert trace.levels.shape == (20, 8)
