"""Recordings of the golf robot's rig as CSV files. No torch in here."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.scenario import Role, Window
from scenarios.golf_robot.rig import Rig

Array = NDArray[np.float64]

DURATION = 20.0  # [s]
RECORD = 0.01  # period of the recording [s]
GRID = 0.02  # the input changes on this grid [s], the model's
JITTER = 0.2e-3  # standard deviation of the (recorded) time stamps [s]
KINDS = ("sine", "step", "chirp")
SIZES: Mapping[str, Mapping[Role, int]] = {
    "quick": {"train": 8, "valid": 3, "test": 4},
    "full": {"train": 15, "valid": 6, "test": 15},
}


def stems(budget: str) -> list[str]:
    """Names of the recordings of a budget, e.g. ``train_01_sine``.

    Raises:
        InputError: If there is no such budget.

    Example:
        >>> stems("quick")[:2], len(stems("full"))
        (['train_01_sine', 'train_02_step'], 36)
    """
    if budget not in SIZES:
        raise InputError(f"golf_robot: no budget {budget!r}; it has: {', '.join(SIZES)}")
    return [f"{role}_{k + 1:02d}_{KINDS[k % 3]}" for role, n in SIZES[budget].items() for k in range(n)]


def windows() -> dict[str, tuple[Window, ...]]:
    """Role of every recording by its stem: all of it is training, validation or test."""
    roles: tuple[Role, ...] = ("train", "valid", "test")
    names = stems("full")
    return {s: (Window(0.0, DURATION, role),) for role in roles for s in names if s.startswith(role)}


def excitation(kind: str, rng: np.random.Generator, n: int) -> Array:
    """Motor torque ``(n,)`` [N m] on the grid of 20 ms.

    Args:
        kind: ``"sine"`` (0.08 to 0.16 N m, 0.15 to 0.9 Hz), ``"step"`` (up to 0.25 N m, held 1 to 3 s) or
            ``"chirp"`` (0.08 to 0.16 N m, 0.1 to 1.2 Hz, up or down).
        rng: Source of amplitudes and frequencies.
        n: Number of samples.

    Example:
        >>> excitation("sine", np.random.default_rng(0), 3).shape
        (3,)
    """
    t = GRID * np.arange(n)
    if kind == "step":
        starts = np.cumsum(rng.uniform(1.0, 3.0, size=n))
        return rng.uniform(-0.25, 0.25, size=n + 1)[np.searchsorted(starts, t, side="right")]
    amplitude, phase = rng.uniform(0.08, 0.16), rng.uniform(0.0, 2 * np.pi)
    if kind == "sine":
        return amplitude * np.sin(2 * np.pi * rng.uniform(0.15, 0.9) * t + phase)
    f0, f1 = rng.permutation([rng.uniform(0.1, 0.3), rng.uniform(0.8, 1.2)])
    return amplitude * np.sin(2 * np.pi * (f0 * t + (f1 - f0) * t**2 / (2 * n * GRID)) + phase)


def simulate(rig: Rig, x0: Array, u: Array, times: Array) -> Array:
    """Rig states ``(n, 4)`` at ``times`` ``(n,)`` [s], from ``x0`` at rest within itself at time 0.

    Args:
        rig: The rig.
        x0: Initial ``(phi, phi_dot)``.
        u: Torque ``(n_u,)`` [N m] held over periods of 20 ms from time 0.
        times: Increasing times [s], none negative, within the torque's length.
    """
    state, now, states = rig.reset(x0, 0), 0.0, []
    edges = GRID * np.arange(1, len(u))
    for time in times:
        for edge in edges[np.searchsorted(edges, now + 1e-12) : np.searchsorted(edges, time)]:
            state, now = _advance(rig, state, u, now, float(edge))
        state, now = _advance(rig, state, u, now, float(time))
        states.append(state)
    return np.array(states)


def _advance(rig: Rig, state: Array, u: Array, now: float, until: float) -> tuple[Array, float]:
    if until - now < 1e-12:
        return state, now
    k = min(int(np.floor((now + until) / 2 / GRID)), len(u) - 1)
    return rig.step(state, u[k : k + 1], until - now), until


def record(rig: Rig, kind: str, seed: tuple[int, ...]) -> tuple[Array, Array]:
    """One recording: table ``(n, 3)`` of time [s], measured angle [rad], torque [N m]; true states.

    The angle is sampled at the jittered times that are recorded; the torque is the one held after them.
    """
    rng = np.random.default_rng(seed)
    n = round(DURATION / RECORD) + 1
    u = excitation(kind, rng, round(DURATION / GRID) + 1)
    x0 = np.array([rng.uniform(-0.6, 0.6), 0.0])
    offsets = np.clip(JITTER * rng.standard_normal(n), -4 * JITTER, 4 * JITTER)
    nominal = RECORD * np.arange(n)
    times = np.clip(nominal + offsets, 0.0, DURATION)
    states = simulate(rig, x0, u, times)
    phi = np.array([rig.measure(s, rng)[0] for s in states])
    return np.column_stack([times, phi, np.repeat(u, 2)[:n]]), states


def make_data(folder: Path, seed: int, budget: str) -> list[Path]:
    """Write the recordings of a budget as CSV files with columns time_s, phi_rad, u_nm.

    Args:
        folder: Where to; made if missing. Files of the same name are replaced whole.
        seed: Same seed, same files.
        budget: ``"quick"`` (8 training, 3 validation, 4 test runs of 20 s) or ``"full"`` (15, 6, 15).

    Returns:
        The files.

    Raises:
        InputError: If there is no such budget.

    Example:
        >>> make_data(Path("out"), 0, "none")
        Traceback (most recent call last):
        ...
        hybrid_mpc.errors.InputError: golf_robot: no budget 'none'; it has: quick, full
    """
    names, rig, paths = stems(budget), Rig(), []
    folder.mkdir(parents=True, exist_ok=True)
    for stem in names:
        role, number, kind = stem.split("_")
        table, _ = record(rig, kind, (seed, tuple(SIZES["full"]).index(_role(role)), int(number)))
        path = folder / f"{stem}.csv"
        part = path.with_name(path.name + ".part")
        np.savetxt(part, table, "%.6f", delimiter=",", header="time_s,phi_rad,u_nm", comments="")
        os.replace(part, path)
        paths.append(path)
    return paths


def _role(name: str) -> Role:
    return "train" if name == "train" else "valid" if name == "valid" else "test"
