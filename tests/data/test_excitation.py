import numpy as np
import pytest

from hybrid_mpc.data import chirp, sinusoid, steps
from hybrid_mpc.errors import InputError


def test_chirp_has_the_stated_frequencies_at_its_ends():
    t = np.linspace(0, 20, 20001)
    crossings = t[1:][np.diff(np.sign(chirp(t, 1.0, 0.5, 2.0))) != 0]
    # half periods: 1/(2 f) up to the change of f within one half period (7.5 % at 0.5 Hz)
    assert crossings[1] - crossings[0] == pytest.approx(1.0, rel=0.15)
    assert crossings[-1] - crossings[-2] == pytest.approx(0.25, rel=0.02)


def test_steps_keep_bounds_and_hold_times_and_repeat_with_the_seed():
    t = np.arange(0, 50, 0.01)
    u = steps(t, -0.4, 0.9, hold=(0.5, 1.5), rng=np.random.default_rng(3))
    assert u.min() >= -0.4
    assert u.max() <= 0.9
    switch = t[1:][np.diff(u) != 0]
    assert np.diff(switch).min() >= 0.5 - 0.011  # one grid step of rounding
    assert np.diff(switch).max() <= 1.5 + 0.011
    again = steps(t, -0.4, 0.9, hold=(0.5, 1.5), rng=np.random.default_rng(3))
    np.testing.assert_array_equal(u, again)


def test_bounds_are_refused_not_clipped():
    t = np.linspace(0, 1, 11)
    with pytest.raises(InputError, match="Lower the amplitude"):
        sinusoid(t, 1.0, 1.0, offset=0.2, upper=1.0)
    with pytest.raises(InputError, match="hold"):
        steps(t, 0, 1, hold=(0.0, 1.0), rng=np.random.default_rng(0))
