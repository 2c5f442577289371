"""Scales, thresholds, and what detector and learner refuse."""

import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from monitor_parts import DT, GAMMA, NOISE, Observer, by_hand, energy, of_force, pendulum, simulate

from hybrid_mpc import ChannelLimit, InputError, WatchLimits, learn_limits, replay
from hybrid_mpc.records import plain, record
from hybrid_mpc.watch.detector import Detector
from hybrid_mpc.watch.learn import levels_of, limits_of
from hybrid_mpc.watch.replay import with_alarms

WINDOW = {"window": 11, "free_run": 0.6}


@pytest.fixture(scope="module")
def learned():
    monitor = energy(**WINDOW)
    runs = [simulate(5000, s, noise=NOISE) for s in range(4)]
    limits = learn_limits(
        monitor.readings, Observer(monitor.model), runs, false_alarms_per_hour=30, data_hash="abc"
    )
    return runs, limits


def made(rng, n=30_000):
    """A trace of forces whose deviation is 0.1 at rest and grows with speed and input; no free runs."""
    t = np.arange(n) * DT
    v2, u2 = (2 * np.sin(0.7 * t)) ** 2, np.sin(1.3 * t) ** 2
    force = rng.normal(size=n) * np.sqrt(0.01 + 0.04 * v2 + 0.09 * u2)
    none = np.full((n, 4), np.nan)
    terms = np.stack([none, np.column_stack([np.ones(n), v2, u2, np.zeros(n)])], axis=1)
    nothing = np.zeros((n, 1))
    values = np.column_stack([np.zeros(n), force])
    return SimpleNamespace(
        t=t, values=values, terms=terms, settled=np.ones(n, bool), travel=nothing, repeats=nothing.astype(int)
    )


def of_made(trace, **options):
    return limits_of(energy().readings, [np.zeros((len(trace.t), 1))], [trace], **options)


def test_scale_is_found_again():
    limits = of_made(made(np.random.default_rng(0)), false_alarms_per_hour=20)
    v2, u2 = np.array([0.0, 4.0, 1.0]), np.array([0.0, 0.0, 1.0])
    variance = np.column_stack([np.ones(3), v2, u2, np.zeros(3)]) @ limits.channels[0].scale
    # a variance from 30,000 samples by three terms: a few per cent; where it is smallest some more
    np.testing.assert_allclose(np.sqrt(variance), np.sqrt(0.01 + 0.04 * v2 + 0.09 * u2), rtol=0.1)


@pytest.mark.parametrize(("fault", "limit"), [(pendulum(friction=2 * GAMMA), 0.6), (pendulum(push=0.1), 0.4)])
def test_small_faults_raise_the_alarm_in_time(learned, fault, limit):
    armed = energy(limits=learned[1], **WINDOW)
    run = simulate(700, seed=21, fault=fault, at=500, noise=NOISE)
    trace = replay(armed, Observer(pendulum()), run)
    assert not trace.alarm[60:500].any()
    first = np.flatnonzero(trace.alarm[500:])
    # limit: half the window, the sum, and one passage through rest [s]
    assert first.size
    assert first[0] * DT <= limit


def told(limit, values, terms=((1.0, 0.0, 0.0, 0.0),)):
    """State, levels and alarms of one limit along the values of its channel."""
    detector = Detector((limit,), (limit.channel,))
    state, levels, on = detector.initial(), [], []
    for value in values:
        state, (level,), _ = detector.update(state, [value], terms, True)
        levels.append(level)
        on.append(state.on[0])
    return state, levels, on


def test_sums_forget_what_has_passed():
    state, _, on = told(of_force(4.0, drift=0.5), [100.0] * 1000)
    assert max(state.sums) == 6.0  # 1.5 thresholds
    state, _, on = told(of_force(4.0, drift=0.5), [*[100.0] * 9, np.nan])
    assert max(state.sums) == 6.0  # a gap changes nothing
    assert on[-1]


