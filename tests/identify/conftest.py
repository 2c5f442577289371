"""What the tests of trainings share."""

from dataclasses import replace

import numpy as np
import pytest
from simulated_pendulum import dragged, record


@pytest.fixture(scope="session")
def data():
    """Two runs to train on and one to validate with, under a torque that the prior lacks."""
    return dragged()


@pytest.fixture(scope="session")
def noisy():
    """Three runs of the pendulum with 2 mrad of noise."""
    rng = np.random.default_rng(1)
    made = [record(seed) for seed in range(3)]
    return [replace(t, y=t.y + 2e-3 * rng.standard_normal(t.y.shape)) for t in made]
