"""What watches a machine: readings of channels, their limits, alarms, and what explains these."""
