"""Size of each effect of the rig on its data, and what the fitted prior leaves: ``python -m`` this module."""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicHermiteSpline
from scipy.optimize import least_squares
from scipy.signal import savgol_coeffs

from hybrid_mpc import LocalPolynomial
from scenarios.golf_robot.data import DURATION, RECORD, recordings
from scenarios.golf_robot.dynamics import N_STATES, RigParameters, rhs
from scenarios.golf_robot.nominal import GEAR, PARAMETERS

Array = NDArray[np.float64]

SMOOTHING = 0.25
"""Window [s] of the differentiation, the scenario's own: noise and bias in the acceleration together are least
between 0.2 and 0.25 s (see docs/results/golf_robot.md)."""
MOVING = 0.05  # [rad/s]
PUBLISHED = {p.name: p.value for p in PARAMETERS}
FREE = [p for p in PARAMETERS if not p.fixed]


@dataclass(frozen=True)
class Motion:
    """What one recording did, free of noise, on a grid of 10 ms; ``(n,)`` each.

    The acceleration is the second difference of the angle, a mean over 20 ms around each sample; so is the torque.
    """

    phi: Array
    v: Array
    a: Array
    u: Array


@dataclass(frozen=True)
class Effects:
    """Torques on the club [N m], rms over the training runs.

    Args:
        torques: By effect.
        residual: What the prior, fitted to the true motion by least squares, leaves of the torque.
        residual_moving: The same where the club moves faster than 0.05 rad/s (no stiction).
        residual_seen: What the fitted prior leaves of a torque that is smoothed as the data are.
        residual_published: As ``residual``, with the paper's parameters.
        noise_floor: Torque noise of differentiating the encoder twice.
        fitted: The fitted parameters by name.
        largest_angle: Largest angle in the data [rad].
        largest_speed: Largest speed in the data [rad/s].
    """

    torques: dict[str, float]
    residual: float
    residual_moving: float
    residual_seen: float
    residual_published: float
    noise_floor: float
    fitted: dict[str, float]
    largest_angle: float
    largest_speed: float


def noise_floor(p: RigParameters) -> float:
    """Torque noise [N m]: J x the noise of a quartic Savitzky-Golay second derivative at 100 Hz."""
    sigma = np.hypot(p.noise, p.count / np.sqrt(12))
    return float(p.J * sigma * LocalPolynomial(SMOOTHING).noise_gain(RECORD, 2))


def measure_effects(seed: int = 0, budget: str = "quick", data_set: str = "b") -> Effects:
    """Effects over the training runs of ``make_data(seed, budget, data_set=...)``, from noise-free truth."""
    p, runs = RigParameters(), []
    for stem, table, states in recordings(seed, budget, data_set):
        if stem.startswith("train"):
            runs.append((table, states))
    motions = [motion(table, states) for table, states in runs]
    fitted, left = fit(motions)
    moving = np.concatenate([np.abs(m.v) > MOVING for m in motions])
    seen, _ = fit(motions, smoothing())
    published = [residual_torque(PUBLISHED, m) for m in motions]
    states = np.concatenate([s for _, s in runs])
    return Effects(
        torques=_torques(runs, p),
        residual=_rms(left),
        residual_moving=_rms(np.concatenate(left)[moving]),
        residual_seen=_rms([_filtered(residual_torque(seen, m), smoothing()) for m in motions]),
        residual_published=_rms(published),
        noise_floor=noise_floor(p),
        fitted={spec.name: fitted[spec.name] for spec in FREE},
        largest_angle=float(np.abs(states[:, 0]).max()),
        largest_speed=float(np.abs(states[:, 1]).max()),
    )


def motion(table: Array, states: Array) -> Motion:
    """The true motion of one recording, of which ``table`` and ``states`` come from ``recordings``."""
    t, n = table[:, 0], round(DURATION / RECORD) + 1
    path = CubicHermiteSpline(t, states[:, 0], states[:, 1])
    grid = np.clip(RECORD * np.arange(n), t[0], t[-1])
    phi, v = path(grid), path(grid, 1)
    a = (phi[2:] - 2 * phi[1:-1] + phi[:-2]) / RECORD**2
    return Motion(phi[1:-1], v[1:-1], a, (table[:-2, 2] + table[1:-1, 2]) / 2)


def residual_torque(p: dict[str, float], m: Motion) -> Array:
    """Torque ``(n,)`` [N m] that the prior with the parameters ``p`` does not explain along a motion."""
    load = np.abs(p["m"] * m.v**2 * p["a"] + p["m"] * p["g"] * np.cos(m.phi))
    friction = p["r"] * p["mu"] * np.tanh(p["gamma"] * m.v) * load
    gravity = p["m"] * p["g"] * p["a"] * np.sin(m.phi)
    return np.asarray(p["J"] * m.a + gravity + p["d"] * m.v + friction - GEAR * m.u)


