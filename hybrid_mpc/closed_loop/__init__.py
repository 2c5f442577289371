"""Closed loops in simulation: deterministic, with faults, measured on the plant's true state."""

from hybrid_mpc.closed_loop.faults import Fault
from hybrid_mpc.closed_loop.result import ClosedLoopResult
from hybrid_mpc.closed_loop.simulate import Monitor, Reading, simulate

__all__ = ["ClosedLoopResult", "Fault", "Monitor", "Reading", "simulate"]
