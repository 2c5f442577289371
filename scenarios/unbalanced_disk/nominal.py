"""Signals and nominal parameters of the unbalanced disk, shared by prior and data. No torch in here."""

from __future__ import annotations

from hybrid_mpc import Parameter, Signal

STATES = (Signal("phi", "rad", -60.0, 60.0, periodic=True), Signal("phi_dot", "rad/s", -100.0, 100.0))
INPUTS = (Signal("voltage", "V", -12.0, 12.0),)
OUTPUTS = (STATES[0],)
DT = 0.025
"""Period of the recordings, the model and the controller [s]."""

PARAMETERS = (
    Parameter("J", 2.44e-4, "kg m^2", 2.44e-4, 2.44e-4, "inertia (fixed: it shows in no motion)"),
    Parameter("w_0", 11.34, "rad/s", 8.0, 15.0, "natural frequency"),
    Parameter("gamma", 1.33, "1/s", 0.0, 6.0, "viscous friction and back-EMF over J"),
    Parameter("F_c", 6.06, "rad/s^2", 0.0, 20.0, "dry friction over J"),
    Parameter("K_u", 28.1, "rad/s^2/V", 10.0, 60.0, "acceleration a volt"),
    Parameter("phi_0", 0.0, "rad", -0.3, 0.3, "angle of the encoder's zero from hanging down"),
)
