"""What a prior is made of: equations in CasADi and in torch, mechanical ones by their parts, and what is refused."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import torch
from energy_checks import check_balances, random_points, random_values, rates
from example_priors import PAIRS, Arm, Swing, Tanks, TorchArm, TorchSwing, TorchTanks

from hybrid_mpc import (
    Balance,
    InputError,
    MechanicalPrior,
    Parameter,
    Prior,
    Signal,
    Term,
    TorchPrior,
    extended,
)
from hybrid_mpc.machine import terms

EVERY = [prior for pair in PAIRS for prior in pair]


def points(prior, seed=0, n=50):
    """``x, u, w`` and parameters ``(n, ...)`` anywhere within bounds."""
    rng = np.random.default_rng(seed)
    p = np.array([[rng.uniform(q.lower, q.upper) for q in prior.parameters] for _ in range(n)])
    return *random_points(prior, rng, n), p


def evaluated(prior, seed=0):
    """Everything that its equations give at random points, by name."""
    x, u, w, p = (v.T for v in points(prior, seed))
    made = prior.equations
    rate = np.random.default_rng(seed).normal(size=x.shape)
    found = {"xdot": made.xdot(x, u, w, p), "output": made.output(x, u, w, p)}
    for b in made.balances:
        found |= {f"{b.name} {key}": getattr(b, key)(x, u, w, p) for key in ("supply", "loss")}
        found |= {f"{b.name} storage": b.storage(x, p), f"{b.name} residual": b.residual(x, rate, u, w, p)}
    return {name: value.full() for name, value in found.items()}


@pytest.mark.parametrize(
    ("prior", "found"),
    [(Tanks, ()), (TorchTanks, ()), (Swing, ((0, 1),)), (TorchSwing, ((0, 1),)), (Arm, ((0, 2), (1, 3)))],
)
def test_positions_with_their_speeds_are_read_off_the_equations(prior, found):
    assert prior().kinematics == found


def test_a_rate_that_only_is_in_proportion_to_a_state_is_no_speed():
    class Lag(Prior):
        states = (Signal("a", "m"), Signal("b", "m"), Signal("c", "m/s"))
        inputs, outputs = (Signal("u", "m/s"),), (Signal("a", "m"),)

        def xdot(self, x, u, w, p):
            return 2.0 * x.b, u.u, x.c**2  # a multiple, an input, and a slope that is 1 at one point alone

    assert Lag().kinematics == ()


def same_equations(one, other):
    ours, theirs = evaluated(one), evaluated(other)
    assert set(ours) == set(theirs)
    for name, values in ours.items():
        # the same operations in another order; sums of terms that cancel are as exact as their terms
        bound = 1e-12 * np.abs(values).max()
        np.testing.assert_allclose(values, theirs[name], rtol=1e-12, atol=bound, err_msg=name)


@pytest.mark.parametrize(("one", "other"), PAIRS, ids=lambda p: p.__name__)
def test_equations_are_the_same_in_casadi_and_in_torch(one, other):
    same_equations(one(), other())
    assert len(evaluated(one())) == 6
    (ours,), (theirs,) = one().equations.balances, other().equations.balances
    assert (ours.name, ours.unit, ours.rate_unit) == (theirs.name, theirs.unit, theirs.rate_unit)


@pytest.mark.parametrize("prior", [Arm, TorchArm])
def test_the_arm_moves_by_its_lagrange_equations(prior):
    """Written by hand: Spong, Hutchinson, Vidyasagar, *Robot Modeling and Control* (2006), planar elbow manipulator."""
    x, u, w, p = points(prior())
    found = prior().equations.xdot(x.T, u.T, w.T, p.T).full().T
    for i, ((q1, q2, v1, v2), (a, b, c, g1, g2, d)) in enumerate(zip(x, p, strict=True)):
        mass = np.array([[a + 2 * b * np.cos(q2), c + b * np.cos(q2)], [c + b * np.cos(q2), c]])
        h = -b * np.sin(q2)
        coriolis = np.array([[h * v2, h * (v1 + v2)], [-h * v1, 0.0]]) @ [v1, v2]
        gravity = np.array([g1 * np.cos(q1) + g2 * np.cos(q1 + q2), g2 * np.cos(q1 + q2)])
        force = u[i] - [d * v1, 2 * d * v2] - coriolis - gravity
        # rounding, and the matrix's condition of about 10
        np.testing.assert_allclose(found[i, 2:], np.linalg.solve(mass, force), rtol=1e-11, atol=1e-11)
        np.testing.assert_array_equal(found[i, :2], [v1, v2])


@pytest.mark.parametrize("prior", EVERY)
def test_balances_hold_along_the_flow(prior):
    check_balances(prior())
    for seed in range(2):
        check_balances(prior(random_values(prior, np.random.default_rng(seed))), seed)


class Upwards(Tanks):
    """The outflow is put in."""

    def balances(self, x, u, w, p):
        (b,) = super().balances(x, u, w, p)
        return (replace(b, supply=b.supply + 2 * b.loss),)


class Forgotten(Tanks):
    """The rain is not counted."""

    def balances(self, x, u, w, p):
        (b,) = super().balances(x, u, w, p)
        return (replace(b, supply=u.inflow),)


class NegativeLoss(Tanks):
    """The balance is right, but what is supplied is called a loss."""

    def balances(self, x, u, w, p):
        (b,) = super().balances(x, u, w, p)
        return (replace(b, supply=-b.loss, loss=-b.supply),)


class Driving(Arm):
    """Friction that pushes."""

    def friction(self, q, v, p):
        return tuple(-f for f in super().friction(q, v, p))


class Tilted(Arm):
    """Beside that of energy a balance whose potential has the wrong sign."""

    def balances(self, x, u, w, p):
        mass = self.mass_matrix(x, p)
        twice = mass[0][0] * x.v_1**2 + 2 * mass[0][1] * x.v_1 * x.v_2 + mass[1][1] * x.v_2**2
        power, lost = u.tau_1 * x.v_1 + u.tau_2 * x.v_2, p.d * (x.v_1**2 + 2 * x.v_2**2)
        return (Balance("tilted", twice / 2 - self.potential(x, p), power, lost),)


@pytest.mark.parametrize("wrong", [Upwards, Forgotten, NegativeLoss, Driving, Tilted])
def test_a_wrong_sign_in_a_balance_is_noticed(wrong):
    with pytest.raises(AssertionError):
        check_balances(wrong())


def test_a_balance_made_by_hand_is_that_of_the_parts():
    """The energy of ``Tilted`` with the right sign stands beside the one that the mass matrix gives."""

    class ByHand(Tilted):
        def balances(self, x, u, w, p):
            (b,) = super().balances(x, u, w, p)
            return (replace(b, name="own", storage=b.storage + 2 * self.potential(x, p)),)

    check_balances(ByHand())
    found = evaluated(ByHand())
    for key in ("storage", "supply", "loss", "residual"):
        np.testing.assert_allclose(found[f"own {key}"], found[f"energy {key}"], rtol=1e-12, atol=1e-11)


@pytest.mark.parametrize("prior", [Arm, TorchArm])
def test_the_residual_takes_exact_rates_from_the_prior(prior):
    """A rate that no network corrects is the prior's own, whatever is handed over."""
    made, (x, u, w, p) = prior().equations, points(prior())
    rate = np.random.default_rng(1).normal(size=x.shape)
    other = np.hstack([rate[:, :2] + 7.0, rate[:, 2:]])
    residual = made.balances[0].residual
    given = u.T, w.T, p.T
    np.testing.assert_array_equal(residual(x.T, rate.T, *given), residual(x.T, other.T, *given))
    # v' M (rate - own rate), the paper's difference of energies
    own = made.xdot(x.T, *given).full().T[:, 2:]
    for i, (q2, v) in enumerate(zip(x[:, 1], x[:, 2:], strict=True)):
        bend = p[i, 1] * np.cos(q2)
        mass = np.array([[p[i, 0] + 2 * bend, p[i, 2] + bend], [p[i, 2] + bend, p[i, 2]]])
        expected = v @ mass @ (rate[i, 2:] - own[i])
        assert float(residual(x[i], rate[i], u[i], w[i], p[i])) == pytest.approx(
            expected, rel=1e-9, abs=1e-10
        )


