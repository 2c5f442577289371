"""Size of each effect of the rig on its data, and what the fitted prior leaves: ``python -m`` this module."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.signal import savgol_coeffs

from scenarios.golf_robot.data import RECORD, record, stems
from scenarios.golf_robot.nominal import GEAR, PARAMETERS
from scenarios.golf_robot.rig import Rig, RigParameters, rhs

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Effects:
    """Torques on the club [N m], rms over the training runs.

    Args:
        torques: By effect.
        residual: What the prior, fitted to the true acceleration, leaves unexplained.
        residual_moving: The same where the club moves faster than 0.05 rad/s (no stiction).
        residual_published: As ``residual``, with the paper's parameters.
        noise_floor: Torque noise of differentiating the encoder twice.
        fitted: The fitted parameters by name.
        largest_angle: Largest angle in the data [rad].
        largest_speed: Largest speed in the data [rad/s].
    """

    torques: dict[str, float]
    residual: float
    residual_moving: float
    residual_published: float
    noise_floor: float
    fitted: dict[str, float]
    largest_angle: float
    largest_speed: float


def noise_floor(p: RigParameters, window: float = 0.15) -> float:
    """Torque noise [N m]: J x the noise of a cubic Savitzky-Golay second derivative at 100 Hz.

    Args:
        p: The rig's parameters: quantisation (count / sqrt 12) and noise add in squares.
        window: Its length [s].

    Example:
        >>> noise_floor(RigParameters()) > noise_floor(RigParameters(), window=0.3)
        True
    """
    sigma = np.hypot(p.noise, 2 * np.pi / p.counts / np.sqrt(12))
    taps = savgol_coeffs(round(window / RECORD) // 2 * 2 + 1, 3, deriv=2, delta=RECORD)
    return float(p.J * sigma * np.linalg.norm(taps))


def measure_effects(seed: int = 0, budget: str = "quick") -> Effects:
    """Effects over the training runs of ``make_data(seed, budget)``, from noise-free truth.

    Example:
        >>> callable(measure_effects)
        True
    """
    rig = Rig()
    s, v = ca.SX.sym("s", 4), ca.SX.sym("u")
    ds, torques = rhs(s, v, rig.parameters)
    f = ca.Function("effects", [s, v], [ds[1], ca.vertcat(*torques.values())])
    kinds = [stem.split("_") for stem in stems(budget) if stem.startswith("train")]
    runs = [record(rig, kind, (seed, 0, int(number))) for _, number, kind in kinds]
    # every second sample, in the middle of a period: at its edges the torque lags a jump of the command
    u = np.concatenate([table[1::2, 2] for table, _ in runs])
    states = np.concatenate([truth[1::2] for _, truth in runs])
    acceleration, parts = (np.array(value) for value in f(states.T, u[None, :]))
    sizes = dict(zip(torques, np.sqrt(np.mean(parts**2, axis=1)).tolist(), strict=True))
    sizes["motor gain error"] = GEAR * abs(rig.parameters.motor_gain - 1) * _rms(u)
    sizes["torque lag, 10 ms after a change"] = GEAR * _rms(rig.parameters.motor_gain * u - states[:, 3])
    residuals, fitted = _fit(states, acceleration[0], u)
    return Effects(
        torques=sizes,
        residual=residuals[0],
        residual_moving=residuals[1],
        residual_published=residuals[2],
        noise_floor=noise_floor(rig.parameters),
        fitted=fitted,
        largest_angle=float(np.abs(states[:, 0]).max()),
        largest_speed=float(np.abs(states[:, 1]).max()),
    )


def _fit(states: Array, acceleration: Array, u: Array) -> tuple[list[float], dict[str, float]]:
    fixed = {p.name: p.value for p in PARAMETERS}
    free = [p for p in PARAMETERS if not p.fixed]
    phi, v = states[:, 0], states[:, 1]

    def residual(values: Array) -> Array:
        p = fixed | dict(zip([q.name for q in free], values.tolist(), strict=True))
        load = np.abs(p["m"] * v**2 * p["a"] + p["m"] * p["g"] * np.cos(phi))
        friction = p["r"] * p["mu"] * np.tanh(p["gamma"] * v) * load
        gravity = p["m"] * p["g"] * p["a"] * np.sin(phi)
        return np.asarray(p["J"] * acceleration + gravity + p["d"] * v + friction - GEAR * u)

    start = np.array([p.value for p in free])
    bounds = [p.lower for p in free], [p.upper for p in free]
    fit = least_squares(residual, start, bounds=bounds, x_scale=start)
    moving = np.abs(v) > 0.05
    rms = [_rms(residual(fit.x)), _rms(residual(fit.x)[moving]), _rms(residual(start))]
    return rms, dict(zip([p.name for p in free], fit.x.tolist(), strict=True))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def table(effects: Effects) -> str:
    """The figures as a Markdown table."""
    rows = [f"| {name} | {1e3 * value:.1f} |" for name, value in effects.torques.items()]
    rows += [
        f"| left by the published prior | {1e3 * effects.residual_published:.1f} |",
        f"| left by the fitted prior | {1e3 * effects.residual:.1f} |",
        f"| left by the fitted prior, moving | {1e3 * effects.residual_moving:.1f} |",
        f"| noise floor (0.15 s window) | {1e3 * effects.noise_floor:.1f} |",
    ]
    fitted = ", ".join(f"{name} {value:.4g}" for name, value in effects.fitted.items())
    reach = f"largest angle {effects.largest_angle:.2f} rad, speed {effects.largest_speed:.2f} rad/s"
    return "\n".join(
        ["| torque on the club | rms [mN m] |", "| --- | --- |", *rows, "", f"Fitted: {fitted}; {reach}."]
    )


if __name__ == "__main__":
    print(table(measure_effects()))
