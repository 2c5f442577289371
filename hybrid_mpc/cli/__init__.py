"""The command line ``hybrid-mpc``: one thin module per command."""

from hybrid_mpc.cli.main import main

__all__ = ["main"]