@pytest.mark.parametrize("prior", [Tanks, TorchTanks])
def test_arguments_have_their_names_and_their_places(prior):
    class Named(prior):
        def xdot(self, x, u, w, p):
            upper, lower = x
            assert x.upper is x[0] is upper
            assert p._fields == ("a_1", "a_2", "k_1", "k_2")
            assert (len(u), len(w), u.inflow is u[0], w.rain is w[0]) == (1, 1, True, True)
            return 2.0 * lower, -3.0 * upper

    assert Named().equations.xdot([5.0, 7.0], 0.0, 0.0, Named().p).full().ravel().tolist() == [14.0, -15.0]


def test_a_name_that_is_no_identifier_has_its_place():
    class Odd(Prior):
        states = (Signal("level 1", "m"), Signal("class", "m"))
        inputs = (Signal("u", "-"),)
        outputs = (states[1],)

        def xdot(self, x, u, w, p):
            return x[1], x[0]

    assert Odd().equations.xdot([1.0, 2.0], 0.0, [], []).full().ravel().tolist() == [2.0, 1.0]
    assert float(Odd().equations.output([1.0, 2.0], 0.0, [], [])) == 2.0


@pytest.mark.parametrize("prior", [Tanks, TorchTanks])
def test_outputs_are_by_default_the_states_of_their_names(prior):
    x, u, w, p = (v.T for v in points(prior()))
    np.testing.assert_array_equal(prior().equations.output(x, u, w, p).full(), x[1:])

    class Own(prior):
        outputs = (Signal("total", "m^3"), Signal("outflow", "m^3/s"))

        def output(self, x, u, w, p):
            return p.a_1 * x.upper + p.a_2 * x.lower, self.flows(x, p)[1] + 0.0 * u.inflow + w.rain

    found = Own().equations.output(x, u, w, p).full()
    np.testing.assert_allclose(found[0], p[0] * x[0] + p[1] * x[1], rtol=1e-14)
    np.testing.assert_allclose(found[1], p[3] * np.sqrt(np.maximum(x[1], 1e-4)) + w[0], rtol=1e-14)


