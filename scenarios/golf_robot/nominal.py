"""Signals and published parameters of the golf robot, shared by prior, rig and oracle. No torch in here."""

from __future__ import annotations

from hybrid_mpc import Parameter, Signal

STATES = (Signal("phi", "rad", -3.2, 3.2), Signal("phi_dot", "rad/s", -15.0, 15.0))
INPUTS = (Signal("u", "N m", -0.6, 0.6),)
OUTPUTS = (Signal("phi", "rad", -3.2, 3.2),)

GEAR = 4.0

PARAMETERS = (
    Parameter("m", 0.5241, "kg", 0.5241, 0.5241, "club mass (fixed: enters as products m a and r mu m only)"),
    Parameter("g", 9.81, "m/s^2", 9.81, 9.81, "gravity (fixed)"),
    Parameter("r", 0.0245, "m", 0.0245, 0.0245, "friction radius (fixed: only r mu is identifiable)"),
    Parameter("a", 0.4702, "m", 0.42, 0.52, "distance of the centre of mass; scales gravity"),
    Parameter("J", 0.1445, "kg m^2", 0.1156, 0.1806, "inertia about the axis"),
    Parameter("d", 0.0132, "kg m^2/s", 0.0, 0.1, "viscous damping"),
    Parameter("mu", 1.5136, "-", 0.5, 2.2, "friction coefficient"),
    Parameter("gamma", 50.0, "s/rad", 5.0, 80.0, "steepness of the friction at rest (not in the paper)"),
)
