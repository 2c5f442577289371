"""Terms beside a prior: each vanishes at zero, acts as its formula says, and keeps the balances."""

import casadi as ca
import numpy as np
import pytest
import torch
from energy_checks import check_balances, random_points, rates

from hybrid_mpc import InputError, MechanicalPrior, Parameter, Prior, PriorStep, Signal, trace_model
from hybrid_mpc.machine import terms
from hybrid_mpc.machine.prior import Balance
from hybrid_mpc.machine.terms import Term, extended
from nn_export import build
from scenarios.pendulum.prior import PendulumPrior


class Arm(MechanicalPrior):
    states = (
        *(Signal(q, "rad", periodic=True) for q in ("q1", "q2")),
        *(Signal(v, "rad/s") for v in ("v1", "v2")),
    )
    inputs = (Signal("t1", "N m"), Signal("t2", "N m"))
    outputs = states[:2]
    parameters = (Parameter("J", 0.5, "kg m^2", 0.1, 1.0),)

    def mass_matrix(self, q, p):
        return (p.J + 0.2 + 0.1 * ca.cos(q.q2), 0.1 + 0.05 * ca.cos(q.q2)), (0.1 + 0.05 * ca.cos(q.q2), 0.2)

    def potential(self, q, p):
        return -2.0 * ca.cos(q.q1) - 0.5 * ca.cos(q.q1 + q.q2)


class Tank(Prior):
    states = (Signal("level", "m", 0.0, 2.0), Signal("heat", "degC"))
    inputs = (Signal("inflow", "m^3/s"),)
    outputs = states
    disturbances = (Signal("room", "degC"),)
    parameters = (Parameter("k", 0.1, "m^0.5/s", 0.0, 1.0),)

    def xdot(self, x, u, w, p):
        return u.inflow - p.k * ca.sqrt(x.level), 0.01 * (w.room - x.heat)

    def balances(self, x, u, w, p):
        return (Balance("volume", x.level, u.inflow, p.k * ca.sqrt(x.level), "m", "m/s"),)


def p(name, value=0.0, unit="N m", low=-10.0, high=10.0):
    return Parameter(name, value, unit, low, high)


def arm_terms(value):
    """A term of each law of an axis, with this weight."""
    one, two = p("a", value), p("b", value)

    def of(unit):
        return p("a", value, unit)

    return {
        "coulomb": terms.coulomb("v1", one, width=0.2),
        "asymmetric": terms.asymmetric("v1", one, width=0.2),
        "viscous": terms.viscous("v1", of("N m s/rad")),
        "viscous by direction": terms.viscous_by_direction("v1", of("N m s/rad")),
        "quadratic": terms.quadratic("v1", of("N m s^2/rad^2")),
        "stribeck": terms.stribeck("v2", one, speed=0.5, width=0.2),
        "loaded by motor": terms.loaded("v1", of("-"), load="driven", width=0.2),
        "loaded by both": terms.loaded("v2", of("-"), load="both", width=0.2),
        "by position": terms.coulomb_by_position("v1", one, two, width=0.2, turning=True),
        "offset": terms.offset("v1", one),
        "gravity": terms.gravity_error("v1", one, two),
        "cogging": terms.cogging("v2", one, two, periods=4.0),
        "spring": terms.spring("v1", of("N m/rad"), centre=0.1),
        "end": terms.elastic_end("v1", of("N m/rad"), edge=-0.2, upper=True),
        "inertia": terms.inertia("v2", of("kg m^2")),
        "gain": terms.input_gain("t1", of("-")),
        "input offset": terms.input_offset("t1", one),
        "by direction": terms.gain_by_direction("t2", of("-")),
        "input curve": terms.input_curve("t1", of("-"), centre=0.0, span=1.0),
        "saturation": terms.saturation("t1", of("1/N^2 m^2")),
        "dead zone": terms.dead_zone("t1", one, width=0.1),
        "sensor gain": terms.output_gain("q1", of("-")),
        "sensor offset": terms.output_offset("q1", of("rad")),
        "sensor curve": terms.output_curve("q2", of("1/rad"), lower=-1.0, upper=1.0),
    }


X, U = np.array([0.4, -0.3, 1.2, -0.7]), np.array([0.8, -0.5])


