"""Signals and published parameters of the paper's pendulum, shared by prior, plant and oracle. No torch in here."""

from __future__ import annotations

from dataclasses import replace

from hybrid_mpc import Parameter, Signal

STATES = (Signal("phi", "rad", -3.2, 3.2), Signal("phi_dot", "rad/s", -40.0, 40.0))
INPUTS = (Signal("u", "N m", -30.0, 30.0),)
OUTPUTS = (Signal("phi", "rad", -3.2, 3.2),)

PARAMETERS = (
    Parameter("m", 50.0, "kg", 50.0, 50.0, "mass (fixed: inertia and gravity show m l^2 and m l)"),
    Parameter("g", 9.81, "m/s^2", 9.81, 9.81, "gravity (fixed)"),
    Parameter("l", 0.05, "m", 0.02, 0.2, "distance of the mass from the axis"),
    Parameter("d", 2.0, "N m s/rad", 0.1, 10.0, "viscous damping"),
)
"""The prior's values with bounds for a fit. They leave l a factor of 2.5 and 4, d one of 20 and 5."""

PUBLISHED = tuple(replace(p, lower=p.value, upper=p.value) for p in PARAMETERS)
"""The same, none of them free: the paper takes its prior as it is."""
