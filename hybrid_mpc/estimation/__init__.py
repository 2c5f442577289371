"""State and disturbance estimation on a deployed model."""

from hybrid_mpc.estimation.consistency import Consistency, Innovations, consistency, innovations
from hybrid_mpc.estimation.delays import DelayCompensation, DelayedEstimate
from hybrid_mpc.estimation.kalman import Estimate, Estimator, ExtendedKalmanFilter
from hybrid_mpc.estimation.parameters import (
    parameter_factors,
    parameter_filter,
    parameter_states,
    with_parameter_states,
)
from hybrid_mpc.estimation.switching import SwitchingEstimate, SwitchingFilter
from hybrid_mpc.estimation.truth import TrueState
from hybrid_mpc.estimation.tuning import log_likelihood, most_likely, process_noise

__all__ = [
    "Consistency",
    "DelayCompensation",
    "DelayedEstimate",
    "Estimate",
    "Estimator",
    "ExtendedKalmanFilter",
    "Innovations",
    "SwitchingEstimate",
    "SwitchingFilter",
    "TrueState",
    "consistency",
    "innovations",
    "log_likelihood",
    "most_likely",
    "process_noise",
    "parameter_factors",
    "parameter_filter",
    "parameter_states",
    "with_parameter_states",
]
