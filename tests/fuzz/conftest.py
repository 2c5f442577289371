"""What forked commands need is loaded once, before they are forked."""

import sys

import pytest

collect_ignore_glob = [] if sys.platform == "linux" else ["test_*.py"]


@pytest.fixture(scope="session", autouse=True)
def loaded():
    """The modules of the commands that are tried."""
    import scenarios.golf_robot  # noqa: F401
