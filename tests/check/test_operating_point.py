"""An operating point that is no equilibrium: the two equilibria beside it, and the one that replaces it."""

import numpy as np
import pytest

from hybrid_mpc import InputError, OperatingPoint, Parameter, Prior, Signal, extended, terms, with_nominal
from hybrid_mpc.check.operating_point import (
    both_ways,
    drift_at_rest,
    held_outputs,
    held_states,
    holding_input,
    place_of,
    steady_point,
)

INFLOW = Signal("inflow", "m/s", 0.0, 1.0)


class Tank(Prior):
    states = outputs = (Signal("level", "m", 0.0, 2.0),)
    inputs, parameters = (INFLOW,), (Parameter("k", 0.5, "1/s", 0.1, 1.0),)
    operating_point = OperatingPoint((1.0,), (0.3,))

    def xdot(self, x, u, w, p):
        return (u.inflow - p.k * x.level,)


class Two(Prior):
    """One input cannot hold two levels of any choice."""

    states = outputs = (Signal("one", "m", 0.0, 2.0), Signal("two", "m", 0.0, 2.0))
    inputs, parameters = (INFLOW,), (Parameter("k", 0.5, "1/s", 0.1, 1.0),)
    operating_point = OperatingPoint((1.0, 0.4), (0.5,))

    def xdot(self, x, u, w, p):
        return u.inflow - p.k * x.one, p.k * (x.one - x.two)


def test_both_equilibria_beside_a_point_have_their_numbers():
    prior = Tank()
    assert drift_at_rest(prior, 1.0)
    assert holding_input(prior) == OperatingPoint((1.0,), (0.5,))
    assert held_states(prior) == OperatingPoint((0.6,), (0.3,))
    assert "x = [0.6]" in both_ways(prior)
    assert "u = [0.5]" in both_ways(prior)
    assert steady_point(prior) == holding_input(prior)


def test_what_the_inputs_cannot_hold_moves_to_the_states_that_they_hold():
    assert holding_input(Two()) is None
    assert "x = [1.0, 1.0]" in both_ways(Two())
    # the equation of the second level has no input; the level of the first output stays where it can
    assert "even without limits" in both_ways(Two())
    assert "Steady state at your one: x = [1.0, 1.0], u = [0.5]" in both_ways(Two())
    np.testing.assert_allclose(steady_point(Two()).x, [1.0, 1.0])
    assert steady_point(Two()).u == (0.5,)


def test_as_many_outputs_are_held_as_there_are_inputs():
    """Two levels with an inflow each follow their inputs; the third one shows the first two."""

    class Three(Prior):
        states = outputs = tuple(Signal(name, "m", 0.0, 2.0) for name in ("one", "two", "sum"))
        inputs, parameters = (INFLOW, Signal("other", "m/s", 0.0, 1.0)), ()
        operating_point = OperatingPoint((1.0, 0.5, 0.2), (0.1, 0.1))

        def xdot(self, x, u, w, p):
            return u.inflow - 0.5 * x.one, u.other - 0.5 * x.two, 0.5 * (x.one + x.two) - x.sum

    point, names = held_outputs(Three())
    assert names == ("one", "two")
    np.testing.assert_allclose([*point.x, *point.u], [1.0, 0.5, 0.75, 0.5, 0.25])
    assert "Steady state at your one and two: x = [1.0, 0.5, 0.75], u = [0.5, 0.25]" in both_ways(Three())
    assert steady_point(Three()) == point


def test_an_input_beyond_its_range_holds_nothing():
    class Wide(Tank):
        operating_point = OperatingPoint((1.5,), (0.3,))
        parameters = (Parameter("k", 0.9, "1/s", 0.1, 1.0),)

    assert holding_input(Wide()) is None
    assert "none within its range" in both_ways(Wide())
    assert steady_point(Wide()).x == pytest.approx((1 / 3,))


def test_states_of_terms_follow_the_input_that_holds_the_machine():
    lag = terms.input_lag("inflow", Parameter("tau", 2.0, "s", 0.1, 9.0), state=Signal("acting", "m/s"))
    leak = terms.offset("level", Parameter("r", -0.1, "m/s", -1.0, 1.0), place="rate")
    kind = extended(Tank, lag, leak)
    point = steady_point(kind())
    np.testing.assert_allclose([*point.x, *point.u], [1.0, 0.6, 0.6])
    moved = with_nominal(kind, {"k": 0.5}, point)
    assert moved.operating_point == with_nominal(moved, {}).operating_point == point
    assert drift_at_rest(moved(), 1e3) == ""


def test_a_point_with_the_states_of_terms_belongs_to_the_extended_class():
    class Longer(Tank):
        operating_point = OperatingPoint((1.0, 0.5), (0.5,))

    lag = terms.input_lag("inflow", Parameter("tau", 2.0, "s", 0.1, 9.0), state=Signal("acting", "m/s"))
    with pytest.raises(InputError, match=r"Longer.*x must have 1.*got 2.*HM-MACHINE-049"):
        extended(Longer, lag)
    kind = extended(Tank, lag)
    assert place_of(Tank()) == "operating_point"
    assert "extended(Tank, ...)" in place_of(kind())
    kind.operating_point = OperatingPoint((1.0,), (0.5,))
    with pytest.raises(
        InputError, match=r"TankExtended.*x must have 2 numbers \(level, acting\).*HM-MACHINE-049"
    ):
        kind()
