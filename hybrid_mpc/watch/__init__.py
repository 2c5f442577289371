"""Monitoring of a machine: readings of channels, their limits, alarms, and their diagnosis."""
