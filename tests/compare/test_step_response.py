"""Rise, settling, overshoot and offset against what a second-order answer has in closed form."""

import math

import numpy as np
import pytest

from hybrid_mpc import OCP, Prior, Signal
from hybrid_mpc.compare.step_response import step_response, step_responses

T = np.arange(0.0, 30.0, 0.005)


class Mass(Prior):
    """A mass that a force moves; its position is measured in millimetres."""

    states = (Signal("q", "m"), Signal("v", "m/s"))
    inputs = (Signal("F", "N"),)
    outputs = (Signal("y", "mm"),)

    def xdot(self, x, u, w, p):
        return x.v, u.F

    def output(self, x, u, w, p):
        return (1e3 * x.q,)


def second_order(zeta, size=1.0, start=0.0):
    """Step answer of ``1 / (s^2 + 2 zeta s + 1)`` from 0 s on."""
    w = math.sqrt(1 - zeta**2)
    return start + size * (1 - np.exp(-zeta * T) * (np.cos(w * T) + zeta / w * np.sin(w * T)))


@pytest.mark.parametrize("zeta", [0.3, 0.5, 0.7])
@pytest.mark.parametrize(("size", "start"), [(1.0, 0.0), (-4.0, 1.0), (2e-5, 300.0)])
def test_it_is_that_of_a_second_order_system(zeta, size, start):
    y = second_order(zeta, size, start)
    found = step_response(T, y, np.full(T.size, start + size))
    over = 100 * math.exp(-math.pi * zeta / math.sqrt(1 - zeta**2))
    assert found.overshoot == pytest.approx(over, rel=2e-3)  # of the grid
    outside = np.abs(y - start - size) > 0.05 * abs(size)
    assert found.settling == pytest.approx(T[outside][-1], abs=0.011)
    inner = (y - start) / size
    assert found.rise == pytest.approx(T[inner >= 0.9][0] - T[inner >= 0.1][0], abs=0.011)
    assert abs(found.offset) < 1e-3 * abs(size)


def test_the_last_set_point_counts_from_where_it_is_given():
    reference = np.where(T < 10.0, 0.0, 2.0)
    y = np.where(T < 10.0, 0.0, 2.0 * (1 - np.exp(-np.maximum(T - 10.0, 0.0))))
    found = step_response(T, y, reference)
    assert found.settling == pytest.approx(-math.log(0.05), abs=0.011)
    assert found.overshoot == pytest.approx(0.0, abs=1e-6)


def test_an_offset_that_stays_is_told_with_its_sign():
    found = step_response(T, 0.97 * (1 - np.exp(-T)), np.ones(T.size))
    assert found.offset == pytest.approx(-0.03, abs=1e-6)
    assert found.settling is not None  # within 5 %


def test_a_load_that_is_rejected_is_no_step():
    noise = 1e-3 * np.random.default_rng(0).standard_normal(T.size)
    found = step_response(T, np.exp(-((T - 5.0) ** 2)) + noise, np.zeros(T.size))
    assert (found.rise, found.settling, found.overshoot) == (None, None, None)


def test_a_reference_that_arrives_slowly_asks_for_no_rise():
    reference = np.minimum(T / 10.0, 1.0)
    late = np.interp(T - 1.0, T, reference)  # a second behind: 0.1 is missing where the reference arrives
    found = step_response(T, late, reference)
    assert (found.rise, found.settling, found.overshoot) == (None, None, None)
    assert found.offset == pytest.approx(0.0, abs=1e-12)


def test_a_pulse_that_comes_back_is_no_step():
    """The speed of a stroke: nothing, at one sample the speed of the impact, then rest."""
    reference = np.where(np.abs(T - 10.0) < 0.0025, 2.0, 0.0)
    y = np.where(T < 10.0, 2.0 * np.exp(np.minimum(T - 10.0, 0.0)), 2.0 * np.exp(-np.maximum(T - 10.0, 0.0)))
    found = step_response(T, y, reference)
    assert (found.rise, found.settling, found.overshoot) == (None, None, None)
    assert found.offset == pytest.approx(0.0, abs=1e-6)
    held = np.where(np.abs(T - 7.5) < 2.5, 2.0, 0.0)  # the same way back from a level that was held
    assert step_response(T, y, held).settling == pytest.approx(-math.log(0.05), abs=0.011)


