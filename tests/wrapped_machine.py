"""A boat with its heading in degrees, in a wind whose direction is measured, in degrees; and its samples, wrapped."""

import casadi as ca
import numpy as np

from hybrid_mpc import OCP, HybridModel, Signal

DT, DEG = 0.5, np.pi / 180
SIGMAS = {
    "sigma_y": [0.2, 0.1], "sigma_x": [0.02, 0.05], "sigma_x0": [1.0, 1.0], "sigma_d": [0.1], "sigma_d0": [0.5],
}  # fmt: skip


def boat() -> HybridModel:
    """Heading [deg] and its rate [deg/s]; the rudder [deg] and the wind from the side turn it."""
    x, u, w = ca.MX.sym("x", 2), ca.MX.sym("u"), ca.MX.sym("w")
    rate = ca.vertcat(x[1], -0.4 * x[1] + 0.3 * u + 0.3 * ca.sin(DEG * (w - x[0])))
    states = (Signal("psi", "deg", periodic=True), Signal("r", "deg/s", -30.0, 30.0))
    return HybridModel.of(
        "boat", DT, states, (Signal("rudder", "deg", -30.0, 30.0),), states,
        x=x, u=u, w=w, x_next=x + DT * rate, xdot=rate, y=x,
        disturbances=(Signal("wind_from", "deg", periodic=True),),
    )  # fmt: skip


def problem() -> OCP:
    """Follow the heading."""
    return OCP(20, q=(1.0, 1.0), r=(0.01,), r_delta=(0.1,), u_min=(-30.0,), u_max=(30.0,))


def wrapped(angle: np.ndarray) -> np.ndarray:
    """An angle from 0 to 360 degrees."""
    return np.mod(angle, 360.0)


def samples(n: int = 160, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Outputs ``(n, 2)`` over two turns and back, inputs and wind, with missing samples; all unwrapped."""
    rng, model, x = np.random.default_rng(seed), boat(), np.array([340.0, 0.0])
    u = 25.0 * np.sign(np.sin(2 * np.pi * np.arange(n) / n))[:, None]
    wind = (355.0 + 15.0 * np.sin(0.3 * np.arange(n)))[:, None]
    ys = []
    for k in range(n):
        ys.append(x + rng.normal(0.0, (0.2, 0.1)))
        x = np.array(model.step(x, [], u[k], wind[k], [])[0]).ravel()
    y = np.array(ys)
    y[n // 4 : n // 4 + 5] = np.nan  # the boat turns by a tenth meanwhile
    return y, u, wind
