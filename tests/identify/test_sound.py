"""Gates behind the fit of the prior: what stops a run, and what puts the prior's structure in doubt."""

import math
from dataclasses import replace

import numpy as np
import pytest
from example_priors import Swing
from simulated_pendulum import DT, Pendulum

from hybrid_mpc import Parameter, Prior, Signal, Trajectory, fit_prior
from hybrid_mpc.identify.fit import smoothed
from hybrid_mpc.identify.sound import (
    bound_costs,
    constant_runs,
    problems,
    structure_doubt,
    warn_of_stability,
    warn_of_worse_fit,
)

SECONDS = 1.0


class Tight(Pendulum):
    """Its stiffness may not be what it is."""

    parameters = tuple(
        Parameter("mgl", 0.7, "N m", 0.5, 0.8) if p.name == "mgl" else p for p in Swing.parameters
    )


class Ranged(Pendulum):
    """Its angle and its speed have ranges; the angle turns through."""

    states = (Signal("phi", "rad", -3.2, 3.2, periodic=True), Signal("phi_dot", "rad/s", -20.0, 20.0))


def fitted(make, noisy):
    *train, valid = noisy
    return fit_prior(make, train, [replace(valid, role="valid")], dt=DT, time_unit=SECONDS)


@pytest.fixture(scope="module")
def sound(noisy):
    return fitted(Pendulum, noisy)


@pytest.fixture(scope="module")
def tight(noisy):
    return fitted(Tight, noisy)


def test_a_sound_fit_has_no_problem_and_no_doubt(noisy, sound):
    states = smoothed(Pendulum, sound, noisy, DT)
    assert problems(sound.smoother(Pendulum(sound.values), DT), sound, states) == ()
    assert bound_costs(Pendulum, sound, states, DT, 2.0) == ()


def test_numbers_that_are_not_finite_are_problems(noisy, sound):
    states, smoother = smoothed(Pendulum, sound, noisy, DT), sound.smoother(Pendulum(sound.values), DT)
    cases = {
        "mgl": replace(sound, values={**sound.values, "mgl": math.nan}),
        "phi": replace(sound, sigma=(math.inf,)),
    }
    for name, fit in cases.items():
        (found,) = problems(smoother, fit, states)
        assert name in found
    x = states[0].x.copy()
    x[3, 1] = math.nan
    (found,) = problems(smoother, sound, [replace(states[0], x=x)])
    assert found.startswith("phi_dot ")


def test_states_that_run_away_are_problems_and_single_samples_are_none(noisy, sound):
    smoother = sound.smoother(Ranged(sound.values), DT)
    first, away = smoothed(Pendulum, sound, noisy, DT)[0], smoother.bounds[1][1]
    assert away == 60.0  # three times the range of 40, around its middle
    assert math.isinf(smoother.bounds[1][0])  # an angle that turns through has no end
    for share, n in ((0.02, 0), (0.2, 1)):
        x = first.x.copy()
        x[: round(share * len(x)), 1] = away
        assert len(problems(smoother, sound, [replace(first, x=x)])) == n


def test_the_cost_of_a_bound_is_that_of_a_fit_without_it(noisy, tight, sound):
    """The stiffness of 1.2 N m may be 0.8 at most: without this bound it is found, and little is left but noise."""
    states = smoothed(Tight, tight, noisy[:2], DT)
    (found,) = bound_costs(Tight, tight, states, DT, 2.0)
    assert (found.parameter, found.value) == ("mgl", pytest.approx(0.8))
    # the range of 0.3 is added to it: 1.1 is the nearest that it may be
    assert found.free == pytest.approx(1.1, rel=1e-3)
    assert found.costs
    assert found.ratio < 0.6


def test_a_constant_runs_at_the_mean_of_the_training_outputs(noisy):
    (found,) = constant_runs(noisy[:2], noisy[2:], 10)
    assert found.shape == (len(noisy[2].t) - 10, 1)
    assert (found == np.concatenate([noisy[0].y, noisy[1].y]).mean()).all()


@pytest.mark.parametrize(
    ("error", "baselines", "doubted"),
    [
        (0.2, {"constant": 1.0, "ARX": 0.19}, ""),
        (0.2, {"constant": 1.0, "ARX": 0.1, "N4SID": 0.12}, "ARX"),
        (1.2, {"constant": 1.1}, "constant"),
        (1.2, {"constant": 1.1, "ARX": 1.15}, "constant"),
        (math.inf, {"constant": 1.1, "ARX": 0.5}, "ARX"),
        (0.5, {}, ""),
    ],
)
def test_a_simpler_model_that_is_clearly_better_puts_the_structure_in_doubt(error, baselines, doubted):
    found = structure_doubt(error, baselines)
    assert bool(found) == bool(doubted)
    assert doubted in found


@pytest.mark.parametrize(
    ("factors", "warned"),
    [((1.5, 1.6, 1.4, 1.5), True), ((4.0, 0.5, 1.2, 0.6), False), ((1.02, 1.02, 1.02, 1.02), False)],
    ids=["worse", "in some recordings", "hardly"],
)
def test_a_fit_that_is_surely_worse_than_nominal_values_is_named(factors, warned):
    nominal = [np.full(50, size) for size in (0.9, 1.0, 1.1, 1.0)]
    fitted = [factor * own for factor, own in zip(factors, nominal, strict=True)]
    found = warn_of_worse_fit(nominal, fitted, ["a", "b", "c", "d"])
    assert ["HM-IDENTIFY-084" in one for one in found] == [True] * warned


class Undecided(Prior):
    """Its sign decides whether it is stable."""

    states = outputs = (Signal("x", "m", -9.0, 9.0),)
    inputs = (Signal("u", "m/s", -9.0, 9.0),)
    parameters = (Parameter("a", 2.0, "1/s", -4.0, 4.0),)

    def xdot(self, x, u, w, p):
        return (p.a * x.x + u.u,)


@pytest.mark.parametrize(("value", "warned"), [(-1.0, True), (1.0, False), (2.0, False)])
def test_a_fit_that_makes_an_unstable_prior_stable_is_named(sound, value, warned):
    t = 0.1 * np.arange(100)
    x = np.sin(t)[:, None]
    known = Trajectory("run", "train", 0.1, t, 0.0 * x, x, x, 0.0 * x)
    found = warn_of_stability(Undecided, replace(sound, values={"a": value}), [known], 0.1)
    assert ["HM-IDENTIFY-085" in one for one in found] == [True] * warned