def test_values_replace_the_nominal_ones():
    tanks = Tanks({"k_1": 0.5})
    assert tanks.values == {"a_1": 1.0, "a_2": 1.5, "k_1": 0.5, "k_2": 0.3}
    assert tanks.p.tolist() == [1.0, 1.5, 0.5, 0.3]
    tanks.values["k_1"] = 9.0  # a copy
    assert tanks.p[2] == 0.5


def test_what_a_network_may_correct():
    assert Tanks().corrected == (0, 1)
    assert Arm.corrects == TorchArm.corrects == ("v_1", "v_2")
    assert Arm().corrected == TorchArm().corrected == (2, 3)

    class Lower(Tanks):
        corrects = ("lower",)

    class Elbow(Arm):
        corrects = ("v_2",)

    class Renamed(Arm):
        states = tuple(replace(s, name=s.name.upper()) for s in Arm.states)

    class ElbowAgain(Elbow):
        """A choice is inherited."""

    assert Lower().corrected == (1,)
    assert Elbow().corrected == ElbowAgain().corrected == (3,)
    assert Renamed.corrects == ("V_1", "V_2")


def test_equations_are_made_once_for_equal_priors():
    class Geared(Swing):
        gear = 1.0

        def force(self, q, v, u, w, p):
            return float(self.gear) * u.torque

    def geared(gear):
        prior = Geared()
        prior.gear = gear
        return prior

    assert Swing().equations is Swing({"J": 0.2}).equations
    assert Swing().equations is not TorchSwing().equations
    assert geared(1.7).equations is geared(1.7).equations
    assert geared(1.7).equations is not geared(1.8).equations
    shared = geared(np.float32(1))  # no number: nobody knows whether another's is the same
    assert shared.equations is shared.equations
    assert shared.equations is not geared(np.float32(1)).equations


