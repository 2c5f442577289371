import pytest
from golden_parts import MACHINES, machine


@pytest.fixture(scope="session", params=MACHINES)
def m(request):
    """A frozen machine; what is built of it is shared."""
    return machine(request.param)
