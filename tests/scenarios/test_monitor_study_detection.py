"""Methods of detection, learned and judged alike, on made-up readings."""

import math

import numpy as np
import pytest
from monitor_parts import energy

from hybrid_mpc import InputError
from scenarios.golf_robot.monitor_study.detection import METHODS, Trace, learn_detectors

STEP, RATE = 1.5e-3, 2.5
PERIODS = 9_000  # 180 s: 35 blocks of 5 s after the first second
READINGS = energy(window=11, free_run=0.6, rest_speed=0.2).readings


def trace(seed, force=0.0, output=0.0):
    """Noise; from the middle on a lasting force, or outputs off by so much."""
    rng = np.random.default_rng(seed)
    speed, one = np.sin(0.05 * np.arange(PERIODS)), np.ones(PERIODS)
    values = np.zeros((PERIODS, 3))
    values[:, 1] = rng.normal(scale=0.01, size=PERIODS)
    values[:, 2] = rng.normal(scale=0.01, size=PERIODS) / 0.4
    of_force = np.column_stack([one, speed**2, 0.01 * speed**2, 1 / (1 + speed**2 / 0.04)])
    of_power = np.column_stack([one, speed**2, 0.01 * speed**2, one / 0.4])
    terms = np.stack([np.full((PERIODS, 4), np.nan), of_force, of_power], axis=1)
    innovation = rng.normal(scale=5e-4, size=(PERIODS, 1))
    half = PERIODS // 2
    values[half:, 1] += force
    innovation[half:] += output
    values[:, 0] = np.abs(values[:, 1] * speed)
    return Trace(
        values, terms, np.zeros((PERIODS, 1)), innovation, (innovation[:, 0] / 5e-4) ** 2, np.abs(speed)
    )


@pytest.fixture(scope="module")
def detectors():
    return learn_detectors([trace(seed) for seed in range(2)], READINGS, (STEP,), rate=RATE)


def found(detectors, which, method):
    return detectors.alarm(detectors.levels(which), which, method, RATE)


def test_each_sees_what_it_is_for(detectors):
    half = PERIODS // 2
    force, output = trace(20, force=0.1), trace(21, output=3e-3)
    for method, sees in {"guard": (1, 0), "innovation_rms": (0, 1), "guard_or_innovation": (1, 1)}.items():
        for which, seen in zip((force, output), sees, strict=True):
            alarm = found(detectors, which, method)
            assert not alarm[:half].any()  # 90 s at 2.5 an hour: one in sixteen seeds alarms
            # ten deviations of either pass any threshold within half a second
            assert alarm[half : half + 25].any() == bool(seen)


def test_a_frozen_sensor_is_one_whose_travel_passes_three_steps(detectors):
    frozen = trace(12)
    frozen.travel[6000:6005] = 3.1 * STEP
    assert np.flatnonzero(found(detectors, frozen, "guard")).tolist() == list(range(6000, 6005))


def test_rates_are_shared_and_thresholds_fall_with_them(detectors):
    assert detectors.threshold("forces", 1.0) > detectors.threshold("forces", 10.0)
    assert detectors.limits_at(2.0).channels[0].threshold == detectors.threshold("forces", 1.0)
    for shares in METHODS.values():
        assert math.isclose(sum(shares.values()), 1.0)


def test_too_little_data_says_how_much_is_needed():
    with pytest.raises(InputError, match=r"2\.9.*12\.0.*HM-SCENARIOS-010"):
        learn_detectors([trace(0)], READINGS, (STEP,), rate=1.0)
