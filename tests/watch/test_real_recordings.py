"""The guard's monitor on the torque pendulum's real recordings, by limits that have not seen them."""

import importlib.util
import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hybrid_mpc import InputError, make_estimator, make_monitor, replay
from scenarios.torque_pendulum import scenario

ROOT = Path(__file__).parents[2]
RECORDINGS = ROOT.parent / "shared" / "data" / "torque_pendulum"
PRIOR = ROOT / "docs" / "results" / "torque_pendulum_quick_seed0.json"
SIGMA_X = (1.9e-4, 1.9e-2)
"""Process noise that the main job found for this prior [rad, rad/s]."""
PUSHES = {
    "energy_shaping_0p9Nm": ((6.9, 8.0), (11.5, 12.6), (15.9, 16.5)),
    "sac_0p9Nm": ((7.0, 7.8), (8.8, 9.3), (10.2, 11.2), (14.1, 15.3), (18.0, 18.6), (22.0, 22.5)),
    "ilqr_0p9Nm": ((2.7, 3.6), (10.0, 10.9)),
}
"""By hand [s]: what these recordings show between their clean windows, read off angle, torque and speed once the
alarms were known; nobody wrote them down."""
WINDOWS = {"a": [(0.0, 1.0)]}
SETTINGS = {"rate": 12.0, "resolution": [1e-3], "block_s": 1.0, "data_hash": ""}
needs_data = pytest.mark.skipif(not RECORDINGS.is_dir(), reason="the real recordings are not on this machine")


@pytest.fixture(scope="module")
def real():
    spec = importlib.util.spec_from_file_location("guard_real", ROOT / "benchmarks" / "guard_real.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look for their module there
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def model():
    """The fitted prior alone: it needs no training, and on these recordings it does as well as the hybrid."""
    from hybrid_mpc import PriorStep, model_info, trace_model
    from hybrid_mpc.kit.artifact import build_model

    values = json.loads(PRIOR.read_text())["parameters"]
    prior = scenario.prior(values)
    step = PriorStep(prior, scenario.data.dt).requires_grad_(False)
    programs = {f"prior/{name}": program for name, program in trace_model(step).items()}
    return build_model("prior", programs, model_info(prior, scenario.data.dt))


@pytest.fixture(scope="module")
def data(real, model):
    return real.read(RECORDINGS, model)


@pytest.fixture(scope="module")
def found(real, model, data):
    """Of the second recording what matters: the last push; then it stands for 15 s."""
    short = [r.part(r.t < 25.0, r.name, r.role) for r in data.whole]
    return {f.name: f for f in real.judge(model, SIGMA_X, replace(data, whole=tuple(short)))}


@pytest.mark.full
@needs_data
def test_no_alarm_in_clean_windows_of_a_recording_that_was_not_learned_from(found):
    assert sum(f.clean.sum() for f in found.values()) * 0.02 == pytest.approx(61.5, abs=0.3)
    assert {name: f.inside for name, f in found.items()} == {name: [] for name in found}
    # an alarm may end in the window after it: half a window and half a free run is what the monitor remembers
    assert max(f.left_over for f in found.values()) * 0.02 < 0.4


@needs_data
def test_every_push_by_hand_is_found_and_nothing_else(found):
    for name, f in found.items():
        pushes = PUSHES.get(name, ())
        for start, end in pushes:
            assert any(start <= a <= end for a, _ in f.outside), (name, start, end)
        for a, _ in f.outside:
            assert any(start <= a <= end for start, end in pushes), (name, a)


@needs_data
def test_a_torque_that_is_not_reported_is_found_in_a_clean_window(real, model, data, found):
    """The same recording, with 0.3 of its 1.5 N m taken off the recorded input for a second."""
    recording = next(r for r in data.whole if r.name == "energy_shaping_1p5Nm")
    start = recording.part(recording.t < 4.0, recording.name, recording.role)
    pushed = replace(start, u=start.u - 0.3 * ((start.t > 1.0) & (start.t < 2.0))[:, None])
    limits = found["energy_shaping_1p5Nm"].limits
    trace = replay(make_monitor(model, limits), make_estimator(model, scenario, np.array(SIGMA_X)), pushed)
    (first, _), *_ = trace.intervals()
    # While it acts: read half a window late, and at this torque 0.25 N m are three deviations, two of which count as 0.
    assert 1.0 < first < 2.0


@needs_data
def test_one_false_alarm_an_hour_cannot_be_told_from_a_minute(real, model, data):
    short = tuple(r.part(r.t < 3.5, r.name, r.role) for r in data.whole)
    for found in real.judge(model, SIGMA_X, replace(data, whole=short), rate=1.0):
        assert not found.limits.rated
        assert "0.5 false alarms an hour need 6.0 min" in found.limits.method


def test_windows_and_what_is_settled_in_them(real):
    t = 0.5 * np.arange(8)
    clean = real.clean_samples(t, [(0.0, 1.0), (1.5, 3.5)])
    assert clean.tolist() == [True, True, False, True, True, True, True, False]
    # the first second of either window is left out: two samples; of the first window nothing is left
    assert np.flatnonzero(real.settled_windows(t, clean, 1.0)).tolist() == [5, 6]


def test_bad_input_is_refused(real):
    class Recording:
        file = "a"

    with pytest.raises(InputError, match="at least two files"):
        real.leave_one_out(None, None, [Recording(), Recording()], WINDOWS, **SETTINGS)

    class Other(Recording):
        file = "b"

    with pytest.raises(InputError, match=r"no clean windows given for \['b'\]"):
        real.leave_one_out(None, None, [Recording(), Other()], WINDOWS, **SETTINGS)
