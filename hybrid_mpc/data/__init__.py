"""Recordings in, trajectories out: reading, checking, smoothing, splitting, and input signals.

A name is imported from its module when it is used: what runs beside a machine needs none of scipy's signal processing.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hybrid_mpc.data.csv_files import write_csv
    from hybrid_mpc.data.differentiation import (
        Derivatives,
        bandwidth,
        causal_derivatives,
        local_polynomial,
        noise_gain,
    )
    from hybrid_mpc.data.differentiators import (
        CausalPolynomial,
        Differentiator,
        LocalPolynomial,
        differentiate,
    )
    from hybrid_mpc.data.doubts import Finding
    from hybrid_mpc.data.excitation import chirp, multisine, prbs, random_steps, sinusoid
    from hybrid_mpc.data.excitation_check import Excitation, check_excitation, excitation_of
    from hybrid_mpc.data.low_pass import SmoothingSpline, ZeroPhaseFilter, gcv_cutoff
    from hybrid_mpc.data.scales import noise_of, time_scale, time_unit
    from hybrid_mpc.data.spectra import crest_factor, hann_spectrum, line_spectrum
    from hybrid_mpc.data.tables import Table, read_csv, read_table, read_tables
    from hybrid_mpc.data.trajectories import Cut, Dataset, Trajectory, load_trajectories

__all__ = [
    "Table", "read_table", "read_tables", "read_csv", "write_csv",
    "Cut", "Dataset", "Finding", "Trajectory", "load_trajectories",
    "Derivatives", "local_polynomial", "causal_derivatives", "noise_gain", "bandwidth",
    "differentiate", "Differentiator", "gcv_cutoff",
    "LocalPolynomial", "SmoothingSpline", "ZeroPhaseFilter", "CausalPolynomial",
    "sinusoid", "chirp", "random_steps", "multisine", "prbs", "crest_factor", "line_spectrum", "hann_spectrum",
    "Excitation", "excitation_of", "check_excitation",
    "noise_of", "time_scale", "time_unit",
]  # fmt: skip
_MODULES = {
    "csv_files": ("write_csv",),
    "differentiation": ("Derivatives", "bandwidth", "causal_derivatives", "local_polynomial", "noise_gain"),
    "differentiators": ("CausalPolynomial", "Differentiator", "LocalPolynomial", "differentiate"),
    "doubts": ("Finding",),
    "excitation": ("chirp", "multisine", "prbs", "random_steps", "sinusoid"),
    "excitation_check": ("Excitation", "check_excitation", "excitation_of"),
    "low_pass": ("SmoothingSpline", "ZeroPhaseFilter", "gcv_cutoff"),
    "scales": ("noise_of", "time_scale", "time_unit"),
    "spectra": ("crest_factor", "hann_spectrum", "line_spectrum"),
    "tables": ("Table", "read_csv", "read_table", "read_tables"),
    "trajectories": ("Cut", "Dataset", "Trajectory", "load_trajectories"),
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'hybrid_mpc.data' has no attribute {name!r}")
    return getattr(importlib.import_module(f"hybrid_mpc.data.{_HOME[name]}"), name)
