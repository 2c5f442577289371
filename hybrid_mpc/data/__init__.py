"""Recordings in, trajectories out: reading, checking, smoothing, splitting; input signals that excite a machine."""