def fit(motions: list[Motion], kernel: Array | None = None) -> tuple[dict[str, float], list[Array]]:
    """Prior parameters that leave the least torque, and what they leave of each motion."""

    def residuals(values: Array) -> list[Array]:
        p = PUBLISHED | dict(zip([spec.name for spec in FREE], values.tolist(), strict=True))
        return [_filtered(residual_torque(p, m), kernel) for m in motions]

    start = np.array([spec.value for spec in FREE])
    bounds = [spec.lower for spec in FREE], [spec.upper for spec in FREE]

    def joined(values: Array) -> Array:
        return np.concatenate(residuals(values))

    best = least_squares(joined, start, bounds=bounds, x_scale=start).x
    return PUBLISHED | dict(zip([s.name for s in FREE], best.tolist(), strict=True)), residuals(best)


def smoothing(window: float = SMOOTHING) -> Array:
    """Weights with which the differentiated angle averages the true acceleration (their sum is 1).

    Twice the running sum of the second derivative's coefficients: what acts on second differences.
    """
    n = 2 * LocalPolynomial(window).reach(RECORD) + 1
    taps = savgol_coeffs(n, 4, deriv=2, delta=RECORD, use="dot")
    return np.asarray(np.cumsum(np.cumsum(taps))[:-2] * RECORD**2)


def _filtered(values: Array, kernel: Array | None) -> Array:
    return values if kernel is None else np.convolve(values, kernel[::-1], "valid")


def _torques(runs: list[tuple[Array, Array]], p: RigParameters) -> dict[str, float]:
    """Rms of every torque in the equations, and of what sets the rig apart from the prior."""
    s, command = ca.SX.sym("s", N_STATES), ca.SX.sym("u")
    ds, torques = rhs(s, command, p)
    f = ca.Function("effects", [s, command], [ca.vertcat(*torques.values()), ds])
    # every second sample, in the middle of a period: at its edges the torque lags a jump of the command
    u = np.concatenate([table[1::2, 2] for table, _ in runs])
    states = np.concatenate([truth[1::2] for _, truth in runs])
    parts, rates = (np.array(value) for value in f(states.T, u[None, :]))
    named = dict(zip(torques, parts, strict=True))
    phi, v, motor, w = states[:, 0], states[:, 1], states[:, 3], states[:, 5]
    load = p.r * np.abs(p.m * p.a * v**2 + p.m * p.g * np.cos(phi))
    coulomb = -p.mu_c * load * np.tanh(PUBLISHED["gamma"] * v)
    side = p.asymmetry * np.tanh(v / p.v_d)
    gravity = (p.m * p.a * p.g - PUBLISHED["m"] * PUBLISHED["a"] * PUBLISHED["g"]) * np.sin(phi)
    sizes = {name: _rms([values]) for name, values in named.items() if name != "push"}
    return sizes | {
        "error of J": (p.J - PUBLISHED["J"]) * _rms([rates[1]]),
        "error of m g a": _rms([gravity]),
        "error of the motor constant": GEAR * abs(p.motor_gain - 1) * _rms([u]),
        "friction less Coulomb's (stiction, Stribeck, presliding)": _rms([named["friction"] - coulomb]),
        "direction of friction": _rms([coulomb * side]),
        "rotor against club (belt and backlash)": p.rotor * _rms([rates[5] - rates[1]]),
        "torque lag, 10 ms after a change": GEAR * _rms([p.motor_gain * u - motor]),
        "speed of the rotor against the club [mrad/s]": _rms([w - v]),
        "twist of the belt [mrad]": _rms([states[:, 4]]),
    }


def _rms(values: list[Array] | Array) -> float:
    return float(np.sqrt(np.mean(np.concatenate(values) ** 2 if isinstance(values, list) else values**2)))


def table(effects: Effects) -> str:
    """The figures as a Markdown table."""
    rows = [f"| {name} | {1e3 * value:.1f} |" for name, value in effects.torques.items()]
    floor = effects.noise_floor
    for name, value in (
        ("left by the published prior", effects.residual_published),
        ("left by the fitted prior", effects.residual),
        ("left by the fitted prior, moving", effects.residual_moving),
        ("left by the fitted prior, as the differentiation shows it", effects.residual_seen),
    ):
        rows.append(f"| {name} ({value / floor:.2f} x floor) | {1e3 * value:.1f} |")
    band = LocalPolynomial(SMOOTHING).bandwidth(RECORD)
    rows.append(f"| noise floor ({SMOOTHING:g} s, {band:.1f} Hz) | {1e3 * floor:.1f} |")
    fitted = ", ".join(f"{name} {value:.4g}" for name, value in effects.fitted.items())
    reach = f"largest angle {effects.largest_angle:.2f} rad, speed {effects.largest_speed:.2f} rad/s"
    return "\n".join(
        ["| torque on the club | rms [mN m] |", "| --- | --- |", *rows, "", f"Fitted: {fitted}; {reach}."]
    )


def main() -> None:
    """Print the table; with ``--figures DIR`` draw the pictures of docs/machines/golf_robot_rig.md too."""
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--budget", default="quick", help="quick or full")
    parser.add_argument("--set", default="b", dest="data_set", help="a: no sinusoids in training; b: with")
    parser.add_argument("--figures", type=Path, help="folder for the pictures")
    given = parser.parse_args()
    print(table(measure_effects(given.seed, given.budget, given.data_set)))
    if given.figures is not None:
        from scenarios.golf_robot.figures import draw

        for path in draw(given.figures, given.seed, given.budget, given.data_set):
            print(path)


if __name__ == "__main__":
    main()
