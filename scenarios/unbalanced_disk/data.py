"""Recordings of the simulated disk, files like those of the real one. No torch in here."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc import Role, chirp, multisine, random_steps, write_arrays
from scenarios.common import ROLES, sizes_of
from scenarios.unbalanced_disk.nominal import DT
from scenarios.unbalanced_disk.plant import DiskPlant

Array = NDArray[np.float64]

SAMPLES = 1000
"""Of a recording: 25 s, the pieces of the real ones."""
PEAK = 3.0  # [V]
LARGEST = 2.8
"""Angle [rad]: a recording that goes beyond is repeated with less voltage. Over the top every error multiplies."""
SMALLER = 0.9  # times the voltage, then
SIZES: Mapping[str, Mapping[Role, int]] = {
    "quick": {"train": 8, "valid": 3, "test": 4},
    "full": {"train": 20, "valid": 6, "test": 8},
}


def _multisine(
    rng: np.random.Generator, t: Array, least: float = 0.6, low: float = 0.56, high: float = 2.6
) -> Array:
    u = multisine(t, rng.uniform(least, 1.0) * PEAK, low, high)
    return np.roll(u, int(rng.integers(len(t))))


def _swing(rng: np.random.Generator, t: Array) -> Array:
    f0, f1 = rng.permutation([rng.uniform(0.9, 1.2), rng.uniform(1.7, 2.1)])
    return chirp(t, rng.uniform(0.5, 1.0) * PEAK, f0, f1)


def _step(rng: np.random.Generator, t: Array) -> Array:
    return random_steps(t, -PEAK, PEAK, hold=(0.15, 1.2), rng=rng)


KINDS: Mapping[str, Callable[[np.random.Generator, Array], Array]] = {
    "multisine": _multisine, "swing": _swing, "step": _step,
    "wide": partial(_multisine, least=0.8, low=0.5, high=10.6),
}  # fmt: skip
"""Voltages: multisines of the band of the recording of 2024 (0.56 to 2.6 Hz) and of 2022 (to 10.6 Hz), chirps through
the disk's own 1.9 Hz, which swing far, and steps."""


def stems(budget: str) -> list[str]:
    """Names of the recordings of a budget, e.g. ``train_01_multisine``; the kinds take turns."""
    kinds, sizes = list(KINDS), sizes_of("unbalanced_disk", budget, SIZES)
    return [f"{role}_{k + 1:02d}_{kinds[k % len(kinds)]}" for role, n in sizes.items() for k in range(n)]


def record(plant: DiskPlant, kind: str, seed: tuple[int, ...]) -> tuple[Array, Array]:
    """One recording: voltages commanded ``(n,)`` [V] and encoder angles at the same instants ``(n,)`` [rad].

    If the disk goes beyond 2.8 rad, the recording is repeated with nine tenths of the voltage.
    """
    rng = np.random.default_rng(seed)
    u = KINDS[kind](rng, DT * np.arange(SAMPLES, dtype=np.float64))
    x0 = np.array([rng.uniform(-0.4, 0.4), 0.0])
    while True:
        state, angles = plant.reset(x0, 0), np.empty(SAMPLES)
        for k in range(SAMPLES):
            angles[k] = plant.measure(state, rng)[0]
            if abs(angles[k]) > LARGEST:
                break
            state = plant.step(state, u[k : k + 1], DT)
        else:
            return u, angles
        u = SMALLER * u


def make_data(folder: Path, seed: int, budget: str) -> list[Path]:
    """Write the recordings of a budget as ``.npz`` files with ``u`` [V], ``th`` [rad], ``dt`` [s], as the real ones."""
    plant, paths = DiskPlant(), []
    for stem in stems(budget):
        role, number, kind = stem.split("_")
        u, th = record(plant, kind, (seed, ROLES.index(role), int(number)))
        path = folder / f"{stem}.npz"
        write_arrays(path, {"u": u, "th": th, "dt": np.array(DT)})
        paths.append(path)
    return paths
