"""A guard whose backup estimates what broke: nothing changes without an alarm, nothing jumps with one, and it pays."""

from dataclasses import dataclass

import numpy as np
import pytest
from closed_loop_parts import ScriptedMonitor, make_ekf, run
from monitor_parts import MGL, J, pendulum

from hybrid_mpc import (
    OCP,
    CondensedController,
    Guard,
    Mode,
    SafeController,
    parameter_factors,
    parameter_filter,
    with_parameter_states,
)

DU, BROKEN = 0.4, 50
SIGMA = {"sigma_y": [1e-4], "sigma_x": [1e-5, 1e-3], "sigma_x0": [1e-3, 0.1]}


WHOLE, HEAVY = (pendulum(inertia=factor * J, mgl=factor * MGL) for factor in (1.0, 1.5))


@dataclass(frozen=True)
class Heavier:
    """A pendulum that is half as heavy again from a period on; its sensor is exact to 0.1 mrad."""

    broken: int = BROKEN

    def reset(self, x0, seed):
        return np.asarray(x0, dtype=float), 0

    def step(self, state, u, dt):
        x, k = state
        m = HEAVY if k >= self.broken else WHOLE
        return m.step(x, [], u, m.w, m.p)[0].full().ravel(), k + 1

    def measure(self, state, rng):
        return state[0][:1] + 1e-4 * rng.normal(size=1)

    def truth(self, state):
        return state[0]

    def hidden(self, state):
        return np.zeros(0)


def safe_on(model, terminal="riccati"):
    ocp = OCP(
        20, (300.0, 1.0), [0.05], [0.05], [-6.0], [6.0], [DU], terminal, working_point=([0.0, 1.0], [0.0])
    )
    return SafeController(CondensedController(model, ocp), pendulum(), safe_input=[0.0])


@pytest.fixture(scope="module")
def parts():
    """Normal model and controller, and the adaptive backup."""
    model = pendulum()
    safe = safe_on(model)
    adaptive = with_parameter_states(model, {"mass": ("J", "mgl"), "friction": ("gamma",)})
    backup = safe_on(adaptive, safe.controller.ocp.terminal_weight(model))
    guard = Guard(backup=backup, backup_estimator=parameter_filter(adaptive, 2, **SIGMA))
    return model, safe, guard


def loop(parts, monitor, guard, duration=3.0, broken=BROKEN):
    model, safe, _ = parts
    return run(
        model, safe, plant=Heavier(broken), estimator=make_ekf(model, sigma_d=5e-3), monitor=monitor, guard=guard,
        duration=duration,
    )  # fmt: skip


def test_a_false_alarm_is_hardly_felt(parts):
    plain, guarded = (
        loop(parts, ScriptedMonitor([(60, 70)]), g, 1.6, broken=10**9) for g in (None, parts[2])
    )
    assert [s.after for s in guarded.switches] == [Mode.BACKUP]
    assert np.array_equal(guarded.u[:61], plain.u[:61])
    # two filters of other noise on the same angles, noisy by 1e-4 rad; inputs are of order 1
    np.testing.assert_allclose(guarded.u, plain.u, atol=0.02)


def test_it_takes_over_within_the_limits_and_pays(parts):
    plain = loop(parts, ScriptedMonitor(), None)
    guarded = loop(parts, ScriptedMonitor([(BROKEN + 10, 10**9)]), parts[2])
    assert [s.after for s in guarded.switches] == [Mode.BACKUP]
    assert set(guarded.source) == {"MPC"}
    # rounding of sums of inputs of order 1
    assert np.max(np.abs(np.diff(guarded.u, axis=0))) <= DU + 1e-12
    late = slice(BROKEN + 25, None)
    assert np.sum(guarded.stage_cost[late]) < 0.8 * np.sum(plain.stage_cost[late])


def test_and_back(parts):
    guarded = loop(parts, ScriptedMonitor([(BROKEN + 10, BROKEN + 20)]), parts[2])
    assert [s.after for s in guarded.switches] == [Mode.BACKUP, Mode.NORMAL]
    assert np.max(np.abs(np.diff(guarded.u, axis=0))) <= DU + 1e-12
    assert np.all(np.isfinite(guarded.x))


def test_its_filter_has_learned_before_it_is_needed(parts):
    estimator, seen = parts[2].backup_estimator, loop(parts, ScriptedMonitor(), None)
    estimate = estimator.start(seen.y[0])
    for k in range(1, BROKEN + 25):
        estimate = estimator.update(estimate, seen.y[k], seen.u[k - 1])
    assert parameter_factors(estimate.h)[0] == pytest.approx(1.5, abs=0.1)  # half a second of noisy angles
