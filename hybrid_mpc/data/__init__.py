"""Recordings in, trajectories out: reading, checking, smoothing, splitting, and input signals."""

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
from hybrid_mpc.data.excitation import chirp, multisine, prbs, sinusoid, steps
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
    "sinusoid", "chirp", "steps", "multisine", "prbs", "crest_factor", "line_spectrum", "hann_spectrum",
    "Excitation", "excitation_of", "check_excitation",
    "noise_of", "time_scale", "time_unit",
]  # fmt: skip
