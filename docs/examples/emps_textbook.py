"""The EMPS as a textbook has it: a linear motor that moves a mass on a viscous guide.

Source: K. Ogata, *Modern Control Engineering*, 5th edition (2010), section 3.2.
"""

from dataclasses import replace

from hybrid_mpc import MechanicalPrior, Parameter, Signal, load_scenario


class AxisPrior(MechanicalPrior):
    """``M q'' = F - F_v q'``."""

    states = (Signal("q", "m", -1.0, 1.0), Signal("q_dot", "m/s", -5.0, 5.0))
    inputs = (Signal("force", "N", -1000.0, 1000.0),)
    outputs = (states[0],)
    parameters = (
        Parameter("M", 95.0, "kg", 30.0, 300.0, "inertia at the carriage"),
        Parameter("F_v", 200.0, "N s/m", 0.0, 1000.0, "viscous friction"),
    )

    def mass_matrix(self, q, p):
        """Mass [kg]."""
        return p.M

    def friction(self, q, v, p):
        """Viscous friction [N]."""
        return p.F_v * v.q_dot

    def force(self, q, v, u, w, p):
        """Force of the drive [N]."""
        return u.force


scenario = replace(load_scenario("emps"), name="emps_textbook", title="EMPS, textbook prior", prior=AxisPrior)
