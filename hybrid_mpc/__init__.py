"""hybrid-mpc: measurements and an ODE in, a guarded real-time nonlinear MPC out."""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("hybrid-mpc")
except PackageNotFoundError:  # a source tree that was never installed
    __version__ = "0+unknown"

__all__ = ["__version__"]
