"""Linear axes of any size and pace with known friction and pushes, that the tests of the monitor share; no torch."""

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from monitor_parts import Run
from online_models import rk4

from hybrid_mpc import ExtendedKalmanFilter, HybridModel, Parameter, Signal


@dataclass(frozen=True)
class Axis:
    """``m a = u + push - d v - c q - F tanh(v / width)``, in SI."""

    dt: float
    mass: float = 2.0
    viscous: float = 10.0
    dry: float = 0.0
    width: float = 1e-4
    stiffness: float = 0.0
    push: float = 0.0
    time_unit: float = 1.0

    def model(self):
        x, u, rate, p = ca.MX.sym("x", 2), ca.MX.sym("u"), ca.MX.sym("rate", 2), ca.MX.sym("p", 2)

        def force(x):
            friction = p[1] * x[1] + self.dry * ca.tanh(x[1] / self.width)
            return u + self.push - friction - self.stiffness * x[0]

        def rhs(x):
            return ca.vertcat(x[1], force(x) / p[0])

        known = Parameter("m", self.mass, "kg", 0.0, 1e6), Parameter("d", self.viscous, "N s/m", 0.0, 1e6)
        model = HybridModel.of(
            "axis", self.dt, (Signal("q", "m"), Signal("v", "m/s")), (Signal("F", "N"),), (Signal("q", "m"),),
            x=x, u=u, p=p, x_next=rk4(rhs, x, self.dt, 8), xdot=rhs(x), y=x[0], rate=rate,
            energy=(p[0] * rate[1] - force(x)) * x[1],
            parameters=known,
        )  # fmt: skip
        return replace(model, time_unit=self.time_unit)

    def run(self, u, *, noise=0.0, step=0.0, seed=0, fault=None, at=10**9):
        """A run under inputs ``(n,)``; from sample ``at`` on it is that of another axis."""
        own, broken = self.model(), (fault or self).model()
        x = np.zeros((len(u), 2))
        for k in range(len(u) - 1):
            model = broken if k >= at else own
            x[k + 1] = model.step(x[k], [], u[k], model.w, model.p)[0].full().ravel()
        y = x[:, :1] + noise * np.random.default_rng(seed).standard_normal((len(u), 1))
        y = step * np.round(y / step) if step else y
        return Run(self.dt * np.arange(len(u)), y, np.asarray(u)[:, None], x)

    def cruise(self, speed, n, *, push=0.0):
        """Constant speed under a push that the axis does not know of."""
        t = self.dt * np.arange(n)
        u = self.viscous * speed + self.dry * np.tanh(speed / self.width) - push
        x = np.column_stack([speed * t, np.full(n, speed)])
        return Run(t, x[:, :1], np.full((n, 1), u), x)

    def swings(self, period, n, size=1.0, seed=0):
        """Inputs ``(n,)``: two sinusoids around a period [s]."""
        t, rng = self.dt * np.arange(n), np.random.default_rng(seed)
        phase = rng.uniform(0, 2 * np.pi, 2)
        slow, fast = (2 * np.pi * t / period * share for share in (0.7, 1.3))
        return size * (np.sin(slow + phase[0]) + 0.6 * np.sin(fast + phase[1]))


def kalman(model, sigma_y, sigma_v):
    """A filter that believes its model within a thousandth of its speed a period."""
    return ExtendedKalmanFilter(
        model, sigma_y=[sigma_y], sigma_x=[0.1 * sigma_y, 1e-3 * sigma_v], sigma_x0=[sigma_y, sigma_v]
    )
