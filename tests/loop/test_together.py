"""Loops side by side: each is what it is alone."""

import time
from dataclasses import dataclass, fields

import numpy as np
import pytest
from online_models import linear_model

from hybrid_mpc import (
    OCP,
    ClosedLoopResult,
    CondensedController,
    ExtendedKalmanFilter,
    Fault,
    InputError,
    SafeController,
    SwitchingFilter,
)
from hybrid_mpc.estimate.switching import FilterBank
from hybrid_mpc.loop.simulate import Simulation, simulate_together

A, B, DT = np.array([[1.0, 0.1], [-0.1, 0.9]]), np.array([[0.0], [0.1]]), 0.1


@dataclass(frozen=True)
class Plant:
    """The linear model itself, with a load that its filter does not know of."""

    gain: float = 1.0

    def reset(self, x0, seed):
        return np.asarray(x0, dtype=float)

    def step(self, state, u, dt):
        return A @ state + B @ (u + 0.3)

    def measure(self, state, rng):
        return self.gain * state[:1] + 1e-3 * rng.normal(size=1)

    def truth(self, state):
        return state

    def hidden(self, state):
        return np.zeros(0)


def switching(gain=1.0):
    model = linear_model(A, B, np.array([[gain, 0.0]]))
    return SwitchingFilter(
        [
            ExtendedKalmanFilter(
                model, sigma_y=[1e-3], sigma_x=[1e-3, 1e-3], sigma_x0=[0.1, 0.1], sigma_d=[step]
            )
            for step in (1e-3, 0.1)
        ],
        [[0.99, 0.01], [0.5, 0.5]],
    )


def makers(filters, gain=1.0, seeds=3, duration=2.0, **more):
    safe = SafeController(
        CondensedController(filters.model, OCP(5, [1.0, 0.1], [0.01], [0.01], [-2.0], [2.0]))
    )

    def make(seed):
        return lambda estimator: Simulation(
            Plant(gain), estimator, safe, [0.3, 0.0], dt=DT, x0=[0.0, 0.0], seed=seed,
            duration=duration + seed * more.get("longer", 0.0),
            faults=[Fault(0.5, 0.8, "measurement_dropout")] if seed == 1 else (),
        )  # fmt: skip

    return [make(seed) for seed in range(seeds)]


@pytest.mark.parametrize(("gain", "atol"), [(1.0, 1e-8), (2.0, 0.0)])  # what is no first state takes turns
def test_together_is_alone(gain, atol):
    filters = switching(gain)
    made = makers(filters, gain)
    for found, make in zip(simulate_together(filters, made), made, strict=True):
        wanted = make(filters).run()
        for field in fields(ClosedLoopResult):
            if field.name == "timing_ms":
                continue
            one, other = getattr(found, field.name), getattr(wanted, field.name)
            if isinstance(other, np.ndarray) and other.dtype == np.float64:
                # rounding; a nis is a square over a variance of 1e-6
                scale = 1e3 if field.name == "nis" else 1.0
                np.testing.assert_allclose(one, other, rtol=0, atol=scale * atol, err_msg=field.name)
            else:
                np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("gain", [1.0, 2.0])
def test_loops_of_different_length_are_refused(gain):
    filters = switching(gain)
    with pytest.raises(InputError, match="loops of 20, 25 periods given"):
        simulate_together(filters, makers(filters, gain, seeds=2, longer=0.5))
    assert simulate_together(filters, []) == []


def test_the_time_of_what_is_done_together_is_shared_out(monkeypatch):
    spent, update = [], FilterBank.update

    def slow(bank, y, u):
        begin = time.perf_counter()
        time.sleep(0.05)
        estimates = update(bank, y, u)
        spent.append(1e3 * (time.perf_counter() - begin))
        return estimates

    monkeypatch.setattr(FilterBank, "update", slow)
    filters = switching()
    timings = [r.timing_ms for r in simulate_together(filters, makers(filters, seeds=2, duration=0.5))]
    for timing in timings:
        assert np.all(timing["estimate"][1:] >= np.array(spent) / 2)
        parts = [timing[name] for name in ("estimate", "solve", "monitor", "prepare")]
        np.testing.assert_allclose(timing["total"], np.sum(parts, axis=0), rtol=1e-12)
    # all but what the loops spend besides, far less than the sleep
    assert sum(timing["estimate"].sum() for timing in timings) < 1.5 * sum(spent)


def test_a_simulation_runs_what_is_left():
    filters = switching()
    (make,) = makers(filters, seeds=1)
    whole, begun = make(filters).run(), make(filters)
    begun.measure()
    begun.go_on()
    np.testing.assert_array_equal(begun.run().x, whole.x)