def test_means_are_known_once_half_of_their_values_are():
    limit = ChannelLimit("q", "m", 4, 0.9, 0.9)
    _, levels, on = told(limit, [1.0, 1.0, 1.0, 1.0, np.nan, np.nan, np.nan, 0.5])
    np.testing.assert_allclose(levels, [np.nan] * 3 + [1.0, 1.0, 1.0, np.nan, np.nan])
    assert on == [False] * 3 + [True] * 3 + [False] * 2
    detector = Detector((limit,), ("q",))
    state, levels, share = detector.update(detector.initial(), [9.0], (), False)
    assert (state.counted, share) == (0, 0.0)  # not settled: it does not count


def test_the_bootstrap_is_around_the_fit(learned):
    for limit in learned[1].channels:
        low, high = limit.interval
        assert low < limit.threshold < high


def test_levels_are_those_of_the_update_and_of_alarms_after_the_fact(learned):
    runs, limits = learned
    armed, unarmed = energy(limits=limits, **WINDOW), energy(**WINDOW)
    part = replace(runs[0], t=runs[0].t[:500], y=runs[0].y[:500], u=runs[0].u[:500])
    trace = replay(unarmed, Observer(unarmed.model), part)
    seen = replay(armed, Observer(armed.model), part)
    again = with_alarms(armed, trace)
    for name in ("alarm", "on", "levels", "share", "frozen"):
        np.testing.assert_array_equal(getattr(again, name), getattr(seen, name))
    # no sum has come to its cap of 1.5 thresholds
    found = levels_of(armed.detector, [trace], [np.ones(500, bool)])
    np.testing.assert_allclose(np.column_stack([of[0] for of in found]), np.abs(seen.levels), rtol=1e-12)


def test_limits_survive_json(learned):
    never = ChannelLimit("wind", "m/s", 1, np.inf, np.inf)
    for part in (learned[1], replace(learned[1], channels=(never,), rest_speed=())):
        assert record(WatchLimits, json.loads(json.dumps(plain(part))), "") == part


def test_too_little_data_gives_a_margin_and_says_so():
    short = learn_limits(energy(**WINDOW).readings, Observer(pendulum()), [simulate(2000, noise=NOISE)])
    assert not short.rated
    assert short.channels[0].interval == ()
    assert "1.5 x the highest nominal level" in short.method
    assert "false alarms an hour need" in short.method


def test_bad_input_is_refused(learned):
    _, limits = learned
    spoiled = made(np.random.default_rng(1))
    spoiled.values[20_000:20_100, 1] += 2.0  # something pushed for two seconds
    with pytest.raises(InputError, match="HM-WATCH-023"):
        of_made(spoiled, false_alarms_per_hour=20)
    assert of_made(spoiled, false_alarms_per_hour=20, trusted=True).rated
    still = made(np.random.default_rng(1))
    still.values[:] = 0.0
    with pytest.raises(InputError, match="HM-WATCH-025"):
        of_made(still, false_alarms_per_hour=20)
    with pytest.raises(InputError, match="HM-WATCH-018"):
        limits_of(energy().readings, [], [])
    with pytest.raises(InputError, match=r"period.*0\.01.*HM-WATCH-008"):
        energy(limits=replace(limits, dt=0.01), **WINDOW)
    with pytest.raises(InputError, match=r"time.*HM-WATCH-008"):
        energy(limits=replace(limits, time_unit=2.0), **WINDOW)
    with pytest.raises(InputError, match="HM-WATCH-006"):
        energy(limits=limits, window=11)
    with pytest.raises(InputError, match="HM-WATCH-007"):
        energy(limits=by_hand(replace(of_force(4.0), scale=(1.0, 0.0))))
    with pytest.raises(InputError, match="HM-WATCH-001"):
        of_force(4.0, scale=0.0)
    with pytest.raises(InputError, match=r"field.*'lenght'.*did you mean 'length'.*HM-RECORDS-011"):
        record(ChannelLimit, {**plain(limits.channels[0]), "lenght": 1}, "calibration.json")
