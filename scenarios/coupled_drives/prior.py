"""Prior of the coupled drives: a motor lag, a belt whose damping grows with the speed, a counter that shows a curve."""

from __future__ import annotations

from typing import Any, ClassVar

import casadi as ca

from hybrid_mpc import OperatingPoint, Parameter, Prior, Signal

CORNER = 0.03
"""Speed [V] below which an absolute value is rounded."""
FRICTION_SPEED = 0.1
"""Speed [V] over which the drives' dry friction changes its sign."""


def size(speed: Any) -> Any:
    """``|speed|`` with a rounded corner, zero at zero."""
    return ca.sqrt(speed * speed + CORNER**2) - CORNER


class CoupledDrivesPrior(Prior):
    """Drives with a lag and dry friction, a belt on a spring, a counter that does not see the sign.

    ``lag motor' = gain u - F tanh(motor / v_c) - motor``,
    ``pulley'' = w^2 (motor - pulley) - 2 (zeta + zeta_v |pulley|) w pulley'``,
    ``window counter' = |pulley| + bend pulley^2 - counter``, ``y = counter``.

    ``motor`` is the speed that the drives ask for; the belt carries the pulley along. The speeds are in volts of a
    counter that would be straight. What it shows grows faster than the speed (twice the input, nearly four times the
    reading), and it averages over a short time, so that it does not come down to zero where the pulley turns round.

    Source of the linear third order part: T. Wigren, M. Schoukens, *Coupled electric drives data set and reference
    models*, Uppsala TR 2017-024. Friction, bend, window and ``zeta_v`` were found on its two uniform records, samples 1
    to 300 (docs/results/real_machines.md).
    """

    states: ClassVar[tuple[Signal, ...]] = (
        Signal("motor", "V", -5.0, 5.0),
        Signal("pulley", "V", -5.0, 5.0),
        Signal("pulley_dot", "V/s", -50.0, 50.0),
        Signal("counter", "V", -0.5, 10.0),
    )
    inputs: ClassVar[tuple[Signal, ...]] = (Signal("drives", "V", -10.0, 10.0),)
    outputs: ClassVar[tuple[Signal, ...]] = (Signal("speed", "V", -0.5, 10.0),)
    parameters: ClassVar[tuple[Parameter, ...]] = (
        Parameter("gain", 0.4, "-", 0.02, 6.0, "speed a volt"),
        Parameter("lag", 0.2, "s", 0.02, 1.0, "of the drives"),
        Parameter("w", 24.0, "rad/s", 10.0, 40.0, "natural frequency of the belt"),
        Parameter("zeta", 0.1, "-", 0.0, 0.7, "its damping at rest"),
        Parameter("zeta_v", 0.3, "1/V", 0.0, 3.0, "how that grows with the speed"),
        Parameter("F", 0.1, "V", 0.0, 3.0, "dry friction of the drives, as the speed that it costs"),
        Parameter("bend", 2.0, "1/V", 0.0, 50.0, "of the counter"),
        Parameter("window", 0.03, "s", 0.003, 0.3, "over which the counter averages"),
    )
    operating_point: ClassVar[OperatingPoint] = OperatingPoint(x=(0.3, 0.3, 0.0, 0.45), u=(1.0,))

    def xdot(self, x: Any, u: Any, w: Any, p: Any) -> Any:
        """Rates of the motor's speed, the pulley's speed, its acceleration and the counter [V/s, V/s^2]."""
        friction = p.F * ca.tanh(x.motor / FRICTION_SPEED)
        damping = 2 * (p.zeta + p.zeta_v * size(x.pulley)) * p.w * x.pulley_dot
        return (
            (p.gain * u.drives - friction - x.motor) / p.lag,
            x.pulley_dot,
            p.w * p.w * (x.motor - x.pulley) - damping,
            (size(x.pulley) + p.bend * x.pulley * x.pulley - x.counter) / p.window,
        )

    def output(self, x: Any, u: Any, w: Any, p: Any) -> Any:
        """What the counter shows [V]."""
        return (x.counter,)
