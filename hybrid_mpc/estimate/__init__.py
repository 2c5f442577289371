"""Estimators of state, hidden state and disturbance on a deployed model."""
