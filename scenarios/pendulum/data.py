"""Recordings of the paper's pendulum: CSV files for the main job, exact runs for its experiment. No torch."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc import InputError, Role, Trajectory, sinusoid
from scenarios.common import ROLES, sizes_of, write_tables
from scenarios.pendulum.plant import DampedPendulum

Array = NDArray[np.float64]

DURATION = 5.0  # [s], the paper's
RECORD = 1e-3  # period of the recording [s], the paper's
HELD = 10  # samples for which the torque is held: the model's period of 10 ms
COLUMNS = ("time_s", "phi_rad", "phi_dot_rad_s", "u_nm")
AMPLITUDE = (4.0, 20.0)  # [N m]; gravity asks for at most 22.1
FREQUENCY = (0.2, 2.0)  # [Hz]; the pendulum's own is 2.3
ANGLE, SPEED = 1.5, 5.0  # largest of x0 [rad], [rad/s]
SIZES: Mapping[str, Mapping[Role, int]] = {
    "quick": {"train": 6, "valid": 3, "test": 4},
    "full": {"train": 15, "valid": 5, "test": 10},
}


def stems(budget: str) -> list[str]:
    """Names of the recordings of a budget, e.g. ``train_01``."""
    return [
        f"{role}_{k + 1:02d}" for role, n in sizes_of("pendulum", budget, SIZES).items() for k in range(n)
    ]


def simulate(plant: DampedPendulum, x0: Array, u: Array) -> Array:
    """States ``(n, 2)`` every millisecond from ``x0`` ``(2,)`` under torques ``u`` ``(n,)`` [N m]."""
    state, states = plant.reset(x0, 0), []
    for torque in u:
        states.append(plant.truth(state))
        state = plant.step(state, np.array([torque]), RECORD)
    return np.array(states)


def run(plant: DampedPendulum, role: Role, number: int, seed: int) -> tuple[Array, Array, Array]:
    """One run of 5 s: a sinusoidal torque of random size, frequency and phase from a random x0.

    The torque is held for a model period of 10 ms: a discrete-time model can then be exact. The runs of fewer
    are the first of more. Gives times, torque ``(n,)`` [N m] and true states ``(n, 2)``, every millisecond.
    """
    rng = np.random.default_rng((seed, ROLES.index(role), number))
    t = RECORD * np.arange(round(DURATION / RECORD) + 1, dtype=np.float64)
    amplitude, frequency = rng.uniform(*AMPLITUDE), rng.uniform(*FREQUENCY)
    grid = t[::HELD] + HELD * RECORD / 2  # the sinusoid in the middle of each period
    u = np.repeat(sinusoid(grid, amplitude, frequency, phase=rng.uniform(0, 2 * np.pi)), HELD)[: len(t)]
    x0 = np.array([rng.uniform(-ANGLE, ANGLE), rng.uniform(-SPEED, SPEED)])
    return t, u, simulate(plant, x0, u)


def exact_runs(role: Role, count: int, *, seed: int = 0, dt: float = HELD * RECORD) -> list[Trajectory]:
    """The paper's data: runs with the full state measured and without noise, for its experiment.

    The first 3 of 15 training runs are those of 3. ``dt`` [s] is 1, 2, 5 or 10 ms; the paper has 1 ms. ``xdot`` is the
    exact derivative at the samples.
    """
    every = round(dt / RECORD)
    if abs(every * RECORD - dt) > 1e-9 or every < 1 or HELD % every:
        raise InputError(f"pendulum: dt must be 0.001, 0.002, 0.005 or 0.01 s, got {dt} [HM-SCENARIOS-042]")
    if role not in ROLES:
        raise InputError(f"pendulum: no role {role!r}; there are: {', '.join(ROLES)} [HM-SCENARIOS-043]")
    plant, out = DampedPendulum(noise=0.0), []
    for number in range(1, count + 1):
        t, u, x = (values[::every] for values in run(plant, role, number, seed))
        xdot = np.column_stack([x[:, 1], plant.acceleration(x, u)])
        out.append(Trajectory(f"{role}_{number:02d}", role, dt, t, u[:, None], x[:, :1], x, xdot))
    return out


def recordings(seed: int, budget: str) -> Iterator[tuple[str, Array]]:
    """Stem and table ``(n, 4)`` of each recording: time [s], angle [rad], speed [rad/s], torque [N m].

    The angle has the plant's noise; the speed is true: the main job reads the angle alone.
    """
    plant = DampedPendulum()
    for stem in stems(budget):
        name, number = stem.split("_")
        role = ROLES[ROLES.index(name)]
        t, u, x = run(plant, role, int(number), seed)
        noise = np.random.default_rng((seed, ROLES.index(role), int(number), 1)).standard_normal(len(t))
        yield stem, np.column_stack([t, x[:, 0] + plant.noise * noise, x[:, 1], u])


def make_data(folder: Path, seed: int, budget: str) -> list[Path]:
    """Write the recordings of a budget as CSV files with columns time_s, phi_rad, phi_dot_rad_s, u_nm."""
    return write_tables(folder, recordings(seed, budget), COLUMNS)
