"""State and disturbance estimation on a deployed model."""

from hybrid_mpc.estimation.delays import DelayCompensation, DelayedEstimate
from hybrid_mpc.estimation.kalman import Estimate, Estimator, ExtendedKalmanFilter, TrueState
from hybrid_mpc.estimation.switching import SwitchingEstimate, SwitchingFilter

__all__ = [
    "DelayCompensation",
    "DelayedEstimate",
    "Estimate",
    "Estimator",
    "ExtendedKalmanFilter",
    "SwitchingEstimate",
    "SwitchingFilter",
    "TrueState",
]