def test_a_diagonal_a_number_and_a_full_matrix_are_the_same_inertia():
    class Diagonal(Arm):
        def mass_matrix(self, q, p):
            return p.a, p.c

    class Full(Arm):
        def mass_matrix(self, q, p):
            return ca.vertcat(ca.horzcat(p.a, 0), ca.horzcat(0, p.c))  # a matrix of CasADi's, too

    x, u, w, p = (v.T for v in points(Arm()))
    one, two = (kind().equations.xdot(x, u, w, p).full() for kind in (Diagonal, Full))
    np.testing.assert_allclose(one, two, rtol=1e-12, atol=1e-12)
    check_balances(Diagonal())
    assert TorchSwing().equations.xdot([0.0, 2.0], 0.3, [], [0.1, 1.0, 0.1]).full().ravel().tolist() == [
        2.0,
        pytest.approx(1.0, rel=1e-12),
    ]


# what is refused


class Level(Prior):
    states = (Signal("level", "m"),)
    inputs = (Signal("q", "m/s"),)
    outputs = (Signal("level", "m"),)

    def xdot(self, x, u, w, p):
        return (u.q - x.level,)


class TorchLevel(TorchPrior):
    states, inputs, outputs = Level.states, Level.inputs, Level.outputs

    def xdot(self, x, u, w, p):
        return (u.q - x.level,)


def wrong(base=Level, **changed):
    """A prior with other attributes, of which functions are its methods."""
    return type("Wrong", (base,), changed)


REFUSED = {
    "a value that is no parameter's": (lambda: Tanks({"k_3": 1.0}), r"Tanks.*k_3.*a_1, a_2.*HM-MACHINE-009"),
    "a value where there are none": (lambda: Level({"k": 1.0}), r"none.*HM-MACHINE-009"),
    "an output of no state": (
        wrong(outputs=(Signal("height", "m"),)), r"height.*level.*HM-MACHINE-010",
    ),
    "too many rates": (wrong(xdot=lambda s, x, u, w, p: (x.level, u.q)), "HM-MACHINE-016"),
    "too few rates": (
        wrong(Tanks, xdot=lambda s, x, u, w, p: x.upper), "HM-MACHINE-016",
    ),
    "no return": (wrong(xdot=lambda s, x, u, w, p: None), r"NoneType.*HM-MACHINE-015"),
    "no return in torch": (wrong(TorchLevel, xdot=lambda s, x, u, w, p: None), r"NoneType.*HM-MACHINE-041"),
    "a balance alone": (
        wrong(balances=lambda s, x, u, w, p: Balance("v", x.level, u.q)), "HM-MACHINE-013",
    ),
    "two balances of one name": (
        wrong(balances=lambda s, x, u, w, p: 2 * (Balance("v", x.level, u.q, x.level),)), "HM-MACHINE-017",
    ),
    "an energy of one's own beside that of the parts": (
        wrong(Swing, balances=lambda s, x, u, w, p: (Balance("energy", x.phi, 0.0),)), "HM-MACHINE-017",
    ),
    "a storage of the input": (
        wrong(balances=lambda s, x, u, w, p: (Balance("v", x.level * u.q, u.q),)),
        r"balance v.*HM-MACHINE-018",
    ),
    "a storage of two numbers": (
        wrong(balances=lambda s, x, u, w, p: (Balance("v", (x.level, x.level), u.q),)), r"storage.*HM-MACHINE-016",
    ),
    "torch in a Prior": (wrong(xdot=lambda s, x, u, w, p: (torch.sqrt(x.level),)), "HM-MACHINE-014"),
    "a tensor from a Prior": (wrong(xdot=lambda s, x, u, w, p: (torch.ones(()),)), "needs a TorchPrior"),
    "CasADi in a TorchPrior": (wrong(TorchLevel, xdot=lambda s, x, u, w, p: (ca.sin(x.level),)), "HM-MACHINE-040"),
    "an expression from a TorchPrior": (
        wrong(TorchLevel, xdot=lambda s, x, u, w, p: (ca.SX.sym("a"),)), "HM-MACHINE-041",
    ),
    "three entries for a mass matrix": (
        wrong(Arm, mass_matrix=lambda s, q, p: (p.a, p.b, p.c)), "HM-MACHINE-004",
    ),
    "a number for a mass matrix": (wrong(Arm, mass_matrix=lambda s, q, p: p.a), "HM-MACHINE-004"),
    "two potentials": (wrong(Arm, potential=lambda s, q, p: (0.0, 0.0)), r"potential\(q, p\).*HM-MACHINE-016"),
    "force of one axis": (wrong(Arm, force=lambda s, q, v, u, w, p: u.tau_1), "HM-MACHINE-016"),
    "fewer inputs than axes": (wrong(Arm, inputs=Arm.inputs[:1]), "HM-MACHINE-002"),
}  # fmt: skip


