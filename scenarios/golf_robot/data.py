"""Recordings of the golf robot's rig as CSV files. No torch in here."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc import InputError, Role, Window
from scenarios.common import ROLES, sizes_of, whole_windows, write_tables
from scenarios.golf_robot.excitation import excitation
from scenarios.golf_robot.rig import Rig, RigState

Array = NDArray[np.float64]

DURATION = 20.0  # [s]
RECORD = 0.01  # period of the recording [s]
GRID = 0.02  # the input changes on this grid [s], the model's
JITTER = 0.2e-3  # standard deviation of the (recorded) time stamps [s]
COLUMNS = ("time_s", "phi_rad", "u_nm")
LARGEST = 1.5  # [rad]; a recording that goes beyond is repeated with less torque
SMALLER = 0.8  # times the torque, then
SIZES: Mapping[str, Mapping[Role, int]] = {
    "quick": {"train": 8, "valid": 3, "test": 4},
    "full": {"train": 15, "valid": 6, "test": 15},
}
TRAIN = {
    "a": ("step", "chirp", "stair", "pulse", "fastchirp"),
    "b": ("sine", "step", "chirp", "stair", "pulse", "fastsine", "fastchirp"),
}
"""Kinds of torque, in turn, of the training runs: data set (a) without sinusoids, (b) with."""
TEST_KINDS = ("sine", "pulse", "chirp", "stair", "step", "fastsine", "fastchirp")
"""Kinds of torque, in turn, of the validation and test runs, which both data sets share."""


def stems(budget: str, data_set: str = "b") -> list[str]:
    """Names of the recordings of a budget, e.g. ``train_01_sine``."""
    sizes = sizes_of("golf_robot", budget, SIZES)
    if data_set not in TRAIN:
        raise InputError(
            f"golf_robot: no data set {data_set!r}; it has: {', '.join(TRAIN)} [HM-SCENARIOS-004]"
        )
    names = []
    for role, n in sizes.items():
        kinds = TRAIN[data_set] if role == "train" else TEST_KINDS
        names += [f"{role}_{k + 1:02d}_{kinds[k % len(kinds)]}" for k in range(n)]
    return names


def windows() -> dict[str, tuple[Window, ...]]:
    """Role of every recording of both data sets by its stem."""
    return whole_windows(sorted({name for data_set in TRAIN for name in stems("full", data_set)}), DURATION)


def simulate(rig: Rig, x0: Array, u: Array, times: Array) -> list[RigState]:
    """Rig states at ``times`` ``(n,)`` [s], from ``x0`` at rest within itself at time 0."""
    state, states = rig.reset(x0, 0), []
    edges = GRID * np.arange(1, len(u))
    for time in times:
        between = edges[np.searchsorted(edges, state.t + 1e-12) : np.searchsorted(edges, time)]
        for until in (*between, time):
            if until - state.t > 1e-12:
                k = min(int((state.t + until) / 2 / GRID), len(u) - 1)
                state = rig.step(state, u[k : k + 1], float(until) - state.t)
        states.append(state)
    return states


def record(rig: Rig, kind: str, seed: tuple[int, ...]) -> tuple[Array, Array]:
    """One recording, with the rig's true states.

    The angle is sampled at the jittered times that are recorded; the torque is the one held after them. If
    the club goes beyond 1.5 rad, the recording is repeated with four fifths of the torque.
    Gives a table ``(n, 3)`` of time [s], measured angle [rad], torque [N m], and the states ``(n, 6)``.
    """
    rng = np.random.default_rng(seed)
    n = round(DURATION / RECORD) + 1
    u = excitation(kind, rng, GRID * np.arange(round(DURATION / GRID) + 1, dtype=np.float64))
    x0 = np.array([rng.uniform(-0.6, 0.6), 0.0])
    offsets = np.clip(JITTER * rng.standard_normal(n), -4 * JITTER, 4 * JITTER)
    times = np.clip(RECORD * np.arange(n) + offsets, 0.0, DURATION)
    states = simulate(rig, x0, u, times)
    while max(abs(state.z[0]) for state in states) > LARGEST:
        u = SMALLER * u
        states = simulate(rig, x0, u, times)
    phi = np.array([rig.measure(state, rng)[0] for state in states])
    return np.column_stack([times, phi, np.repeat(u, 2)[:n]]), np.array([state.z for state in states])


def recordings(seed: int, budget: str, data_set: str = "b") -> Iterator[tuple[str, Array, Array]]:
    """Stem, table and true states of each recording, as :func:`record` gives them.

    The same seed gives the same recordings; validation and test runs do not depend on the data set.
    """
    rig = Rig()
    for stem in stems(budget, data_set):
        role, number, kind = stem.split("_")
        table, states = record(rig, kind, (seed, ROLES.index(role), int(number)))
        yield stem, table, states


def make_data(folder: Path, seed: int, budget: str, *, data_set: str = "b") -> list[Path]:
    """Write the recordings of a budget as CSV files with columns time_s, phi_rad, u_nm; same seed, same files.

    Training data are without sinusoidal torques in ``data_set`` ``"a"``, with them in ``"b"``.
    """
    tables = ((stem, table) for stem, table, _ in recordings(seed, budget, data_set))
    return write_tables(folder, tables, COLUMNS)
