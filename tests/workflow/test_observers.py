"""The stage that tests the observers: what it looks at, and when it has nothing to say."""

from types import SimpleNamespace

import numpy as np

from hybrid_mpc import Trajectory
from hybrid_mpc.workflow.stage import Absent
from hybrid_mpc.workflow.stages.estimate import (
    OBSERVERS,
    PERIODS,
    RECORDINGS,
    estimation_stage,
    parts_for_tests,
)


def recording(name, n):
    column = np.zeros((n, 1))
    pair = np.zeros((n, 2))
    return Trajectory(name, "test", 0.02, 0.02 * np.arange(n), column, column, pair, pair)


def test_a_few_recordings_share_the_time():
    parts = parts_for_tests([recording(str(i), 2000) for i in range(9)])
    assert [p.name for p in parts] == ["0", "3", "5", "8"]
    assert len(parts) == RECORDINGS
    assert sum(len(p.t) for p in parts) == PERIODS
    assert [len(p.t) for p in parts_for_tests([recording("one", 300)])] == [300]
    assert parts_for_tests([]) == []


def test_without_a_control_problem_there_is_a_reason():
    found = estimation_stage(SimpleNamespace(scenario=SimpleNamespace(control=None)))
    assert isinstance(found, Absent)
    assert not found.failed
    assert "control problem" in found.reason


def test_too_short_recordings_are_a_reason():
    from closed_loop_parts import make_ekf
    from online_models import pendulum_model

    model = pendulum_model()
    context = SimpleNamespace(
        scenario=SimpleNamespace(control=object()),
        kit=SimpleNamespace(observer=lambda model_name, load: make_ekf(model)),
        trajectories=lambda role: [recording("short", 60)],
        progress=SimpleNamespace(update=lambda *words: None),
        read=lambda stage: None,
    )  # fmt: skip
    found = estimation_stage(context)
    assert all("at least 100" in found.observers[name].reason for name in OBSERVERS)
