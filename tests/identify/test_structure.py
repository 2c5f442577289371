"""Which term or signal of a prior is wrong."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from simulated_pendulum import DT, Pendulum

from hybrid_mpc import InputError, MechanicalPrior, Parameter, Prior, Signal, fit_prior
from hybrid_mpc.identify.structure import (
    Cause,
    _FactorFit,
    causes,
    causes_of_refusal,
    named,
    reading_of,
    terms_of,
    with_factor,
)
from hybrid_mpc.identify.windows import cut_outputs

SECONDS = 1.0


class WrongSpring(Pendulum):
    """Its spring drives it away from rest."""

    def potential(self, q, p):
        return -super().potential(q, p)


class Cart(MechanicalPrior):
    """Two coupled masses."""

    states = tuple(Signal(name, "m") for name in ("a", "b")) + tuple(
        Signal(name, "m/s") for name in ("v", "w")
    )
    inputs = (Signal("F", "N"),)
    outputs = states[:2]
    parameters = (Parameter("m", 1.0, "kg", 0.5, 2.0), Parameter("k", 3.0, "N/m", 1.0, 9.0))

    def mass_matrix(self, q, p):
        return (2 * p.m, p.m * ca.cos(q.b)), (p.m * ca.cos(q.b), p.m)

    def potential(self, q, p):
        return 0.5 * p.k * q.b**2

    def force(self, q, v, u, w, p):
        return u.F, 0.0


class Tank(Prior):
    """Two terms in one rate, one of them a product with a sum."""

    states = (Signal("h", "m"), Signal("T", "K"))
    inputs = (Signal("q", "m^3/s"),)
    outputs = states
    parameters = (Parameter("k", 0.3, "m^2.5/s", 0.1, 1.0), Parameter("A", 2.0, "m^2", 1.0, 4.0))

    def xdot(self, x, u, w, p):
        return (u.q - p.k * ca.sqrt(x.h)) / p.A, u.q * (20.0 - x.T)


def test_every_term_and_signal_gets_a_factor():
    assert terms_of(Tank()) == [
        "input q [m^3/s]",
        "(q - k * sqrt(h)) / A in the rate of h",
        "q in the rate of h",
        "k * sqrt(h) in the rate of h",
        "q * (20 - T) in the rate of T",
        "20 in the rate of T",
        "T in the rate of T",
        "h in the output h",
        "T in the output T",
    ]


class Mixer(Prior):
    """An input that stands in two rates, and a product that does."""

    states = (Signal("h", "m"), Signal("T", "K"))
    inputs = (Signal("q", "m^3/s"), Signal("heat", "W"))
    outputs = states
    disturbances = (Signal("rain", "m^3/s"),)

    def xdot(self, x, u, w, p):
        flow = u.q * x.h
        return w.rain - flow + u.q, flow - u.q * x.T + u.heat


def test_terms_are_counted_alike_with_and_without_factors():
    """Inputs that stand in several rates and products that do: each factor turns the term of its name."""
    terms, factored = terms_of(Mixer()), with_factor(Mixer)()
    h, t, q, heat, rain = 0.3, 0.7, 0.2, 0.11, 0.05
    flow = q * h
    turned = {
        "input q [m^3/s]": (rain + flow - q, -flow + q * t + heat),
        "q in the rate of h": (rain - flow - q, flow - q * t + heat),
        "rain in the rate of h": (-rain - flow + q, flow - q * t + heat),
        "q * h in the rate of h": (rain + flow + q, flow - q * t + heat),
        "q * h in the rate of T": (rain - flow + q, -flow - q * t + heat),
        "q * h wherever the rate of h uses it": (rain + flow + q, -flow - q * t + heat),
        "q * T in the rate of T": (rain - flow + q, flow + q * t + heat),
        "heat in the rate of T": (rain - flow + q, flow - q * t - heat),
    }
    for term, rates in turned.items():
        given = [-1.0, *np.eye(len(terms))[terms.index(term)]]
        found = factored.equations.xdot([h, t], [q, heat], [rain], given).full().ravel()
        assert found == pytest.approx(rates, abs=1e-14)


def test_entries_of_a_symmetric_mass_matrix_share_a_factor():
    found = terms_of(Cart())
    assert sum("mass matrix (a, b)" in term for term in found) == 1
    assert "0.5 * k * b^2 in the potential" in found
    assert "F in the force of a" in found


@pytest.mark.parametrize("make", [Tank, Cart])
def test_a_factor_multiplies_its_term_alone(make):
    """With factor 1, or with none chosen, the equations are the prior's own; each factor changes them somewhere."""
    prior, factored = make(), with_factor(make)()
    n, terms = len(prior.states), len(terms_of(prior))
    x, u = np.linspace(0.4, 0.9, n), [0.7]
    for one in ("xdot", "output"):
        own, other = getattr(prior.equations, one), getattr(factored.equations, one)
        for factor, k in ((1.0, 2), (5.0, None)):
            chosen = np.eye(terms)[k] if k is not None else np.zeros(terms)
            given = [*prior.p, factor, *chosen]
            assert other(x, u, [], given).full() == pytest.approx(own(x, u, [], prior.p).full(), abs=1e-12)
    for k in range(terms):
        given = [*prior.p, -1.0, *np.eye(terms)[k]]
        changed = [
            np.abs(
                getattr(factored.equations, one)(x, u, [], given).full()
                - getattr(prior.equations, one)(x, u, [], prior.p).full()
            ).max()
            for one in ("xdot", "output")
        ]
        assert max(changed) > 1e-3
    if make is Tank:  # sqrt(h) outflow of the other sign
        given = [*prior.p, -1.0, *np.eye(terms)[3]]
        assert float(factored.equations.xdot([0.25, 0.0], [0.1], [], given)[0]) == pytest.approx(
            (0.1 + 0.15) / 2
        )


