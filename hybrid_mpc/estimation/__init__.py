"""State and disturbance estimation on a deployed model."""

from hybrid_mpc.estimation.kalman import Estimate, Estimator, ExtendedKalmanFilter, TrueState

__all__ = ["Estimate", "Estimator", "ExtendedKalmanFilter", "TrueState"]
