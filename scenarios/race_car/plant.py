"""The model race car in simulation: a bicycle whose tyres slip."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from scenarios.simulated.plant import SimulatedPlant

Array = NDArray[np.float64]
GRAVITY = 9.81
STANDING = 0.05
"""Speed [m/s] below which the slip angles of a rolling wheel are no longer those of its direction."""


@dataclass(frozen=True)
class RaceCarPlant(SimulatedPlant):
    """A dynamic bicycle: each axle slides sideways by a force that grows with its slip angle and ends at the grip.

    The prior's wheels roll where they point. Steering, lags and the measured point are within 20 % of those fitted to
    the recordings; wheelbase and tyres are those of an F1TENTH car, on a floor of little grip.

    Args:
        k: Angle of the wheels for that commanded [-].
        offset: Of the steering [rad].
        tau_v: Lag of the speed [s].
        tau_s: Lag of the steering [s].
        a: From the rear axle to the measured point [m].
        psi_0: Direction of the car from the measured heading [rad].
        front: From the centre of mass to the front axle [m].
        rear: To the rear axle [m].
        gyration: Yaw inertia over mass [m^2].
        stiffness: Side force over load and slip angle [1/rad].
        grip: Largest side force over load [-].

    Source: R. Rajamani, *Vehicle Dynamics and Control*, 2nd edition (2012), sections 2.3 and 13.
    """

    k: float = 0.95
    offset: float = -0.011
    tau_v: float = 0.27
    tau_s: float = 0.12
    a: float = 0.12
    psi_0: float = -0.011
    front: float = 0.16
    rear: float = 0.17
    gyration: float = 0.0135
    stiffness: float = 4.7
    grip: float = 0.6
    sigma: ClassVar[tuple[float, ...]] = (0.003, 0.003, 0.003, 0.01)
    rest: ClassVar[tuple[tuple[float, ...], tuple[float, ...]]] = ((0.0, 0.3), ())

    def start(self, x: Array) -> Array:
        """Position, heading, speed and steering; side speed of the centre of mass and yaw rate, rolling."""
        turn = x[3] * np.tan(x[4]) / (self.front + self.rear)
        return np.array([*x, turn * self.rear, turn])

    def shown(self, z: Array) -> Array:
        """Position, heading, speed along the car, angle of the wheels."""
        return z[:5]

    def rates(self, z: Any, u: Any, w: Any, p: Any) -> Any:
        """Rates of all states."""
        _, _, heading, speed, steering, side, turn = z
        along, base, rolling = heading + p.psi_0, p.front + p.rear, ca.sqrt(speed**2 + STANDING**2)

        def pushed(slip: Any, share: Any) -> Any:
            return share * p.grip * GRAVITY * ca.tanh(p.stiffness * slip / p.grip)  # over the car's mass

        fore = pushed(steering - ca.atan((side + p.front * turn) / rolling), p.rear / base)
        aft = pushed(-ca.atan((side - p.rear * turn) / rolling), p.front / base)
        shown = side + turn * (p.a - p.rear)  # side speed of the measured point
        return (
            speed * ca.cos(along) - shown * ca.sin(along),
            speed * ca.sin(along) + shown * ca.cos(along),
            turn,
            (u[1] - speed) / p.tau_v - fore * ca.sin(steering) + side * turn,
            (p.k * u[0] + p.offset - steering) / p.tau_s,
            fore * ca.cos(steering) + aft - speed * turn,
            (p.front * fore * ca.cos(steering) - p.rear * aft) / p.gyration,
        )

    def outputs(self, z: Any, u: Any, w: Any, p: Any) -> Any:
        """Position [m], heading [rad] and speed [m/s]."""
        return z[:4]