@pytest.mark.parametrize(
    ("factor", "said"),
    [
        (-0.9, "sign"), (57.0, "rad instead of deg"), (0.0175, "deg instead of rad"), (1010.0, "1e3"),
        (0.5, "twice"), (61.0, "60"),
        (-4.0, "sign"), (7.9, "unit"), (1.3, ""), (0.7, ""),
    ],
)  # fmt: skip
def test_what_a_factor_says(factor, said):
    assert said in reading_of(factor)
    assert bool(said) == bool(reading_of(factor))


def found_of(make, noisy):
    *train, valid = noisy
    fit = fit_prior(make, train, [replace(valid, role="valid")], dt=DT, time_unit=SECONDS)
    return causes(make, fit.values, train, DT, 4.0, SECONDS)


def test_a_sound_prior_is_left_alone(noisy):
    assert found_of(Pendulum, noisy) == ()


def test_a_wrong_sign_is_named(noisy):
    found = found_of(WrongSpring, noisy)
    assert "potential" in found[0].what
    assert "sign" in found[0].why
    assert found[0].ratio < 0.1
    assert str(found[0]) in named(found)


class Large(Pendulum):
    """Its torque is taken a thousand times too large, as N mm for N m."""

    def force(self, q, v, u, w, p):
        return (1e3 * u.torque,)


class Small(Pendulum):
    """Its torque is taken a hundred thousand times too small, as Pa for bar."""

    def force(self, q, v, u, w, p):
        return (1e-5 * u.torque,)


@pytest.mark.parametrize(("make", "factor"), [(Large, 1e-3), (Small, 1e5)])
def test_a_wrong_unit_is_named(noisy, make, factor):
    first = found_of(make, noisy)[0]
    assert "force" in first.what or "input" in first.what
    assert first.factor == pytest.approx(factor)
    assert first.exact


class Stiff(Pendulum):
    """Its friction is a million times too large: no period is short enough."""

    def friction(self, q, v, p):
        return (1e6 * p.d * v.phi_dot,)


def test_a_unit_that_makes_a_prior_too_stiff_is_named(noisy):
    with pytest.raises(InputError):
        fit_prior(Stiff, noisy, noisy, dt=DT)
    first = causes_of_refusal(Stiff, noisy, DT, 4.0, SECONDS)[0]
    assert "friction" in first.what
    assert first.factor in (1e-5, 1e-6)  # what is left of it hardly acts
    assert "spread" in str(first)


def test_a_prior_that_is_not_refused_has_no_such_cause(noisy):
    assert causes_of_refusal(Pendulum, noisy, DT, 4.0, SECONDS) == ()


@pytest.mark.parametrize("key", ["y", "u"])
def test_a_signal_that_is_counted_the_other_way_is_named(noisy, key):
    """An angle with the wrong sign is one with an input of the wrong sign: an odd machine cannot tell them apart."""
    found = found_of(Pendulum, [replace(t, **{key: -getattr(t, key)}) for t in noisy])
    assert any("torque" in one.what or "phi" in one.what for one in found)
    assert all("sign" in one.why or "other way" in one.why for one in found[:1])


def test_slopes_by_a_held_factor_are_left_out(noisy):
    """Outputs and the other slopes are those with a free factor, whose column is zero where it is held."""
    windows = cut_outputs(noisy, 20, 0, 3, Pendulum.states)
    fit = _FactorFit(Pendulum, DT)
    theta = np.append(fit.nominal[:-1], -1.0)
    free, held = (
        fit.choosing([2], held).outputs(theta, windows.x, windows, 2, "all") for held in (False, True)
    )
    factor = len(theta) - 1
    np.testing.assert_array_equal(held[0], free[0])
    np.testing.assert_allclose(
        np.delete(held[1], factor, axis=-1), np.delete(free[1], factor, axis=-1), rtol=1e-9, atol=1e-12
    )
    assert np.all(held[1][..., factor] == 0.0)
    step = 1e-6
    more, less = (
        fit.choosing([2]).outputs(theta + way * np.eye(len(theta))[factor], windows.x, windows, 2, "")[0]
        for way in (step, -step)
    )
    np.testing.assert_allclose(free[1][..., factor], (more - less) / (2 * step), rtol=1e-4, atol=1e-7)


@pytest.mark.parametrize(
    ("factor", "exact"),
    [(-1.0, True), (57.0, True), (1e-3, True), (0.5, False), (2.0, False), (-7.0, False), (np.nan, True)],
)
def test_factors_that_missing_physics_may_have_are_not_exact(factor, exact):
    why = "the two seem to be exchanged" if np.isnan(factor) else reading_of(factor)
    assert Cause("a", why, 0.5, factor).exact == exact
