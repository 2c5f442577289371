"""What the tests of the analysis share."""

import control
import numpy as np

from hybrid_mpc import frequency_response


def response(sys, omega):
    """Complex frequency response ``(n_y, n_u, n)``."""
    found = frequency_response(sys, omega)
    return found.magnitude * np.exp(1j * found.phase)


def system(a, b, c, dt=0.1):
    """A discrete system with all its states."""
    return control.ss(a, b, c, 0.0, dt, remove_useless_states=False)


def central_differences(f, at, step):
    """Derivatives of ``f`` by its argument, a column each."""
    e = step * np.eye(np.size(at))
    return np.column_stack([(f(at + d) - f(at - d)) / (2 * step) for d in e])
