"""Estimation on machines that are no pendulum: the start, the disturbance models and their rank test."""

from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from machines import INFLOW, dc_motor, observer, thermal, two_tanks

from hybrid_mpc import (
    OCP,
    Disturbance,
    HybridModel,
    InputError,
    Signal,
    kinematics,
    make_estimator,
    offset_free,
    with_input_delay,
)
from hybrid_mpc.control.sizes import disturbance_sizes
from hybrid_mpc.estimate.offset_free import distinguishable
from hybrid_mpc.estimate.tuning import FOUND, remaining_load
from hybrid_mpc.kit.assembly import FOUND_HORIZONS, first_deviations, tuned_noise

ALL = (two_tanks, dc_motor, thermal)


def sensor(output, x0=0.0, n=1):
    """A model whose one output is a function of its states."""
    x, u = ca.SX.sym("x", n), ca.SX.sym("u")
    signals = tuple(Signal(f"x{i}", "-") for i in range(n))
    return HybridModel.of(
        "sensor", 0.1, signals, (Signal("u", "-"),), (Signal("y", "-"),), x=x, u=u, x_next=0.9 * x + u, xdot=u - x,
        y=output(x), nominal_x=[x0] * n,
    )  # fmt: skip


@pytest.mark.parametrize("machine", ALL)
def test_the_start_is_the_state_nearest_to_the_operating_point(machine):
    model = machine()
    estimator = observer(model)
    np.testing.assert_allclose(estimator.start(np.full(model.n_y, np.nan)).x, model.x0)
    rest = model.output(model.x0, model.u0, model.w, model.p).full().ravel()
    np.testing.assert_allclose(estimator.start(rest).x, model.x0, rtol=1e-12)
    moved = estimator.start(rest + 0.05)
    np.testing.assert_allclose(model.output(moved.x, model.u0, model.w, model.p).full().ravel(), rest + 0.05)


def test_what_no_output_shows_stays_at_the_operating_point():
    model = two_tanks()
    start = observer(model).start([0.4])
    np.testing.assert_allclose(start.x, [model.x0[0], 0.4])
    one = observer(dc_motor()).start([np.nan, 30.0])
    np.testing.assert_allclose(one.x, [dc_motor().x0[0], 30.0])


@pytest.mark.parametrize(
    ("output", "x0", "y", "wanted"),
    [
        (lambda x: 2.0 * ca.sin(x), 0.0, 1.0, np.pi / 6),
        (
            lambda x: 2.0 * ca.sin(x),
            np.pi,
            1.0,
            5 * np.pi / 6,
        ),  # hanging or upright: the operating point says which
        (lambda x: ca.fabs(x), 0.0, 0.3, 0.3),
        (lambda x: ca.fabs(x), -1.0, 0.3, -0.3),
        (lambda x: x**2, 0.0, 0.09, 0.3),
    ],
)
def test_a_sensor_that_several_states_fit(output, x0, y, wanted):
    estimator = observer(sensor(output, x0))
    assert estimator.start([y]).x[0] == pytest.approx(wanted, abs=1e-6)


def test_where_the_sensor_does_not_move_the_start_is_sought_beside():
    found = observer(sensor(lambda x: 2.0 * ca.sin(x), np.pi / 2)).start([1.0]).x[0]
    assert 2.0 * np.sin(found) == pytest.approx(1.0, abs=1e-9)


def test_a_sensor_that_no_state_fits_gives_what_comes_nearest():
    found = observer(sensor(lambda x: ca.sin(x)), sigma_x0=0.5).start([1.2]).x
    assert np.all(np.isfinite(found))
    assert abs(np.sin(found[0]) - 1.2) < 0.6


