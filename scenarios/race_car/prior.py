"""Prior of the model race car: a kinematic bicycle with lags of speed and steering."""

from __future__ import annotations

from typing import Any, ClassVar

import casadi as ca

from hybrid_mpc import OperatingPoint, Parameter, Prior, Signal

WHEELBASE = 0.33
"""Distance of the axles [m] of an F1TENTH car; slow and near straight on, motion tells ``k / WHEELBASE`` alone."""


class RaceCarPrior(Prior):
    """``x' = v cos(psi + psi_0) - a psi' sin(psi + psi_0)``, ``y'`` alike, ``psi' = v tan(delta) / L``, with lags
    ``v' = (command - v) / tau_v`` and ``delta' = (k command + offset - delta) / tau_s``.

    The point whose position is measured lies ``a`` before the rear axle: without ``a`` and ``psi_0`` free runs over 3 s
    are off by 25 mm in y, with them by 13 mm. The angle ``delta`` of the front wheels is not measured. Networks may
    correct speed and steering: how the car goes on from there needs no learning.

    Source: R. Rajamani, *Vehicle Dynamics and Control*, 2nd edition (2012), section 2.2, about the rear axle.
    """

    states: ClassVar[tuple[Signal, ...]] = (
        Signal("x", "m", -20.0, 20.0),
        Signal("y", "m", -20.0, 20.0),
        Signal("heading", "rad", -10.0, 10.0, periodic=True),
        Signal("speed", "m/s", -1.0, 5.0),
        Signal("steering", "rad", -0.6, 0.6),
    )
    inputs: ClassVar[tuple[Signal, ...]] = (
        Signal("steering_command", "rad", -0.6, 0.6),
        Signal("speed_command", "m/s", -1.0, 5.0),
    )
    outputs: ClassVar[tuple[Signal, ...]] = states[:4]
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("k", 0.8, "-", 0.3, 1.5, "angle of the wheels for that commanded"),
        Parameter("offset", 0.0, "rad", -0.1, 0.1, "of the steering"),
        Parameter("tau_v", 0.23, "s", 0.05, 1.0, "lag of the speed"),
        Parameter("tau_s", 0.10, "s", 0.03, 0.5, "lag of the steering"),
        Parameter("a", 0.0, "m", -0.4, 0.4, "from the rear axle to the measured point"),
        Parameter("psi_0", 0.0, "rad", -0.2, 0.2, "direction of travel from the measured heading"),
    )
    corrects: ClassVar[tuple[str, ...]] = ("speed", "steering")
    operating_point: ClassVar[OperatingPoint] = OperatingPoint(x=(0.0, 0.0, 0.0, 0.3, 0.0), u=(0.0, 0.3))

    def xdot(self, x: Any, u: Any, w: Any, p: Any) -> Any:
        """Rates of position [m/s], heading [rad/s], speed [m/s^2] and steering [rad/s]."""
        turn, along = x.speed * ca.tan(x.steering) / WHEELBASE, x.heading + p.psi_0
        return (
            x.speed * ca.cos(along) - p.a * turn * ca.sin(along),
            x.speed * ca.sin(along) + p.a * turn * ca.cos(along),
            turn,
            (u.speed_command - x.speed) / p.tau_v,
            (p.k * u.steering_command + p.offset - x.steering) / p.tau_s,
        )