@pytest.mark.parametrize("name", arm_terms(0.0))
def test_a_term_vanishes_at_zero_and_acts_elsewhere(name):
    plain = Arm()
    for value, acts in ((0.0, False), (0.3, True)):
        made = extended(Arm, arm_terms(value)[name])()
        off = [
            np.abs((of_made(X, U, [], made.p) - of_plain(X, U, [], plain.p)).full()).max()
            for of_made, of_plain in (
                (made.equations.xdot, plain.equations.xdot), (made.equations.output, plain.equations.output),
            )
        ]  # fmt: skip
        assert (max(off) > 1e-3) == acts


@pytest.mark.parametrize("width", [1e-3, 0.1535, 2.0])
@pytest.mark.parametrize("d", [0.0, 1e-3, 0.2527, 3.0])
def test_a_dead_zone_never_reverses_its_input(d, width):
    """Also where the zone is wider than the bend at its ends."""
    made = extended(Arm, terms.dead_zone("t1", p("z", d, low=0.0), width=width))()
    u = ca.SX.sym("u", 2)
    equations = made.equations.xdot([0.0] * 4, u, [], made.p)
    plain = Arm()
    acting = ca.Function("acting", [u], [plain.masses([0.0, 0.0], plain.p)[0, :] @ equations[2:]])
    grid = np.concatenate([np.linspace(-5.0, 5.0, 2001), 1e4 * np.array([-1.0, 1.0])])
    at = np.stack([grid, np.zeros_like(grid)])
    value = acting.map(len(grid))(at).full().ravel()
    slope = ca.Function("slope", [u], [ca.gradient(acting(u), u)[0]]).map(len(grid))(at).full().ravel()
    assert slope.min() >= -1e-12
    assert slope.max() <= 1.0 + 1e-12
    np.testing.assert_allclose(value[-2:], np.sign(grid[-2:]) * (1e4 - d), rtol=0, atol=1e-3)
    assert acting([0.0, 0.0]) == pytest.approx(0.0, abs=1e-12)
    if d == 0.0:
        np.testing.assert_allclose(value, grid, rtol=1e-12)


@pytest.mark.parametrize("name", arm_terms(0.0))
def test_the_energy_balance_holds_with_a_term(name):
    """What is stored changes by what is supplied less what is lost, along a fine integration; no friction supplies."""
    made = extended(Arm, arm_terms(0.3)[name])()
    (energy,) = made.equations.balances
    f, x, h = made.equations.xdot, ca.DM(X), 1e-3
    stored, through = energy.storage(x, made.p), 0.0
    for _ in range(300):
        rates = [energy.supply(x, U, [], made.p) - energy.loss(x, U, [], made.p)]
        k1 = f(x, U, [], made.p)
        k2 = f(x + 0.5 * h * k1, U, [], made.p)
        k3 = f(x + 0.5 * h * k2, U, [], made.p)
        middle, x = x + 0.5 * h * k2, x + h / 6 * (k1 + 2 * k2 + 2 * k3 + f(x + h * k3, U, [], made.p))
        rates += [energy.supply(at, U, [], made.p) - energy.loss(at, U, [], made.p) for at in (middle, x)]
        through = through + h / 6 * (rates[0] + 4 * rates[1] + rates[2])
        if name in ("coulomb", "viscous", "quadratic", "stribeck", "loaded by motor", "loaded by both"):
            assert float(energy.loss(x, U, [], made.p)) >= 0.0
    assert float(energy.storage(x, made.p) - stored) == pytest.approx(float(through), abs=1e-5)


def test_a_lag_has_a_state_of_its_own_that_starts_where_its_signal_is():
    tau = p("tau", 0.1, "s", 0.01, 1.0)
    lag = terms.input_lag("t1", tau, state=Signal("t1_acting", "N m"))
    shown = terms.output_lag("q1", p("tau_s", 0.2, "s", 0.01, 1.0), state=Signal("q1_shown", "rad"))
    made = extended(Arm, lag, shown)()
    assert [s.name for s in made.states][4:] == ["t1_acting", "q1_shown"]
    x = np.concatenate([X, [0.3, 0.1]])
    rates, y = (getattr(made.equations, f)(x, U, [], made.p).full().ravel() for f in ("xdot", "output"))
    wanted = Arm().equations.xdot(X, [0.3, U[1]], [], Arm().p).full().ravel()
    np.testing.assert_allclose(rates, [*wanted, (0.8 - 0.3) / 0.1, (0.4 - 0.1) / 0.2], rtol=1e-12)
    np.testing.assert_allclose(y, [0.1, -0.3], rtol=1e-12)


