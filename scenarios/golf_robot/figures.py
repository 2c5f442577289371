"""Pictures of the golf robot's rig for its page: ``python -m scenarios.golf_robot.effects --figures DIR``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from hybrid_mpc import Fault, corrupt_input, corrupt_measurement
from hybrid_mpc.plots import colour, new_figure, save, shared_legend, title_axes
from scenarios.golf_robot.data import recordings
from scenarios.golf_robot.dynamics import N_STATES, RigParameters, rhs
from scenarios.golf_robot.effects import PUBLISHED, fit, motion, noise_floor, residual_torque
from scenarios.golf_robot.faults import catalogue
from scenarios.golf_robot.rig import Rig

Array = NDArray[np.float64]

PAPER = ("sine", "step", "chirp")
RECORDING = "train_03_chirp"  # the one whose residual is drawn, if there is one of that name
SPEED, ANGLE, TORQUE = "club speed [rad/s]", "angle [rad]", "motor torque [N m]"
RED, BLUE, GREY = colour("hybrid"), colour("prior"), colour("")


def draw(folder: Path, seed: int = 0, budget: str = "quick", data_set: str = "b") -> list[Path]:
    """Draw friction over speed, the residual torque, the coverage and the faults as PNG files."""
    runs = [run for run in recordings(seed, budget, data_set) if run[0].startswith("train")]
    figures = {
        "golf_friction": friction(RigParameters()),
        "golf_residual": residual(runs),
        "golf_coverage": coverage(runs),
        "golf_faults": faults(),
    }
    return [save(figure, folder / f"{name}.png") for name, figure in figures.items()]


def friction(p: RigParameters) -> Figure:
    """Friction of the hanging club over speed: steady, in a slow reversal, and the prior's."""
    figure, axes = _panels(1, 2, title="Friction of the hanging club", size=(10, 4))
    s, u = ca.SX.sym("s", N_STATES), ca.SX.sym("u")
    f = ca.Function("friction", [s, u], [rhs(s, u, p)[1]["friction"]])
    load = p.r * p.m * p.g
    for ax, reach in zip(axes, (4.0, 0.3), strict=True):
        v = np.linspace(-reach, reach, 801)
        side = 1 + p.asymmetry * np.tanh(v / p.v_d)
        level = side * (p.mu_c + (p.mu_s - p.mu_c) * np.exp(-((v / p.v_s) ** 2))) * np.sign(v)
        states = np.zeros((N_STATES, v.size))
        states[1], states[2] = v, level
        steady = -f(states, np.zeros((1, v.size))).full().ravel()
        bearing = np.abs(PUBLISHED["m"] * PUBLISHED["a"] * v**2 + PUBLISHED["m"] * PUBLISHED["g"])
        prior = PUBLISHED["r"] * PUBLISHED["mu"] * np.tanh(PUBLISHED["gamma"] * v) * bearing
        ax.plot(v, prior, color=BLUE, label="prior, published parameters")
        ax.plot(v, steady, color=RED, label="rig, steady sliding")
        ax.set(xlabel=SPEED, ylabel="friction torque [N m]")
    axes[1].plot(*_slow_loop(p), color=GREY, linewidth=0.9, label="rig, slow oscillation")
    axes[1].set(xlim=(-0.3, 0.3), ylim=(-1.4 * p.mu_s * load, 1.4 * p.mu_s * load))
    title_axes(axes[0], "whole range: the load grows with the speed")
    title_axes(axes[1], "near rest: Stribeck, presliding, direction")
    shared_legend(figure)
    return figure


def _panels(
    rows: int, cols: int, *, title: str, size: tuple[float, float], share: bool = False
) -> tuple[Figure, list[Any]]:
    figure, axes = new_figure(rows, cols, title=title, size=size, sharex=share, sharey=share)
    return figure, list(axes.flat)


def _slow_loop(p: RigParameters) -> tuple[Array, Array]:
    """Speed and friction torque while the motor rocks the club slowly around the bottom."""
    s, u = ca.SX.sym("s", N_STATES), ca.SX.sym("u")
    f = ca.Function("friction", [s, u], [rhs(s, u, p)[1]["friction"]])
    rig, speeds, torques = Rig(p), [], []
    state = rig.reset(np.zeros(2), 0)
    for k in range(5000):
        torque = 0.09 * np.sin(2 * np.pi * 0.3 * 2e-3 * k)
        state = rig.step(state, np.array([torque]), 2e-3)
        if k > 1700:
            speeds.append(state.z[1])
            torques.append(-float(f(state.z, torque)))
    return np.array(speeds), np.array(torques)