def test_the_jump_of_a_speed_belongs_to_the_motion_of_its_position():
    machine = Mass()
    assert machine.kinematics == ((0, 1),)
    ocp = OCP(5, [1.0, 1.0], [1.0], [0.0], [-1.0], [1.0])
    speed = np.where(T < 10.0, 1.0, 0.0)
    x = np.stack([np.minimum(T, 10.0), np.where(T < 10.0, 1.0, np.exp(-np.maximum(T - 10.0, 0.0)))], axis=1)
    ramp = np.stack([np.minimum(T, 10.0), speed], axis=1)  # at 10 s it stops
    found = step_responses(ocp, machine, {"t": T, "x": x, "reference": ramp})
    assert [answer.settling for answer in found.values()] == [None, None]
    alone = np.stack(
        [np.zeros(T.size), speed], axis=1
    )  # the same speed, and nothing is asked of the position
    _, v = step_responses(ocp, machine, {"t": T, "x": x, "reference": alone}).values()
    assert v.settling == pytest.approx(-math.log(0.05), abs=0.011)


def test_what_never_arrives_has_no_rise():
    found = step_response(T, 0.8 * (1 - np.exp(-T)), np.ones(T.size))  # a fifth is missing
    assert (found.rise, found.settling) == (None, None)
    assert found.overshoot == pytest.approx(0.0)
    assert found.offset == pytest.approx(-0.2, abs=1e-6)


def test_a_load_that_moves_more_than_the_first_deviation_is_no_step():
    found = step_response(T, 1e-3 * np.exp(-T) + np.exp(-((T - 5.0) ** 2)), np.zeros(T.size))
    assert found.overshoot is None


def test_samples_that_are_missing_are_left_out():
    y = second_order(0.5)
    y[::7] = np.nan
    assert step_response(T, y, np.ones(T.size)).overshoot == pytest.approx(16.3, abs=0.1)


def test_signals_that_the_problem_weighs_have_one():
    machine = Mass()
    loop = {
        "t": T, "x": np.stack([second_order(0.5), T], axis=1), "reference": np.tile([1.0, 0.0], (T.size, 1)),
        "y": 1e3 * second_order(0.7)[:, None], "y_ref": np.full((T.size, 1), 1e3),
    }  # fmt: skip
    by_state = step_responses(OCP(5, [1.0, 0.0], [1.0], [0.0], [-1.0], [1.0]), machine, loop)
    assert [s.label for s in by_state] == ["q [m]"]
    by_output = step_responses(OCP(5, [0.0, 0.0], [1.0], [0.0], [-1.0], [1.0], q_y=[1.0]), machine, loop)
    assert by_output[machine.outputs[0]].overshoot == pytest.approx(4.6, abs=0.05)


def test_nothing_that_a_loop_may_look_like_raises():
    """The report is written of whatever came: samples that are missing or infinite, jumps, drift, rest."""
    rng = np.random.default_rng(0)
    for _ in range(500):
        n = int(rng.integers(5, 200))
        t = 0.1 * np.arange(n)
        y = np.cumsum(rng.standard_normal(n)) * rng.choice([0, 1e-9, 1, 1e6]) + rng.choice([0, 1, -3])
        if rng.random() < 0.3:
            y[rng.integers(0, n, 3)] = rng.choice([np.nan, np.inf, 0.0])
        reference = np.where(
            t < t[-1] * rng.random(), rng.choice([0.0, 1.0, -2.0]), rng.choice([0.0, 1.0, 5.0])
        )
        found = step_response(t, y, reference)
        assert found is None or np.isfinite(found.offset)