@pytest.mark.parametrize("why", REFUSED)
def test_what_cannot_be_is_refused_by_name(why):
    make, words = REFUSED[why]
    with pytest.raises(InputError, match=words) as refused:
        make().equations  # noqa: B018
    if why != "a value where there are none" and "value that is no" not in why:
        assert "Wrong" in str(refused.value) or "TorchPrior must give" in str(refused.value)


@pytest.mark.parametrize(
    ("names", "words"),
    [(("depth",), r"Wrong.*depth.*level.*HM-MACHINE-012"), ("level", r"'level'.*HM-MACHINE-011")],
)
def test_what_is_corrected_must_be_a_state(names, words):
    with pytest.raises(InputError, match=words):
        wrong(corrects=names)().corrected  # noqa: B018


@pytest.mark.parametrize("kind", [(MechanicalPrior,), (TorchPrior, MechanicalPrior)])
def test_states_that_are_no_pairs_are_refused(kind):
    class Signals:
        states = (Signal("a", "rad"), Signal("b", "rad"), Signal("c", "rad"))

    for bases, own in ((kind, {"states": Signals.states}), ((Signals, *kind), {})):
        with pytest.raises(InputError, match=r"Odd.*a, b, c.*HM-MACHINE-001"):
            type("Odd", bases, own)


def test_what_must_be_written_is_named():
    for base, like, words in (
        (Prior, Level, r"Bare must define xdot\(x, u, w, p\)"),
        (MechanicalPrior, Swing, r"Bare must define mass_matrix\(q, p\)"),
    ):
        bare = type("Bare", (base,), {key: getattr(like, key) for key in ("states", "inputs", "outputs")})
        with pytest.raises(NotImplementedError, match=words):
            bare().equations  # noqa: B018


def test_errors_of_ones_own_code_stay_what_they_are():
    """Only what the other language's scalars cause is said to be of the other language."""

    def broken(self, x, u, w, p):
        return len(3)

    for base in (Level, TorchLevel):
        with pytest.raises(TypeError, match="has no len"):
            wrong(base, xdot=broken)().equations  # noqa: B018


# terms in both languages; their formulas are tested in test_terms.py


TERMS = (
    terms.viscous("v_2", Parameter("d_2", 0.3, "N m s/rad", 0.0, 2.0)),
    terms.coulomb("v_1", Parameter("F_2", 0.5, "N m", 0.0, 2.0), width=0.05),
    terms.stribeck("v_2", Parameter("F_s", 0.8, "N m", 0.5, 2.0), speed=0.2, width=0.05),
    Term(
        "bearing", "force", "v_1",
        (Parameter("rho", 0.02, "-", 0.0, 0.05), Parameter("gamma", 10.0, "s/rad", 1.0, 50.0)),
        lambda at, p: -p.rho * ca.tanh(p.gamma * at.own) * ca.fabs(at.p.a * at.x.v_1**2 + 2.0 * at.p.g_1 * at.x.q_1),
        loss=True,
    ),
)  # fmt: skip


def test_terms_are_the_same_in_both_languages():
    ours, theirs = (extended(kind, *TERMS) for kind in (Arm, TorchArm))
    assert ours.corrects == theirs.corrects == ("v_1", "v_2")
    for prior in (ours, theirs):
        check_balances(prior())
    same_equations(ours(), theirs())
    x, u, w = random_points(Arm(), np.random.default_rng(0), 20)
    assert np.abs(rates(ours(), x, u, w) - rates(Arm(), x, u, w)).max() > 0.1  # they act
