"""The deployed model, and what is computed from it alone: delays, stages along a horizon, Riccati equations."""