def test_disturbances_are_added_where_they_are_declared():
    base = two_tanks()
    chosen = (
        Disturbance("rate", "upper", 1e-3),
        Disturbance("output", "lower", 0.1),
        Disturbance("input", "pump"),
    )
    model = two_tanks(disturbance_model=chosen)
    estimator = observer(model, [1e-3, 1e-2, 1e-5])
    estimate = estimator.start(model.x0[1:])
    d = np.array([2e-4, 0.03, 1e-5])
    estimate = replace(estimate, d=d)
    ahead = estimator.predict(estimate, model.u0)
    x_next = base.step(model.x0, [], model.u0 + 1e-5, model.w, model.p)[0].full().ravel()
    x_next[0] += 5.0 * 2e-4
    np.testing.assert_allclose(ahead.x, x_next, rtol=1e-12)
    seen = estimator.correct(ahead, [x_next[1] + 0.03 + 0.01])
    np.testing.assert_allclose(seen.innovation, 0.01, rtol=1e-9)
    # the filter's Jacobian is that of differences
    for j, size in enumerate((1e-6, 1e-6, 1e-9)):
        other = estimator.predict(replace(estimate, d=d + size * np.eye(3)[j]), model.u0)
        on_u, on_x, _ = model.disturbed
        slope = (
            model.with_jacobian(estimate.x, [], model.u0 + on_u @ d, model.w, model.p)[3].full() @ on_u + on_x
        )
        np.testing.assert_allclose((other.x - ahead.x) / size, slope[:, j], rtol=1e-4, atol=1e-9)
    assert disturbance_sizes(model, OCP(5, [1, 1], [1], [1], [0.0], [4e-4])).tolist() == [1e-3, 0.1, 4e-4]


def test_measured_disturbances_are_held_between_samples():
    model = two_tanks()
    estimator = observer(model)
    estimate = estimator.start(model.x0[1:])
    assert estimate.w.tolist() == [INFLOW]
    estimate = estimator.update(estimate, [np.nan], model.u0, w=[1e-4])
    np.testing.assert_allclose(estimate.x, model.x0, rtol=1e-9)  # until now the usual inflow acted
    estimate = estimator.update(estimate, [np.nan], model.u0, w=[np.nan])
    assert estimate.w.tolist() == [1e-4]
    np.testing.assert_allclose(
        estimate.x, model.step(model.x0, [], model.u0, [1e-4], model.p)[0].full().ravel()
    )
    rows = np.array([[INFLOW], [1e-4], [1e-4]])
    along = estimator.run(np.full((3, 1), np.nan), np.tile(model.u0, (3, 1)), w=rows)
    np.testing.assert_allclose(along[-1].x, estimate.x)
    with pytest.raises(InputError, match="HM-MODEL-019"):
        estimator.run(np.zeros((3, 1)), np.tile(model.u0, (3, 1)), w=rows[:2])


def test_the_rank_test():
    tanks = offset_free(two_tanks())
    assert (tanks.promised, tanks.detectable, tanks.why) == (True, True, "")
    assert (tanks.rank, tanks.needed, tanks.target_rank, tanks.target_needed) == (3, 3, 3, 3)
    late = offset_free(with_input_delay(two_tanks(), 12.0))
    assert late.promised
    both = two_tanks(disturbance_model=(Disturbance("input", "pump"), Disturbance("output", "lower", 0.1)))
    assert "rank 3, needed 4" in offset_free(both).why
    assert not offset_free(both).detectable
    motor = offset_free(dc_motor())
    assert motor.detectable
    assert "1 disturbances for 2 outputs" in motor.why
    assert "cannot hold the controlled outputs" in motor.why  # two outputs by one voltage
    assert offset_free(thermal(), [0]).promised
    integrator = sensor(lambda x: x)
    assert offset_free(integrator).promised
    assert offset_free(thermal(), [thermal().outputs[0].name]) == offset_free(thermal(), [0])
    for unknown in ([2], ["voltage"]):
        with pytest.raises(InputError, match="HM-ESTIMATE-010"):
            offset_free(thermal(), unknown)


def test_an_observer_whose_disturbances_nobody_can_tell_is_refused():
    machine = SimpleNamespace(name="tanks", sensor_sigma=(1e-3,), first_sigma=(0.05,), control=None)
    ocp = OCP(5, [1, 1], [1], [1], [0.0], [4e-4])
    assert make_estimator(two_tanks(), machine, np.array([1e-4, 1e-4]), ocp).model.n_d == 1
    both = two_tanks(disturbance_model=(Disturbance("input", "pump"), Disturbance("output", "lower", 0.1)))
    with pytest.raises(InputError, match="HM-KIT-012") as declared:
        make_estimator(both, machine, np.array([1e-4, 1e-4]), ocp)
    assert "operating_point" not in str(declared.value)
    nowhere = replace(both, nominal_x=(), nominal_u=())
    with pytest.raises(InputError, match=r"operating_point = .*HM-KIT-012"):
        make_estimator(nowhere, machine, np.array([1e-4, 1e-4]), ocp)
    make_estimator(both, machine, np.array([1e-4, 1e-4]), ocp, observer=False)