def test_terms_of_processes_add_to_rates_and_balances():
    made = extended(
        Tank,
        terms.overflow("level", p("s", 0.5, "1/s"), p("edge", 0.8, "m"), width=1e-6),
        terms.loss("heat", p("h", 0.02, "1/s"), p("n", 1.25, "-"), scale=5.0, reference="room"),
        terms.coupling("level", p("c", 0.1, "m/s/K"), source="heat", centre=20.0),
    )()
    x, u, w = [1.0, 30.0], [0.2], [20.0]
    rates = made.equations.xdot(x, u, w, made.p).full().ravel()
    np.testing.assert_allclose(
        rates, [0.2 - 0.1 - 0.5 * 0.2 + 0.1 * 10.0, -0.1 - 0.02 * 10.0 * 2.0**0.25], rtol=1e-5
    )
    (volume,) = made.equations.balances
    assert float(volume.loss(x, u, w, made.p)) == pytest.approx(0.1 + 0.5 * 0.2, rel=1e-5)
    assert float(volume.supply(x, u, w, made.p)) == pytest.approx(0.2 + 0.1 * 10.0)


@pytest.mark.parametrize(
    ("kelvin", "text"), [(273.15, "(heat + 273.15)^4 - 292.25^4"), (0.0, "heat^4 - 19.1^4")]
)
def test_the_formula_of_radiation_is_in_kelvin_and_has_its_value(kelvin, text):
    radiation = terms.radiation("heat", p("e", 0.02, "degC/s 1e8/K^4"), kelvin=kelvin, surroundings=19.1)
    assert text in radiation.text
    rate = extended(Tank, radiation)().equations.xdot([1.0, 80.0], [0.1], [20.0], [0.1, 0.02])[1]
    value = eval(radiation.text.replace("-e", "-0.02 *").replace("^", "**"), {"heat": 80.0})
    assert float(rate) == pytest.approx(0.01 * (20.0 - 80.0) + value, rel=1e-6)


def test_an_own_term_takes_a_few_lines():
    leak = Term("leak", "rate", "level", (p("leak", 0.25, "1/s"),), lambda at, p: -p.leak * at.own, loss=True)
    made = extended(Tank, leak)()
    assert float(made.equations.xdot([1.0, 20.0], [0.0], [20.0], made.p)[0]) == pytest.approx(-0.1 - 0.25)


def test_what_does_not_fit_is_refused_all_at_once():
    with pytest.raises(InputError) as refused:
        extended(
            Tank, terms.coulomb("level", p("k"), width=0.1), terms.viscous("speed", p("d"), place="rate"),
            terms.output_gain("flow", p("g")),
        )  # fmt: skip
    assert len(refused.value.problems) == 4  # no mechanical prior, no such state, no such output, k twice


def test_the_call_that_makes_a_term_makes_it_again():
    for term in arm_terms(0.25).values():
        again = eval(term.code, {"terms": terms, "Parameter": Parameter})
        assert (again, again.code) == (term, term.code)
    assert "width=0.2)" in terms.coulomb("v1", p("F"), width=np.float64(0.2)).code  # a file has no numpy


