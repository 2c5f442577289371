"""Analysis of a model with the control engineer's own instruments (python-control), on exact derivatives."""

from hybrid_mpc.analysis.along import AlongTrajectory, linearize_along
from hybrid_mpc.analysis.contraction import Contraction, GruWeights, contraction, feature_box, gru_weights
from hybrid_mpc.analysis.equilibria import Equilibria, Equilibrium, equilibria
from hybrid_mpc.analysis.friction import FrictionSlopes, friction_slopes, linearize_secant
from hybrid_mpc.analysis.gains import MpcGain, SteadyFilter, mpc_gain, steady_filter
from hybrid_mpc.analysis.interval import interval_bounds
from hybrid_mpc.analysis.linearize import fixed_point, hidden_fixed_point, linearize, linearize_at_speed
from hybrid_mpc.analysis.loop import Loop, Margins, mpc_loop
from hybrid_mpc.analysis.lyapunov import LyapunovExponent, lyapunov_exponent
from hybrid_mpc.analysis.measured import (
    MeasuredResponse,
    multisine_response,
    run_model,
    run_plant,
    welch_response,
)
from hybrid_mpc.analysis.properties import (
    FrequencyResponse,
    LinearAnalysis,
    analyze,
    detectable,
    frequency_response,
    stabilisable,
)
from hybrid_mpc.analysis.reduction import (
    Reduced,
    balanced_truncation,
    hankel_singular_values,
    physical_states,
)
from hybrid_mpc.analysis.schedule import GainSchedule, gain_schedule, holding_input
from hybrid_mpc.analysis.sensitivity import Sensitivities, parameter_sensitivities
from hybrid_mpc.analysis.structure import Mode, Structure, system_structure
from hybrid_mpc.analysis.symbolic import jacobians

__all__ = [
    "equilibria",
    "Equilibria",
    "Equilibrium",
    "fixed_point",
    "hidden_fixed_point",
    "linearize",
    "linearize_at_speed",
    "linearize_secant",
    "linearize_along",
    "AlongTrajectory",
    "jacobians",
    "friction_slopes",
    "FrictionSlopes",
    "analyze",
    "LinearAnalysis",
    "system_structure",
    "Structure",
    "Mode",
    "stabilisable",
    "detectable",
    "balanced_truncation",
    "physical_states",
    "hankel_singular_values",
    "Reduced",
    "frequency_response",
    "FrequencyResponse",
    "welch_response",
    "multisine_response",
    "run_plant",
    "run_model",
    "MeasuredResponse",
    "gain_schedule",
    "holding_input",
    "GainSchedule",
    "mpc_gain",
    "MpcGain",
    "steady_filter",
    "SteadyFilter",
    "mpc_loop",
    "Loop",
    "Margins",
    "contraction",
    "Contraction",
    "gru_weights",
    "GruWeights",
    "feature_box",
    "interval_bounds",
    "lyapunov_exponent",
    "LyapunovExponent",
    "parameter_sensitivities",
    "Sensitivities",
]