@pytest.mark.parametrize(
    ("chosen", "words"),
    [
        (lambda: Disturbance("rate", "level"), "HM-MODEL-004"),
        (lambda: Disturbance("sensor", "level", 1.0), "HM-RECORDS-006"),
        (lambda: two_tanks(disturbance_model=(Disturbance("rate", "middle", 1.0),)), r"state.*'middle'.*HM-MODEL-007"),
        (lambda: two_tanks(disturbance_model=(Disturbance("input", "pump"),) * 2), "HM-MODEL-006"),
        (lambda: two_tanks(disturbance_model=(Disturbance("output", "upper", 1.0),)), r"output.*'upper'.*HM-MODEL-007"),
    ],
)  # fmt: skip
def test_disturbances_that_are_none_are_refused(chosen, words):
    with pytest.raises(InputError, match=words):
        chosen()


def test_speeds_are_told_by_the_equations():
    x, u = ca.SX.sym("x", 3), ca.SX.sym("u")
    names = (Signal("current", "A"), Signal("angle", "rad"), Signal("speed", "rad/s"))
    rates = ca.vertcat(u - x[0] - x[2], x[2], 3 * x[0])
    drive = HybridModel.of("drive", 0.01, names, (Signal("u", "V"),), names[1:2], x=x, u=u, x_next=x + 0.01 * rates,
                           xdot=rates, y=x[1])  # fmt: skip
    assert kinematics(drive) == {1: 2}
    assert all(kinematics(machine()) == {} for machine in ALL)
    machine = SimpleNamespace(sensor_sigma=(1e-3,), first_sigma=None)
    with pytest.raises(InputError, match=r"current.*HM-KIT-016"):
        first_deviations(drive, machine)
    found = first_deviations(drive, SimpleNamespace(sensor_sigma=(1e-3,), first_sigma=(2.0, 3.0)))
    assert found.tolist() == [2.0, 1e-3, 3.0]


def test_the_first_deviations_belong_to_the_states_that_sensors_show():
    given = SimpleNamespace(sensor_sigma=(2e-3,), first_sigma=None)
    np.testing.assert_allclose(first_deviations(two_tanks(), given), [2.0 / np.sqrt(12), 2e-3])
    given = SimpleNamespace(sensor_sigma=(0.1, 0.5), first_sigma=None)
    assert first_deviations(dc_motor(), given).tolist() == [0.1, 0.5]
    scaled = sensor(lambda x: 4.0 * x[1], n=2)
    found = first_deviations(scaled, SimpleNamespace(sensor_sigma=(0.2,), first_sigma=(9.0,)))
    assert found.tolist() == [9.0, 0.05]
    with pytest.raises(InputError, match=r"x0.*HM-KIT-015"):
        first_deviations(scaled, SimpleNamespace(sensor_sigma=(0.2,), first_sigma=(9.0, 9.0)))


def test_a_load_that_a_bristle_takes_up_at_rest_is_told_in_motion():
    """LuGre's bristle: at rest the load and its bend are one, in motion the bend fades."""
    x, u = ca.SX.sym("x", 3), ca.SX.sym("u")
    bend = x[1] - 100.0 * ca.fabs(x[1]) * x[2]
    rates = ca.vertcat(x[1], u - 50.0 * x[2] - 0.5 * bend - 0.1 * x[1], bend)
    states = Signal("q", "m", -1.0, 1.0), Signal("v", "m/s", -1.0, 1.0), Signal("bend", "m", -0.02, 0.02)
    model = HybridModel.of(
        "bristle", 0.01, states, (Signal("force", "N"),), states[:1], x=x, u=u, x_next=x + 0.01 * rates, xdot=rates,
        y=x[0],
    )  # fmt: skip
    assert not offset_free(model).detectable
    assert distinguishable(model).detectable
    twice = replace(model, disturbance_model=(Disturbance("input", "force"), Disturbance("output", "q", 0.1)))
    assert not distinguishable(twice).detectable  # two loads and one output: nowhere


