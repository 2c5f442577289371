"""Checks and proposals before a run: scenario, prior, recordings, default tasks, the installation."""
