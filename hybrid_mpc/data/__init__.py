"""Recordings in, trajectories out: reading, checking, smoothing, splitting, and input signals."""

from hybrid_mpc.data.csv_files import write_csv
from hybrid_mpc.data.differentiation import (
    Derivatives,
    bandwidth,
    causal_derivatives,
    local_polynomial,
    noise_gain,
)
from hybrid_mpc.data.excitation import chirp, sinusoid, steps
from hybrid_mpc.data.tables import Table, read_csv, read_table, read_tables
from hybrid_mpc.data.trajectories import Cut, Dataset, Trajectory, load_trajectories

__all__ = [
    "Table", "read_table", "read_tables", "read_csv", "write_csv",
    "Cut", "Dataset", "Trajectory", "load_trajectories",
    "Derivatives", "local_polynomial", "causal_derivatives", "noise_gain", "bandwidth",
    "sinusoid", "chirp", "steps",
]  # fmt: skip