NOISY = SimpleNamespace(
    name="lag", sensor_sigma=(0.01,), first_sigma=None, control=OCP(20, [1], [0], [1], [-1], [1])
)


def lag(spread=()):
    """A lag with a gain of 1 from its input."""
    x, u = ca.SX.sym("x"), ca.SX.sym("u")
    nxt = 0.9 * x + 0.1 * u
    model = HybridModel.of(
        "lag", 0.1, (Signal("x", "m"),), (Signal("u", "m"),), (Signal("y", "m"),), x=x, u=u, x_next=nxt,
        xdot=(nxt - x) / 0.1, y=x,
    )  # fmt: skip
    return replace(model, state_spread=spread)


@pytest.mark.parametrize("noise", [0.002, 0.02])
def test_no_filter_explains_a_load_that_lasts_by_noise(noise):
    """Of the three only the quiet filter found a load in time: the observer went on in the slip filter, and a load that
    a horizon's time should show took ten."""
    model, load = lag(), 0.4
    estimator = make_estimator(model, NOISY, np.array([noise]))
    periods = round(FOUND_HORIZONS * NOISY.control.horizon)
    for one in estimator.filters[:3]:  # the filter of outliers is followed by another one in the next period
        assert remaining_load(one, periods)[0] <= FOUND
    rng, x = np.random.default_rng(0), 0.0
    estimate = estimator.start([0.0])
    for _ in range(3 * periods):
        x = 0.9 * x + 0.1 * load
        estimate = estimator.update(estimate, [x + 0.01 * rng.standard_normal()], [0.0])
    assert estimate.d[0] == pytest.approx(load, abs=load / 4)


@pytest.mark.parametrize("size", [0.3, -1.0, 1e4])
def test_an_outlier_is_no_load(size):
    """A sample that is off by 30, 100 or a million standard deviations, at rest."""
    estimator = make_estimator(lag(), NOISY, np.array([0.002]))
    estimate = estimator.start([0.0])
    for k in range(60):
        estimate = estimator.update(estimate, [size if k == 50 else 0.0], [0.0])
        assert abs(estimate.d[0]) < 0.03  # a jump filter alone: more than 0.3
        assert abs(estimate.x[0]) < 0.01


@pytest.mark.parametrize("noise", [1e3, 1e9, 7e16])
def test_an_observer_that_never_finds_a_load_is_refused(noise):
    with pytest.raises(InputError, match=r"the input u.*HM-KIT-013"):
        make_estimator(lag(), NOISY, np.array([noise]))
    assert make_estimator(lag(), NOISY, np.array([noise]), observer=False).model.name == "lag"


def test_a_state_without_noise_that_stays_hides_no_load():
    """The covariance of a constant that nothing moves does not settle."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    nxt = ca.vertcat(0.9 * x[0] + 0.1 * u + 0.1 * x[1], x[1])
    pair = (Signal("x", "m", -1.0, 1.0), Signal("still", "m", -1.0, 1.0))
    model = HybridModel.of(
        "still", 0.1, pair, (Signal("u", "m"),), (*pair, ), x=x, u=u, x_next=nxt, xdot=(nxt - x) / 0.1, y=x,
    )  # fmt: skip
    scenario = SimpleNamespace(
        name="still", sensor_sigma=(0.01, 0.01), first_sigma=None,
        control=OCP(20, [1, 0], [0], [1], [-1], [1]),
    )  # fmt: skip
    estimator = make_estimator(model, scenario, np.array([0.002, 0.0]))
    assert np.isnan(remaining_load(estimator.filters[0], 100)).all()


def test_tuned_noise_stays_within_the_spread_of_the_states():
    rng, n = np.random.default_rng(0), 200
    y = rng.standard_normal((n, 1))
    still = SimpleNamespace(u=np.zeros((n, 1)), y=y, w=np.zeros((n, 0)), name="still")
    still.part = lambda rows, name, role: still
    assert tuned_noise(lag((0.3,)), NOISY, np.array([50.0]), [still], observer=True)[0] == 0.3
    assert tuned_noise(lag((0.0,)), NOISY, np.array([0.5]), [still], observer=True)[0] >= 0.5
    known = tuned_noise(lag((0.3,)), NOISY, np.array([50.0]), [still], observer=True, known={"x": 0.9})
    assert known[0] == 0.9
