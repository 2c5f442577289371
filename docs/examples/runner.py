"""A loop in real time without hardware: a cart is simulated in place of sensor and drive (docs/hardware.md)."""

import casadi as ca
import numpy as np

import hybrid_mpc as hm

x, u = ca.MX.sym("x", 2), ca.MX.sym("u")
model = hm.HybridModel.of(
    "cart",
    0.02,
    (hm.Signal("q", "m"), hm.Signal("v", "m/s")),
    (hm.Signal("a", "m/s^2"),),
    (hm.Signal("q", "m"),),
    x=x,
    u=u,
    x_next=ca.vertcat(x[0] + 0.02 * x[1], x[1] + 0.02 * u),
    xdot=ca.vertcat(x[1], u),
    y=x[0],
)
cart = {"q": 0.0, "v": 0.0, "u": 0.0}  # in place of hardware


def measure():
    """Outputs (n_y,), or None without a new sample."""
    cart["q"] += 0.02 * cart["v"]
    cart["v"] += 0.02 * cart["u"]
    return np.array([cart["q"]])


def actuate(u):
    """Hold the input u (n_u,) until the next call."""
    cart["u"] = u[0]


ekf = hm.ExtendedKalmanFilter(model, sigma_y=[1e-3], sigma_x=[1e-4, 1e-2], sigma_x0=[0.1, 0.1])
ocp = hm.OCP(30, [100.0, 1.0], [0.1], [0.1], [-5.0], [5.0])
controller = hm.SafeController(hm.CondensedController(model, ocp), fallback=model, safe_input=[0.0])
runner = hm.Runner(
    measure, actuate, ekf, controller, lambda t: np.tile([0.2, 0.0], (len(t), 1)), deadline=0.015
)
report = runner.run(duration=2.0)
print(report.sources, report.late, report.overruns, report.skipped, report.percentiles()["applied"])
