import pytest
from closed_loop_parts import make_safe
from online_models import pendulum_model


@pytest.fixture(scope="module")
def model():
    return pendulum_model(z=2)


@pytest.fixture(scope="module")
def safe(model):
    return make_safe(model, horizon=10)
