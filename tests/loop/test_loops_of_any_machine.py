"""Closed loops of machines that are no pendulum: no offset; what is measured is known ahead; safe is what is said."""

from dataclasses import replace

import numpy as np
import pytest
from closed_loop_parts import FakeClock, ScriptedMonitor
from machines import AMBIENT, HEAT, INFLOW, PUMP, MachinePlant, dc_motor, observer, thermal, two_tanks

from hybrid_mpc import (
    OCP,
    CondensedController,
    DelayCompensation,
    Disturbance,
    ExtendedKalmanFilter,
    Fault,
    Guard,
    InputError,
    Loop,
    Mode,
    Runner,
    SafeController,
    Signal,
    offset_free,
    simulate,
    with_input_delay,
)

TANKS = OCP(15, [0.0, 0.0], [1e4], [1e5], [0.0], [4e-4], q_y=[1.0])
HEATERS = OCP(12, [0.0] * 2, [0.1] * 2, [0.1] * 2, [0.0] * 2, [20.0] * 2, q_y=[1.0, 1.0])
MOTOR = OCP(15, [0.0, 0.0], [0.01], [0.01], [-12.0], [12.0], q_y=[0.0, 1.0])


def closed(model, ocp, estimator, plant, reference, duration, **options):
    safe = SafeController(CondensedController(model, ocp), model, safe_input=ocp.u_min)
    options = {"x0": model.x0, "seed": 0, **options}
    result = simulate(plant, estimator, safe, reference, dt=model.dt, duration=duration, **options)
    assert np.all((result.u >= ocp.u_min) & (result.u <= ocp.u_max))
    return result


def test_the_loop_starts_at_the_operating_point_and_stays():
    for model, ocp in ((two_tanks(dt=10.0), TANKS), (thermal(), HEATERS), (dc_motor(), MOTOR)):
        estimator = observer(model, None)
        result = closed(model, ocp, estimator, MachinePlant(model), None, 15 * model.dt)
        np.testing.assert_allclose(result.u, np.tile(model.u0, (15, 1)), rtol=1e-6)
        np.testing.assert_allclose(result.x, np.tile(model.x0, (15, 1)), rtol=1e-6)
        assert np.all(result.reached)


@pytest.mark.parametrize("place", ["input", "rate", "output"])
def test_a_constant_disturbance_leaves_no_offset_in_the_lower_tank(place):
    """Load, leak or a model that is wrong: with each disturbance model the level comes to the set-point."""
    chosen = {
        "input": (Disturbance("input", "pump"),), "rate": (Disturbance("rate", "lower", 1e-3),),
        "output": (Disturbance("output", "lower", 0.1),),
    }[place]  # fmt: skip
    model = two_tanks(dt=10.0, disturbance_model=chosen)
    assert offset_free(model).promised
    step = {"input": [5e-6], "rate": [2e-5], "output": [2e-3]}[place]
    plant = MachinePlant(two_tanks(dt=10.0), load=3e-5, leak=-1e-4)
    result = closed(model, TANKS, observer(model, step), plant, [0.25], 2000.0)
    np.testing.assert_allclose(result.y[-20:], 0.25, atol=1e-5)
    without = closed(model, TANKS, observer(model, None), plant, [0.25], 800.0)
    assert np.abs(without.y[-1, 0] - 0.25) > 1e-3


def test_the_motor_holds_its_speed_though_it_measures_two_outputs():
    model = dc_motor(
        disturbance_model=(Disturbance("rate", "speed", 100.0), Disturbance("rate", "current", 100.0))
    )
    assert offset_free(model, [1]).promised
    assert "1 disturbances for 2 outputs" in offset_free(dc_motor(), [1]).why
    plant = MachinePlant(dc_motor(), load=-0.5, leak=-20.0)
    result = closed(model, MOTOR, observer(model, [1.0, 1.0]), plant, [np.nan, 25.0], 1.0)
    np.testing.assert_allclose(result.x[-20:, 1], 25.0, atol=1e-4)


def test_a_set_point_beyond_reach_is_reported_and_the_nearest_is_taken():
    model = two_tanks(dt=10.0)
    reference = lambda t: np.where(t < 200.0, 0.3, 1.5)[:, None]  # noqa: E731
    result = closed(model, TANKS, observer(model, [2e-6]), MachinePlant(model), reference, 2000.0)
    assert result.reached[0]
    assert not result.reached[-1]
    nearest = 0.68524182  # both tanks' rest at the pump's largest flow and this inflow
    np.testing.assert_allclose(result.y[-1, 0], nearest, rtol=1e-4)
    np.testing.assert_allclose(result.u[-1, 0], 4e-4, rtol=1e-4)