def residual(runs: list[tuple[str, Array, Array]]) -> Figure:
    """What the fitted prior leaves of the torque: along one recording, and over the speed in all."""
    figure, axes = _panels(1, 2, title="Torque that the fitted prior leaves", size=(10, 4))
    motions = {stem: motion(table, states) for stem, table, states in runs}
    fitted, _ = fit(list(motions.values()))
    stem = RECORDING if RECORDING in motions else next(iter(motions))
    left, right = axes
    one, floor = motions[stem], noise_floor(RigParameters())
    t = 0.01 * np.arange(1, len(one.v) + 1)
    part = (t > 5.0) & (t < 15.0)
    left.axhspan(-floor, floor, color="#dddddd", label="noise floor (one sigma)")
    left.plot(t[part], residual_torque(fitted, one)[part], color=RED, linewidth=1.0, label="residual")
    left.set(xlabel="time [s]", ylabel="torque on the club [N m]")
    title_axes(left, f"along {stem}")
    v = np.concatenate([m.v for m in motions.values()])
    r = np.concatenate([residual_torque(fitted, m) for m in motions.values()])
    right.axhspan(-floor, floor, color="#dddddd")
    right.plot(v[::3], r[::3], ".", color=RED, markersize=1.0, alpha=0.4)
    right.set(xlabel=SPEED, ylabel="torque on the club [N m]", ylim=(-0.35, 0.35))
    title_axes(right, "all training data")
    shared_legend(figure)
    return figure


def coverage(runs: list[tuple[str, Array, Array]]) -> Figure:
    """Where the training data are: angle and speed, speed and torque."""
    figure, axes = _panels(1, 2, title="What the training data cover", size=(10, 4.4))
    groups = (("of the paper's size", BLUE, True), ("up to 0.5 N m", RED, False))
    for name, ink, wanted in groups:
        chosen = [run for run in runs if (run[0].split("_")[2] in PAPER) is wanted]
        for k, (_, table, states) in enumerate(chosen):
            label = name if k == 0 else None
            axes[0].plot(states[::2, 0], states[::2, 1], color=ink, linewidth=0.5, label=label)
            axes[1].plot(states[::2, 1], table[::2, 2], ".", color=ink, markersize=1.0)
    box = [-0.9, 0.9, 0.9, -0.9, -0.9], [-4, -4, 4, 4, -4]
    axes[0].plot(*box, color="#222222", linestyle="--", label="range of the tasks")
    axes[1].plot([-4, 4, 4, -4, -4], [-0.5, -0.5, 0.5, 0.5, -0.5], color="#222222", linestyle="--")
    axes[0].set(xlabel=ANGLE, ylabel=SPEED)
    axes[1].set(xlabel=SPEED, ylabel=TORQUE)
    shared_legend(figure)
    return figure


def faults() -> Figure:
    """What the encoder shows with each fault of the catalogue, under the same torque, from 2 s on."""
    cases = [case for case in catalogue(2.0) if not case.nominal]
    figure, axes = _panels(
        4, 4, title="The encoder's angle with each fault, under the same torque (grey: healthy)",
        size=(12, 8), share=True,
    )  # fmt: skip
    healthy = _measured(())
    t = 0.02 * np.arange(len(healthy))
    for ax, case in zip(axes, cases, strict=False):
        ax.plot(t, healthy, color=GREY, linewidth=1.0)
        ax.plot(t, _measured(case.faults), color=RED, linewidth=1.0)
        ax.axvline(2.0, color="#222222", linewidth=0.6, linestyle=":")
        title_axes(ax, case.title)
    for ax in axes[len(cases) :]:
        ax.set_visible(False)
    for ax in axes[::4]:
        ax.set_ylabel(ANGLE)
    for ax in axes[12:]:
        ax.set_xlabel("time [s]")
    return figure


def _measured(faults: tuple[Fault, ...]) -> Array:
    rig = Rig().with_faults([fault for fault in faults if fault.on_plant])
    outside = [fault for fault in faults if not fault.on_plant]
    state, rng, seen = rig.reset(np.zeros(2), 0), np.random.default_rng(0), []
    y = np.full(1, np.nan)
    for k in range(400):
        t = 0.02 * k
        y = corrupt_measurement(outside, t, rig.measure(state, rng), y)
        seen.append(y[0])
        u = np.array([0.25 * np.sin(2 * np.pi * 0.35 * t)])
        state = rig.step(state, corrupt_input(outside, t, u), 0.02)
    return np.array(seen)
