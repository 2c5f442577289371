"""Closed loops: simulated ones, deterministic, with faults, measured on the plant's true state; and real ones."""

from hybrid_mpc.closed_loop.faults import Fault
from hybrid_mpc.closed_loop.guard import Guard, Mode, Switch
from hybrid_mpc.closed_loop.loop import Loop, LoopState, Monitor, Reading
from hybrid_mpc.closed_loop.result import ClosedLoopResult
from hybrid_mpc.closed_loop.runner import Runner
from hybrid_mpc.closed_loop.safe_end import SafeEnd
from hybrid_mpc.closed_loop.simulate import simulate
from hybrid_mpc.closed_loop.timing import Clock, RealClock, RunnerStep, RunReport

__all__ = [
    "Clock",
    "ClosedLoopResult",
    "Fault",
    "Guard",
    "Loop",
    "LoopState",
    "Mode",
    "Monitor",
    "Reading",
    "RealClock",
    "RunReport",
    "Runner",
    "RunnerStep",
    "SafeEnd",
    "Switch",
    "simulate",
]