def test_a_set_point_outside_the_range_of_its_signal_is_refused_at_the_start_and_shown_in_the_loop():
    """20 for 0.2 m, of which the range says 0 to 2 m; an output without weight may have any reference."""
    model = replace(two_tanks(dt=10.0), outputs=(Signal("lower", "m", 0.0, 2.0),))
    parts = observer(model, [2e-6]), CondensedController(model, TANKS)
    with pytest.raises(InputError, match=r"lower = 20 m .* 0 to 2 m.*HM-LOOP-054"):
        Loop(*parts, reference=[20.0])
    loop = Loop(*parts, reference=[0.2])
    with pytest.raises(InputError, match="HM-LOOP-054"):
        loop.start([0.2], reference=[[0.2], [-1.0]])
    loop.start([0.2])
    assert loop.beyond == ""
    loop.step([0.2], reference=[[20.0]])
    assert "lower = 20 m" in loop.beyond
    assert "not 20 m; at a limit: pump" in loop.unreached
    loop.step([0.2], reference=[[0.2]])
    assert loop.unreached == ""
    result = closed(
        model, TANKS, parts[0], MachinePlant(model), lambda t: np.where(t < 50, 0.3, 20.0)[:, None], 100.0
    )
    np.testing.assert_array_equal(result.reached, result.t < 50)
    motor = dc_motor()
    Loop(observer(motor, None), CondensedController(motor, MOTOR), reference=[1e9, 1.0])


def inflow(t):
    return np.where((t >= 300.0) & (t < 600.0), 1.4e-4, INFLOW)[:, None]


def test_an_inflow_that_is_known_ahead_costs_less_than_one_that_is_held():
    model, costs = two_tanks(dt=10.0), {}
    for name, ocp in (("ahead", TANKS.changed(preview_w=True)), ("held", TANKS)):
        result = closed(model, ocp, observer(model, None), MachinePlant(model), [0.3], 1000.0, w=inflow)
        np.testing.assert_array_equal(result.w, inflow(result.t))
        costs[name] = result.cost
        early = result.u[25:30, 0]  # up to 50 s before it comes
        assert (np.min(early) < 0.9 * result.u[10, 0]) == (name == "ahead")
    unseen = ExtendedKalmanFilter(model, sigma_y=[1e-3], sigma_x=[1e-4] * 2, sigma_x0=[0.1] * 2)
    unseen_loop = Loop(unseen, CondensedController(model, TANKS), reference=[0.3])
    blind = drive(model, unseen_loop, lambda t: None)
    assert costs["ahead"] < 0.9 * costs["held"]
    assert costs["held"] < 0.9 * blind


def drive(model, loop, seen):
    """The cost of a loop by hand in which ``seen`` says what is measured of the inflow."""
    x, total, u = model.x0, 0.0, None
    for k in range(100):
        w = inflow(np.array([10.0 * k]))[0]
        before = model.u0 if u is None else u
        u = loop.start([x[1]], seen(10.0 * k)) if k == 0 else loop.step([x[1]], seen(10.0 * k))
        steady = loop.decision.solution.steady
        total += 10.0 * float(
            (x[1] - 0.3) ** 2 + 1e4 * np.sum((u - steady.u) ** 2) + 1e5 * np.sum((u - before) ** 2)
        )
        x = model.step(x, [], u, w, model.p)[0].full().ravel()
    return total


@pytest.mark.full
def test_a_loop_by_hand_is_the_simulated_one_and_lost_samples_of_the_inflow_are_held():
    model = two_tanks(dt=10.0)

    def loop(ocp=TANKS, **options):
        return Loop(observer(model, None), CondensedController(model, ocp), reference=[0.3], **options)

    measured = drive(model, loop(), lambda t: inflow(np.array([t]))[0])
    wanted = closed(model, TANKS, observer(model, None), MachinePlant(model), [0.3], 1000.0, w=inflow).cost
    assert measured == pytest.approx(wanted, rel=1e-6)
    sparse = drive(model, loop(), lambda t: inflow(np.array([t]))[0] if round(t / 10) % 3 == 0 else [np.nan])
    assert sparse == pytest.approx(measured, rel=1e-9)  # it changes where a sample comes
    ahead = [drive(model, one, seen) for one, seen in (
        (loop(TANKS.changed(preview_w=True), w=inflow), lambda t: inflow(np.array([t]))[0]),
        (loop(), lambda t: inflow(t + 10.0 * np.arange(15))),
    )]  # fmt: skip
    assert ahead[0] == pytest.approx(ahead[1], rel=1e-9)
    with pytest.raises(InputError, match="measured disturbances"):
        loop().start([0.3], [1e-5, 1e-5])
    with pytest.raises(InputError, match="HM-LOOP-032"):
        Loop(observer(thermal(), None), CondensedController(thermal(), HEATERS), w=inflow)


def test_delays_of_the_input_keep_the_operating_point():
    model = with_input_delay(two_tanks(dt=10.0), 24.0)
    estimator = observer(model, [2e-6])
    np.testing.assert_allclose(estimator.start([model.x0[1]]).h, PUMP)
    plant = MachinePlant(two_tanks(dt=10.0), load=2e-5)

    class Late:
        """The tanks behind the delay of the model."""

        def __getattr__(self, name):
            return getattr(plant, name)

        def reset(self, x0, seed):
            return (np.asarray(x0), [np.array([PUMP])] * 3)

        def step(self, state, u, dt, w):
            x, queue = state
            acting = 0.6 * queue[-2] + 0.4 * queue[-3]
            return plant.step(x, acting, dt, w), [*queue[1:], u]

        def measure(self, state, rng):
            return plant.measure(state[0], rng)

        def truth(self, state):
            return state[0]

    safe = SafeController(CondensedController(model, TANKS), model, safe_input=[0.0])
    result = simulate(Late(), estimator, safe, [0.3], dt=10.0, duration=2000.0, x0=model.x0, seed=0)
    np.testing.assert_allclose(result.y[-10:], 0.3, atol=1e-5)


