"""State and disturbance estimation on a deployed model."""

from hybrid_mpc.estimation.consistency import Consistency, Innovations, consistency, innovations
from hybrid_mpc.estimation.delays import DelayCompensation, DelayedEstimate
from hybrid_mpc.estimation.kalman import Estimate, Estimator, ExtendedKalmanFilter, TrueState
from hybrid_mpc.estimation.switching import SwitchingEstimate, SwitchingFilter

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
]
