"""Machines that the library has not seen, and an independent fit to compare with (:mod:`unknown_machines`)."""