def test_delays_of_the_loop_hold_the_operating_points_input():
    model = two_tanks(dt=10.0)
    estimator = DelayCompensation(observer(model, [2e-6]), sensor_delay=1, input_delay=2)
    start = estimator.start([model.x0[1]])
    np.testing.assert_allclose(start.x, model.x0, rtol=1e-9)
    result = closed(
        model,
        TANKS,
        estimator,
        MachinePlant(model, load=2e-5),
        [0.3],
        2000.0,
        sensor_delay=1,
        input_delay=2,
        w=inflow,
    )
    np.testing.assert_allclose(result.y[-10:], 0.3, atol=1e-5)


def test_a_frozen_sensor_leaves_the_declared_safe_input():
    model = thermal()
    estimator, monitor = observer(model, [0.1, 0.1]), ScriptedMonitor(frozen=[(20, 40)])
    bare = CondensedController(model, HEATERS)
    with pytest.raises(InputError, match="HM-LOOP-015"):
        Loop(estimator, SafeController(bare), monitor=monitor, guard=Guard(Mode.NORMAL))
    safe = SafeController(bare, model, safe_input=[1.0, 0.5])
    guard = Guard(Mode.NORMAL, dwell=10.0, quiet=20.0)
    result = simulate(MachinePlant(model), estimator, safe, None, dt=10.0, duration=700.0, x0=model.x0, seed=0,
                      monitor=monitor, guard=guard)  # fmt: skip
    rest = np.array([name == "REST" for name in result.mode])
    assert rest.sum() >= 20
    np.testing.assert_array_equal(result.u[rest], np.tile([1.0, 0.5], (rest.sum(), 1)))
    assert {result.source[k] for k in np.flatnonzero(rest)} == {"SAFE"}
    np.testing.assert_allclose(result.x[-1], model.x0, atol=0.5)  # and back


def test_where_nothing_is_known_the_last_input_stays_and_a_run_wants_a_safe_one():
    model = thermal()
    estimator = observer(model, None)
    bare = SafeController(CondensedController(model, HEATERS), max_age=0)
    lost = Fault(100.0, 300.0, "measurement_dropout", channel="t1")
    result = simulate(MachinePlant(model), estimator, bare, lambda t: np.full((len(t), 2), np.nan), dt=10.0,
                      duration=400.0, x0=model.x0, seed=0, faults=[lost])  # fmt: skip
    assert set(result.source) == {"HELD"}
    np.testing.assert_array_equal(result.u, np.tile(HEAT, (40, 1)))
    sensor, actuator = lambda: model.x0, lambda u: None
    reference = lambda t: np.tile(model.x0, (len(t), 1))  # noqa: E731
    with pytest.raises(InputError, match="HM-LOOP-036"):
        Runner(sensor, actuator, estimator, bare, reference, clock=FakeClock())
    given = []
    Runner(sensor, given.append, estimator, bare, reference, clock=FakeClock(), safe_input=[2.0, 1.0]).run(
        50.0
    )
    np.testing.assert_array_equal(given[-1], [2.0, 1.0])
    np.testing.assert_allclose(given[:-1], [HEAT] * 5, rtol=1e-6)


def test_a_run_measures_the_inflow():
    model, x, k, levels = two_tanks(dt=10.0), [two_tanks(dt=10.0).x0], [0], []

    def measure():
        return [x[0][1]]

    def measure_w():
        k[0] += 1
        return None if k[0] % 3 == 0 else [9e-5]

    def actuate(u):
        levels.append(x[0][1])
        x[0] = model.step(x[0], [], u, [9e-5], model.p)[0].full().ravel()

    goal = lambda t: np.full((len(t), 1), 0.3)  # noqa: E731
    runner = Runner(measure, actuate, observer(model, None), CondensedController(model, TANKS), goal,
                    measure_w=measure_w, clock=FakeClock(), safe_input=[0.0])  # fmt: skip
    runner.run(1200.0)
    assert levels[-1] == pytest.approx(0.3, abs=1e-4)


def test_the_start_of_an_operator_s_input_is_bumpless():
    model = thermal()
    ocp = HEATERS.changed(du_max=[0.5, 0.5])
    loop = Loop(
        observer(model, None), CondensedController(model, ocp), reference=[AMBIENT + 40.0, AMBIENT + 30.0]
    )
    u = loop.start(model.x0, applied=[11.0, 2.0])
    assert np.all(np.abs(u - [11.0, 2.0]) <= 0.5 + 1e-12)
    with pytest.raises(InputError, match=r"applied.*HM-MODEL-019"):
        loop.start(model.x0, applied=[1.0])
