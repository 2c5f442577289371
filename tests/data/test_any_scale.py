"""The same recording in other units of time and of its channels gives the same trajectories: 0.1 ms to hours."""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from machine_signals import machine

from hybrid_mpc import DataSpec, InputError, Signal, Window, load_trajectories
from hybrid_mpc.data.excitation import check_excitation, excitation_of
from hybrid_mpc.data.scales import time_scale

SPEC = DataSpec(
    "t", ("u",), ("y", "z"), dt=0.02, max_gap=0.05, smoothing=0.12, warm_up=0.2, disturbances=("w",),
    delays={"u": 0.013, "z": 0.004},
)  # fmt: skip
LENGTHS = "dt", "max_gap", "smoothing", "warm_up"
U, W = Signal("u", "V"), Signal("w", "K")
OUTPUTS = Signal("y", "m", saturation=(-2.0, 1.1)), Signal("z", "m")
MOTION = (*OUTPUTS, Signal("y_dot", "m/s"), Signal("z_dot", "m/s"))
STATES = {"positions": MOTION, "anything": MOTION[:1]}


def in_time(spec, k):
    """The specification with its lengths k times as long."""
    windows = {
        stem: tuple(Window(k * w.start, k * w.end, w.role) for w in windows)
        for stem, windows in spec.windows.items()
    }
    delays = {name: k * delay for name, delay in spec.delays.items()}
    return replace(
        spec, windows=windows, delays=delays, **{name: k * getattr(spec, name) for name in LENGTHS}
    )


def scaled(signal, k):
    ends = None if signal.saturation is None else tuple(k * end for end in signal.saturation)
    return replace(signal, saturation=ends)


def recording(seed, rows=420):
    """Jittered stamps with gaps, a slow output, blank cells, a clipped output, a disturbance."""
    rng = np.random.default_rng(seed)
    t = 0.01 * np.arange(rows) + (rng.uniform(0, 1e-4, rows) if seed % 2 else 0)
    t += 0.3 * (np.arange(rows) > rng.integers(100, 300)) * (seed % 3 == 0)
    y = np.minimum(np.sin(2 * t) + 0.5 * np.sin(7 * t), 1.1)
    y[rng.integers(0, rows, 10)] = np.nan
    y[150 : 150 + int(rng.integers(1, 30))] = np.nan
    z = np.where(np.arange(rows) % int(rng.integers(1, 12)) == 0, np.cos(3 * t), np.nan)
    return {"t": t, "u": np.sign(np.sin(5 * t)), "y": y, "z": z, "w": 20 + np.cos(t)}


def read(columns, spec, states, outputs=OUTPUTS, needed=()):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "run.npz"
        np.savez(path, **columns)
        return load_trajectories([path], machine(outputs, (U,), states, (W,)), spec, needed=needed)


def same_pieces(one, two):
    assert [(p.name, p.role, len(p.t)) for p in two] == [(p.name, p.role, len(p.t)) for p in one]
    assert all(len(p.t) for p in two)
    return zip(one, two, strict=True)


K = st.sampled_from([1e-4, 1e-2, 0.05, 1.0 / 3, 7.0, 60.0, 3600.0]) | st.floats(1e-4, 3.6e3)


@settings(max_examples=60, deadline=None)
@given(
    K, st.integers(0, 50), st.sampled_from(sorted(STATES)), st.booleans(), st.sampled_from([0.0, 5.0, -3.0])
)
def test_time_in_other_units(k, seed, kind, split, start):
    states, columns = STATES[kind], recording(seed)
    columns["t"] = columns["t"] + start
    windows = () if split else (Window(start, start + 2, "train"), Window(start + 2.1, start + 4.1, "test"))
    spec = replace(SPEC, windows={"run": windows} if windows else {})
    one = read(columns, spec, states)
    two = read({**columns, "t": k * columns["t"]}, in_time(spec, k), states)
    assert len(one.cuts) == len(two.cuts)
    for a, b in zip(one.cuts, two.cuts, strict=True):
        np.testing.assert_allclose((b.start_s / k, b.end_s / k), (a.start_s, a.end_s), atol=1e-9)
    assert [(f.kind, f.channel, f.count) for f in one.findings] == [
        (f.kind, f.channel, f.count) for f in two.findings
    ]
    pieces = [*same_pieces(one.whole, two.whole), *same_pieces(one.trajectories, two.trajectories)]
    assert pieces
    for a, b in pieces:
        np.testing.assert_allclose(b.t / k, a.t, atol=1e-9)
        np.testing.assert_array_equal(a.censored, b.censored)
        for name in ("y", "u", "w"):
            # rounding of stamps, 1e-16 of some seconds, over a sampling interval of 10 ms
            np.testing.assert_allclose(getattr(b, name), getattr(a, name), atol=1e-9, err_msg=name)
        half = a.x.shape[1] // 2
        rates = np.r_[np.ones(half), np.full(a.x.shape[1] - half, k)]
        # the gain of a second derivative over 0.12 s is some thousands
        np.testing.assert_allclose(b.x * rates, a.x, atol=1e-7)
        np.testing.assert_allclose(b.xdot * rates * k, a.xdot, atol=1e-6)


@pytest.mark.full
@settings(max_examples=40, deadline=None)
@given(st.floats(1e-6, 1e6), st.floats(1e-6, 1e6), st.integers(0, 50), st.sampled_from(sorted(STATES)))
def test_channels_in_other_units(k, u, seed, kind):
    states, columns = STATES[kind], recording(seed)
    one = read(columns, SPEC, states)
    outputs = scaled(OUTPUTS[0], k), OUTPUTS[1]
    more = {"y": k * columns["y"], "u": u * columns["u"], "w": u * columns["w"]}
    two = read({**columns, **more}, SPEC, states, outputs)
    assert one.cuts == two.cuts
    assert [(f.kind, f.channel, f.count) for f in one.findings] == [
        (f.kind, f.channel, f.count) for f in two.findings
    ]
    for a, b in same_pieces(one.whole, two.whole):
        np.testing.assert_array_equal(a.censored, b.censored)
        np.testing.assert_allclose(b.y / [k, 1], a.y, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(b.u / u, a.u, atol=1e-9)
        np.testing.assert_allclose(b.w / u, a.w, rtol=1e-9)
        if kind == "positions":
            np.testing.assert_allclose(b.x / [k, 1, k, 1], a.x, atol=1e-9)


@pytest.mark.parametrize("k", [1e-4 / 0.02, 3600 / 0.02])
def test_excitation_and_time_scale_follow_the_period(k):
    columns = recording(4)
    one = read(columns, SPEC, MOTION).whole
    two = read({**columns, "t": k * columns["t"]}, in_time(SPEC, k), MOTION).whole
    np.testing.assert_allclose(
        k * np.array(excitation_of(two)[0].lines), excitation_of(one)[0].lines, rtol=1e-6
    )
    assert check_excitation(two) == ()
    assert time_scale(two, k * 0.02) == pytest.approx(k * time_scale(one, 0.02), rel=1e-6)


@pytest.mark.parametrize("k", [1e-4, 3600.0])
def test_too_short_a_recording_is_told_so_in_any_unit(k):
    columns = {name: column[:60] for name, column in recording(4).items()}
    with pytest.raises(InputError, match="HM-DATA-114"):
        read({**columns, "t": k * columns["t"]}, in_time(SPEC, k), MOTION, needed=("train", "valid", "test"))
