"""Linear analysis of a model with the control engineer's own instruments (python-control)."""

from hybrid_mpc.analysis.linearize import fixed_point, hidden_fixed_point, linearize, linearize_at_speed
from hybrid_mpc.analysis.properties import (
    FrequencyResponse,
    LinearAnalysis,
    analyze,
    detectable,
    frequency_response,
    stabilisable,
)

__all__ = [
    "fixed_point",
    "hidden_fixed_point",
    "linearize",
    "linearize_at_speed",
    "LinearAnalysis",
    "FrequencyResponse",
    "analyze",
    "stabilisable",
    "detectable",
    "frequency_response",
]
