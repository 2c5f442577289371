"""The stage that tests the observers: what it looks at, and when it has nothing to say."""

from types import SimpleNamespace

import numpy as np
import pytest

from hybrid_mpc import InputError, Trajectory
from hybrid_mpc.job.stages import estimate as observers
from hybrid_mpc.job.stages.estimate import JUDGED_PERIODS, JUDGED_RECORDINGS, estimation_stage, judged_parts
from hybrid_mpc.job.stages.results import SCHEMA, _check, _estimation


def recording(name, n):
    column = np.zeros((n, 1))
    pair = np.zeros((n, 2))
    return Trajectory(name, "test", 0.02, 0.02 * np.arange(n), column, column, pair, pair)


def test_a_few_recordings_share_the_time():
    parts = judged_parts([recording(str(i), 2000) for i in range(9)])
    assert [p.name for p in parts] == ["0", "3", "5", "8"]
    assert len(parts) == JUDGED_RECORDINGS
    assert sum(len(p.t) for p in parts) == JUDGED_PERIODS
    assert [len(p.t) for p in judged_parts([recording("one", 300)])] == [300]
    assert judged_parts([]) == []


def test_without_a_control_problem_there_is_a_reason():
    kept = {}
    scenario = SimpleNamespace(control=None)
    estimation_stage(
        SimpleNamespace(scenario=scenario, save=lambda *given: kept.update({given[0]: given[1:]}))
    )
    result, arrays = kept["estimation"]
    assert "control problem" in result["reason"]
    assert arrays == {}


def test_too_short_recordings_are_a_reason():
    from closed_loop_parts import make_ekf
    from online_models import pendulum_model

    model, kept = pendulum_model(), {}
    context = SimpleNamespace(
        scenario=SimpleNamespace(control=object()),
        kit=SimpleNamespace(observer=lambda model_name, load: make_ekf(model)),
        trajectories=lambda role: [recording("short", 60)],
        progress=SimpleNamespace(update=lambda *words: None),
        save=lambda *given: kept.update({given[0]: given[1:]}),
    )  # fmt: skip
    estimation_stage(context)
    result, _ = kept["estimation"]
    for name in observers.OBSERVERS:
        assert "at least 100" in result[name]["reason"]


@pytest.mark.parametrize(
    "found",
    [
        {"reason": "no control problem"},
        {"recordings": [], **{name: {"reason": "too short"} for name in observers.OBSERVERS}},
    ],
)
def test_results_without_observers_fit_the_schema(found):
    results = _estimation(SimpleNamespace(result=lambda stage: found))
    _check(results, SCHEMA.keys["estimation"], "estimation", {"estimation": results})
    bare = dict.fromkeys(observers.OBSERVERS)
    with pytest.raises(InputError, match="without a reason"):
        _check(bare, SCHEMA.keys["estimation"], "estimation", {"estimation": bare})
