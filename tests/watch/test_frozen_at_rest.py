"""A sensor that freezes where the machine hardly moves: the estimate stands, the controller pulls ever stronger."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from monitor_parts import DT, Estimate, J, energy, pendulum

from hybrid_mpc import InputError, Signal, with_input_delay
from hybrid_mpc.model.model import step_symbols

STEP, LIMIT = 1e-3, 1.0
REST = 0.2  # rad/s: below it friction may stick
"""Step of the sensor [rad]; input from -1 to 1 N m, a quarter of that is 0.5 N m."""


def jacobian(model):
    """``with_jacobian`` of a model that has none."""
    point = step_symbols(model)
    x, h, u = point[:3]
    ahead = ca.vertcat(*model.step(*point))
    slopes = ca.jacobian(ahead, ca.vertcat(x, h)), ca.jacobian(ahead, u)
    return ca.Function(
        "with_jacobian", point, [ahead[: model.n_x], ahead[model.n_x :], *map(ca.densify, slopes)]
    )


def monitor(limit=LIMIT):
    signal = Signal("tau", "N m") if limit is None else Signal("tau", "N m", -limit, limit)
    return energy(replace(pendulum(), inputs=(signal,)), resolution=[STEP], rest_speed=REST)


def frozen(u, y, watching, x=None, h=None):
    """The samples whose reading says frozen; the estimates are ``x`` and ``h``, by default at rest at ``y``."""
    x = np.column_stack([y, np.zeros(len(u))]) if x is None else x
    h = np.zeros((len(u), 0)) if h is None else h
    state, found = watching.initial(), []
    for k in range(len(u)):
        u_prev = u[k - 1 : k] if k else np.zeros(1)
        state, reading = watching.update(state, y[k : k + 1], u_prev, Estimate(x[k], h[k], np.zeros(1)))
        found.append(reading.frozen)
    return np.flatnonzero(found).tolist()


def pulling(before, after, at=50, n=100):
    return np.where(np.arange(n) < at, before, after), np.zeros(n)


def test_a_pull_that_should_have_moved_it_tells():
    u, y = pulling(0.1, 0.7)
    # 0.6 N m more are 6 rad/s^2: after 1, 2 periods 2.4 and 7.2 mrad of travel, three steps are 3 mrad
    assert [0.6 / J * DT**2 * n for n in (1, 3)] == pytest.approx([2.4e-3, 7.2e-3])
    # sample 51 is the first after a period with it
    assert frozen(u, y, monitor()) == list(range(52, 100))


def test_it_counts_from_the_input_at_the_last_step_of_the_sensor():
    u, y = pulling(0.4, 0.7)
    y[:20] = STEP  # moves at sample 20 under 0.4 N m: 0.3 N m more since then
    assert frozen(u, y, monitor()) == []
    assert frozen(u - 0.6, y, monitor()) == []


@pytest.mark.parametrize("limit", [None, 1.3])
def test_what_friction_may_hold_or_nobody_has_bounded_does_not(limit):
    u, y = pulling(0.1, 0.7)  # 0.7 N m since the beginning, a quarter of 2.6 would be 0.65: 0.6 is not
    y[:20] = STEP
    assert frozen(u, y, monitor(limit)) == []


def moved(u, model, x0=(0.0, 0.0)):
    """States under the inputs, and what the sensor says of them."""
    x, h = [np.array(x0)], [np.zeros(model.n_h)]
    for value in u[:-1]:
        step = model.step(x[-1], h[-1], value, model.w, model.p)
        x.append(step[0].full().ravel())
        h.append(step[1].full().ravel())
    x, h = np.array(x), np.array(h)
    return x, h, STEP * np.round(x[:, 0] / STEP)


@pytest.mark.parametrize("pull", [0.52, 0.8])
def test_a_machine_that_has_braked_to_rest_is_none(pull):
    """A cart without friction or weight: the sensor's last step falls in the braking, then nothing pulls any more."""
    cart = replace(pendulum(friction=0.0, mgl=0.0), inputs=(Signal("tau", "N m", -LIMIT, LIMIT),))
    u = np.concatenate([np.full(20, pull), np.full(20, -pull), np.zeros(60)])
    x, h, y = moved(u, cart)
    assert frozen(u, y, energy(cart, resolution=[STEP], rest_speed=REST), x, h) == []
    assert np.ptp(y[41:]) == 0.0  # it stands: there was something to be mistaken in


@pytest.mark.parametrize("periods", [1, 1.5, 4])
def test_an_input_on_its_way_has_moved_nothing_yet(periods):
    cart = replace(pendulum(friction=0.0, mgl=0.0), inputs=(Signal("tau", "N m", -LIMIT, LIMIT),))
    late = with_input_delay(replace(cart, with_jacobian=jacobian(cart)), periods * DT)
    u = np.concatenate([np.zeros(20), np.full(20, 0.8), np.full(20, -0.8), np.zeros(40)])
    watching = energy(late, resolution=[STEP], rest_speed=REST)
    x, h, y = moved(u, late)
    assert frozen(u, y, watching, x, h) == []
    # and frozen all the same it is found; the hidden states are the inputs on their way, the oldest first
    on_its_way = [[0.8 * (k > 20 + i) for i in range(late.delay_states)][::-1] for k in range(40)]
    pull = 0.8 * (np.arange(40) >= 20)
    assert frozen(pull, np.zeros(40), watching, np.zeros((40, 2)), np.array(on_its_way))


def test_the_range_can_be_given():
    free = energy(pendulum(), resolution=[STEP], rest_speed=REST, input_range=[2 * LIMIT])
    u, y = pulling(0.1, 0.7)
    assert frozen(u, y, free) == frozen(u, y, monitor())
    with pytest.raises(InputError, match="HM-WATCH-014"):
        energy(pendulum(), input_range=[0.0])


def test_a_missing_estimate_or_sample_begins_anew():
    u, y = pulling(0.1, 0.7)
    x = np.column_stack([y, np.zeros(100)])
    x[50:55], y[60] = np.nan, np.nan
    # The last period that begins at a missing estimate ends at sample 55. From the missing sample on 0.7 N m are what
    # the input was.
    assert frozen(u, y, monitor(), x) == [57, 58, 59]