def test_friction_torques_are_the_hand_written_formulas_and_only_take_energy():
    """On a prior in torch, whose own parameters a load is a function of."""
    bearing = Term(
        "bearing", "force", "phi_dot",
        (Parameter("rho", 0.02, "m", 0.0, 0.05), Parameter("gamma", 20.0, "s/rad", 1.0, 50.0)),
        lambda at, p: -p.rho * ca.tanh(p.gamma * at.own)
        * ca.fabs(at.p.m * at.own**2 * at.p.l + at.p.m * at.p.g * ca.cos(at.x.phi)),
        loss=True,
    )  # fmt: skip
    made = extended(
        PendulumPrior, terms.viscous("phi_dot", p("d_2", 0.3, "N m s/rad")),
        terms.stribeck("phi_dot", p("F_s", 0.3), speed=0.2, width=0.05), bearing,
    )  # fmt: skip
    prior, free = made(), PendulumPrior()
    x, u, _ = random_points(prior, np.random.default_rng(0), 50)
    x[:25, 1] *= 0.02  # near rest, where friction bends
    phi, v = x.T
    load = np.abs(50.0 * v * v * 0.05 + 50.0 * 9.81 * np.cos(phi))
    wanted = 0.3 * v + 0.3 * np.exp(-((v / 0.2) ** 2)) * np.tanh(20 * v) + 0.02 * np.tanh(20 * v) * load
    lost = (rates(free, x, u) - rates(prior, x, u))[:, 1] * 50.0 * 0.05**2
    np.testing.assert_allclose(lost, wanted, rtol=0, atol=1e-11)
    assert (lost * v > 0).all()
    check_balances(prior)
    step = PriorStep(prior, 0.01)
    f = build(trace_model(step)["step"])
    x, u, h = (torch.tensor(values, dtype=torch.float64) for values in ([0.4, -0.7], [3.0], []))
    found = f(x.numpy(), [], u.numpy(), [], prior.p)[0].full().ravel()
    np.testing.assert_allclose(found, step(x, h, u, h)[0], rtol=0, atol=1e-12)


def test_terms_act_on_their_own_axis():
    made = extended(Arm, terms.viscous("v2", p("d", 0.3, "N m s/rad")))()
    x = np.concatenate([X[:2], [0.0, 2.0]])
    change = (made.equations.xdot(x, U, [], made.p) - Arm().equations.xdot(x, U, [], Arm().p)).full().ravel()
    mass = Arm().masses(X[:2], Arm().p).full()
    np.testing.assert_allclose(mass @ change[2:], [0.0, -0.6], atol=1e-12)


def test_a_prior_with_terms_takes_further_ones():
    """Also forces: what it stands on is the mechanical prior."""
    drag = terms.quadratic("v1", p("c", 0.1, "N m s^2/rad^2"))
    dry = terms.coulomb("v1", p("F", 0.3), width=0.1)
    assert extended(extended(Arm, drag), dry) is extended(Arm, drag, dry)


def test_a_second_capacity_and_a_lag_of_a_disturbance_have_states():
    made = extended(
        Tank,
        terms.storage("heat", p("k_s", 0.5, "1/s"), p("tau", 10.0, "s", 1.0, 100.0), state=Signal("wall", "degC")),
        terms.disturbance_lag("room", p("late", 5.0, "s", 1.0, 10.0), state=Signal("room_acting", "degC")),
    )()  # fmt: skip
    rates_of = made.equations.xdot([1.0, 30.0, 25.0, 18.0], [0.1], [20.0], made.p).full().ravel()
    np.testing.assert_allclose(rates_of, [0.0, 0.01 * (18.0 - 30.0) - 2.5, 0.5, 0.4], atol=1e-12)


def test_a_delay_answers_with_its_mean_later():
    """The integral of what a step of the input lacks is the delay."""
    made = extended(
        Tank, terms.input_delay("inflow", p("late", 2.0, "s", 0.1, 5.0), state=Signal("s", "m^3/s"))
    )()
    area, s, h = 0.0, 0.0, 1e-3
    for _ in range(20000):
        x = [1.0, 20.0, s]
        acting = float(made.equations.xdot(x, [1.0], [20.0], made.p)[0]) + 0.1
        area += (1.0 - acting) * h
        s += h * float(made.equations.xdot(x, [1.0], [20.0], made.p)[2])
    assert area == pytest.approx(2.0, rel=2e-3)


@pytest.mark.parametrize(
    "term",
    [
        terms.viscous("v1", p("d", 0.1, "N m")),
        terms.coulomb("v1", p("F", 0.1, "N"), width=1.0),
        terms.output_offset("q1", p("o", 0.1, "m")),
        Term("own", "force", "v1", (p("k", 0.1, "N m"),), lambda at, q: -q.k * at.own),
        Term("own", "potential", "v1", (p("k", 0.1, "J"),), lambda at, q: q.k * ca.cos(at.own / 0.3)),
    ],
)
def test_units_that_do_not_fit_and_a_potential_of_a_speed_are_refused(term):
    with pytest.raises(InputError):
        extended(Arm, term)
