"""What can go wrong at the golf robot, ready to be built into a closed loop. No torch in here."""

from __future__ import annotations

from dataclasses import dataclass
from math import inf

import numpy as np

from hybrid_mpc import Fault, InputError

CAUSES = {"friction": ("d", "mu"), "mass": ("m", "J"), "motor": ("gain of u",)}
"""What may break, and the prior's parameters that change together then."""


@dataclass(frozen=True)
class FaultCase:
    """One thing that goes wrong; ``nominal`` for ageing that a monitor must not take for a fault."""

    name: str
    title: str
    faults: tuple[Fault, ...]
    nominal: bool = False


def catalogue(start: float = 2.0, end: float = inf, drift_time: float = 60.0) -> tuple[FaultCase, ...]:
    """All cases, each of which begins at ``start``.

    Sizes: a push of a finger (1.7 N at the head for 0.2 s, 1.3 rad/s); an encoder that slipped on its shaft by
    13 counts, or is read with 5 % too many counts; a worn belt that jumps at 0.8 N m of the 2 N m the motor
    makes; a delay that grows to three periods. Push and dropouts end by
    themselves; ``drift_time`` [s] is that in which ageing friction changes by 10 %: days on a rig.
    """
    if not start < end:
        raise InputError(
            f"fault catalogue: end must be later than start, got {start} s and {end} s [HM-SCENARIOS-007]"
        )

    def one(name: str, title: str, target: str, value: float = 0.0, ramp: float = 0.0) -> FaultCase:
        nominal = name.startswith("friction_ageing")
        return FaultCase(name, title, (Fault(start, end, target, value, ramp=ramp),), nominal)

    last = min(end, start + 4.0)
    gaps = tuple(
        Fault(t, min(t + 0.1, end), "measurement_dropout")
        for t in np.arange(start, last - 1e-9, 0.5).tolist()
    )
    push = Fault(start, min(start + 0.2, end), "plant_push", 1.0)
    return (
        *(one(f"friction_x{f:g}", f"Bearing friction x {f:g}", "plant_friction", f) for f in (1.5, 2.0, 4.0)),
        *(one(f"mass_+{s}", f"Club {s} % heavier", "plant_mass", 1 + s / 100) for s in (10, 20, 50)),
        one("motor_-20", "Motor constant down by 20 %", "input_gain", 0.8),
        one("encoder_offset", "Encoder slips by 0.02 rad", "measurement_offset", 0.02),
        one("encoder_scale", "Encoder reads 5 % too much", "measurement_scale", 1.05),
        one("encoder_freeze", "Encoder freezes", "measurement_freeze"),
        FaultCase("encoder_dropouts", "Encoder drops out for 0.1 s every 0.5 s", gaps),
        FaultCase("push", "Push of 1 N m for 0.2 s", (push,)),
        one("belt_slip", "Belt jumps at 0.8 N m", "plant_belt", 0.8),
        one("delay", "Sensor's delay grows to 60 ms within 5 s", "plant_delay", 0.06, ramp=5.0),
        one("friction_ageing_up", "Friction drifts up by 10 %", "plant_friction", 1.1, drift_time),
        one("friction_ageing_down", "Friction drifts down by 10 %", "plant_friction", 0.9, drift_time),
    )
