"""Machines that the main job can run: one package each."""
