"""Online plausibility: residuals, their calibrated alarm, what broke, and replay on recordings."""
