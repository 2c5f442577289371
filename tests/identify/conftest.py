"""What the tests of trainings share."""

import pytest
from simulated_pendulum import dragged


@pytest.fixture(scope="session")
def data():
    """Two runs to train on and one to validate with, under a torque that the prior lacks."""
    return dragged()
