"""What the tests of studies share."""

import pytest
import trivial_runs

from hybrid_mpc.compare import study_run as runner


@pytest.fixture
def here(monkeypatch):
    """Run studies in this process: ``here(run)``."""

    def use(run):
        trivial_runs.stand_in(monkeypatch, run)
        monkeypatch.setattr(runner, "make_engine", lambda work, *given, **named: trivial_runs.Here(work))

    return use
