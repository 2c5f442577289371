"""What recordings of any machine hold: disturbances, missing samples, sensors that end, delays, any headers."""

import re
from dataclasses import replace

import numpy as np
import pytest
from machine_signals import machine
from scipy.io import savemat

from hybrid_mpc import DataSpec, InputError, Signal, Window, load_trajectories, write_csv
from hybrid_mpc.data.excitation import check_excitation
from hybrid_mpc.data.recording import censored_of, read_recording
from hybrid_mpc.data.scales import noise_of, time_scale
from hybrid_mpc.data.trajectories import ROLES, Trajectory, line_mean, to_grid

SPEC = DataSpec("t", ("u",), ("y",), dt=0.02, max_gap=0.05, smoothing=0.1, warm_up=0.2)
U, Y, W = Signal("u", "V"), Signal("y", "m", -100, 100), Signal("wind", "m/s", -50, 50)
GIVEN = {"inputs": (U,), "outputs": (Y,)}
T = 0.01 * np.arange(600)
GOOD = {"t": T, "u": np.sign(np.sin(3 * T)), "y": np.sin(2 * T), "wind": 5 + np.cos(T)}
WINDY = replace(SPEC, disturbances=("wind",))
STATES = (Signal("h1", "m"), Signal("h2", "m"), Signal("T", "K"))


def wrote(tmp_path, name="run.csv", **columns):
    return write_csv(tmp_path / name, {**GOOD, **columns})


def read(files, spec=SPEC, needed=ROLES, **more):
    files = files if isinstance(files, list) else [files]
    return load_trajectories(files, machine(**{**GIVEN, **more}), spec, needed=needed)


def problems(files, spec=SPEC, **more):
    with pytest.raises(InputError) as caught:
        read(files, spec, **more)
    return caught.value.problems


def blank(array, where):
    return np.where(where, np.nan, array)


# Disturbances


def test_disturbances_are_means_of_straight_lines_over_each_period(tmp_path):
    file = wrote(tmp_path)
    (whole,) = read(file, WINDY, disturbances=(W,)).whole
    # the mean of the cosine over a period; a straight line over 10 ms leaves h^2 / 8 = 1.3e-5
    mean = 5 + (np.sin(whole.t + 0.02) - np.sin(whole.t)) / 0.02
    np.testing.assert_allclose(whole.w[:, 0], mean, atol=2e-5)
    data = read(file, WINDY, disturbances=(W,))
    assert all(piece.w.shape == (len(piece.t), 1) for piece in data.trajectories)
    piece = data.trajectories[1]
    at = np.searchsorted(whole.t, piece.t[0] - 1e-9)
    np.testing.assert_array_equal(piece.w, whole.w[at : at + len(piece.t)])
    assert read(file).whole[0].w.shape == (len(whole.t), 0)


def test_the_mean_of_lines_is_exact_whatever_the_stamps():
    rng = np.random.default_rng(0)
    t = np.cumsum(rng.uniform(0.001, 0.03, 300))
    w = rng.standard_normal(300)
    grid = t[0] + 0.02 * np.arange(int((t[-1] - t[0]) / 0.02))
    fine = np.linspace(0, 0.02, 20_001)
    brute = [np.trapezoid(np.interp(s + fine, t, w), fine) / 0.02 for s in grid[:40]]
    # the trapezoid of a kinked line misses steps of a thousandth of a millisecond at most
    np.testing.assert_allclose(line_mean(t, w, grid, 0.02)[:40], brute, atol=1e-6)


def test_a_slow_sensor_of_a_disturbance_is_bridged_and_what_it_does_not_cover_is_cut(tmp_path):
    slow = blank(GOOD["wind"], np.arange(600) % 100 != 50)
    data = read(wrote(tmp_path, wind=slow), WINDY, disturbances=(W,))
    (whole,) = data.whole
    assert (whole.t[0], whole.t[-1]) == pytest.approx((0.5, 5.48))
    ends = [(cut.start_s, cut.end_s) for cut in data.cuts if "not covered" in cut.why]
    assert ends == [pytest.approx((0.0, 0.5)), pytest.approx((5.5, 5.99))]
    lines = np.interp(whole.t + 0.01, T[50::100], slow[50::100])
    np.testing.assert_allclose(whole.w[:, 0], lines, atol=1e-9)  # no kink within a period
    (finding,) = data.findings
    told = finding.kind, finding.channel, finding.count, finding.start
    assert told == ("missing", "wind", 594, 0.0)
    assert "594 of 600 rows (99 %)" in str(finding)
    assert "the longest gap is 1 s" in str(finding)


def test_trajectories_are_made_without_disturbances():
    zero = np.zeros((5, 1))
    plain = Trajectory("a", "", 0.1, 0.1 * np.arange(5), zero, zero, zero, zero)
    assert plain.w.shape == (5, 0)
    assert plain.censored.dtype == np.int8
    assert not plain.censored.any()
    short = replace(plain, t=plain.t[:3], u=zero[:3], y=zero[:3], x=zero[:3], xdot=zero[:3])
    assert (short.w.shape, short.censored.shape) == ((3, 0), (3, 1))
    full = replace(
        plain, w=np.arange(5.0)[:, None], censored=np.array([[0], [1], [0], [-1], [0]], dtype=np.int8)
    )
    part = full.part(slice(1, 4))
    assert part.w.ravel().tolist() == [1, 2, 3]
    assert part.censored.ravel().tolist() == [1, 0, -1]
    masked = full.part(full.t > 0.25)
    assert masked.censored.ravel().tolist() == [-1, 0]
    with pytest.raises(ValueError, match="HM-DATA-062"):
        replace(plain, w=np.zeros((4, 1)))
    with pytest.raises(ValueError, match="HM-DATA-062"):
        replace(full, y=np.zeros((5, 2)))


# Missing samples


def test_a_short_hole_is_bridged_and_a_long_one_is_not(tmp_path):
    hole = np.zeros(600, dtype=bool)
    hole[100:103] = True  # 40 ms from sample to sample
    hole[200:260] = True
    data = read(wrote(tmp_path, y=blank(GOOD["y"], hole)))
    (whole,) = data.whole
    missing = np.isnan(whole.y[:, 0])
    # samples at 1.99 and 2.60 s bound the hole; 1.99 lies between two grid points and counts for 1.98, which has one
    assert whole.t[missing] == pytest.approx(np.arange(2.0, 2.59, 0.02))
    known = ~missing
    np.testing.assert_allclose(whole.y[known, 0], np.sin(2 * whole.t[known]), atol=1e-3)  # 4 * 0.04^2 / 8
    np.testing.assert_array_equal(np.isnan(whole.x[:, 0]), missing)
    # smoothing does not see the other side: at its ends it is as good as at any end. A straight line over 40 ms is
    # 4 * 0.04^2 / 8 = 8e-4 off, which over the 40 ms makes some 0.02 of speed
    motion = np.c_[np.sin(2 * whole.t), 2 * np.cos(2 * whole.t)]
    bridged = np.abs(whole.t - 1.01) < 0.08
    np.testing.assert_allclose(whole.x[known & ~bridged], motion[known & ~bridged], atol=2e-3)
    np.testing.assert_allclose(whole.x[bridged], motion[bridged], atol=0.03)
    assert np.isfinite(whole.u).all()
    assert [(f.kind, f.count) for f in data.findings] == [("missing", 63)]
    far = (whole.t < 0.9) | ((whole.t > 1.2) & (whole.t < 1.9))
    np.testing.assert_allclose(whole.x[far], read(wrote(tmp_path)).whole[0].x[far], atol=1e-12)  # rounding


@pytest.mark.parametrize("every", [10, 7])
def test_a_slow_output_has_values_at_its_samples_alone(tmp_path, every):
    slow = np.arange(600) % every == 3
    spec = replace(SPEC, outputs=("y", "c"))
    outputs = (Y, Signal("c", "%", 0, 100))
    content = 50 + 20 * np.sin(T)
    file = wrote(tmp_path, c=blank(content, ~slow))
    (whole,) = read(file, spec, outputs=outputs, states=STATES).whole
    assert np.isfinite(whole.y[:, 0]).all()
    there = np.flatnonzero(np.isfinite(whole.y[:, 1]))
    samples = T[slow & (whole.t[-1] + 0.0099 > T)]
    assert len(there) == len(samples)  # each counts once, and nothing else is there
    assert np.abs(whole.t[there] - samples).max() <= 0.01 + 1e-9  # half a period
    np.testing.assert_allclose(
        whole.y[there, 1], np.interp(samples, T, content), rtol=1e-9
    )  # as it was measured
    assert np.isnan(whole.x).all()
    assert whole.x.shape == (len(whole.t), 3)


def test_samples_closer_than_a_coarse_grid_and_farther_than_max_gap(tmp_path):
    """Several lone samples near one grid point: the nearest is taken."""
    t = np.array([0.0, 0.9, 1.05, 1.3, 2.6])
    values, flags = to_grid(t, np.arange(5.0), np.zeros(5, dtype=np.int8), np.arange(4.0), 1.0, 0.1)
    np.testing.assert_array_equal(values, [0.0, 2.0, np.nan, 4.0])
    assert not flags.any()
    values, _ = to_grid(t, np.full(5, np.nan), np.zeros(5, dtype=np.int8), np.arange(4.0), 1.0, 0.1)
    assert np.isnan(values).all()
    half = to_grid(np.array([0.5]), np.ones(1), np.zeros(1, dtype=np.int8), np.arange(4.0), 1.0, 0.1)[0]
    np.testing.assert_array_equal(half, [1.0, np.nan, np.nan, np.nan])


def test_an_output_of_two_may_be_missing_where_the_other_is_not(tmp_path):
    """Smoothing of one is not poisoned by the other."""
    spec = replace(SPEC, outputs=("y", "z"))
    z = blank(np.cos(T), (T > 2) & (T < 4))
    states = (Y, Signal("z", "m"), Signal("v", "m/s"), Signal("vz", "m/s"))
    two = {"outputs": (Y, Signal("z", "m")), "states": states}
    (whole,) = read(wrote(tmp_path, z=z), spec, **two).whole
    (one,) = read(wrote(tmp_path, "one.csv")).whole
    np.testing.assert_array_equal(whole.x[:, [0, 2]], one.x)
    np.testing.assert_array_equal(whole.xdot[:, [0, 2]], one.xdot)
    gone = (whole.t > 2.001) & (whole.t < 3.999)
    assert np.isnan(whole.x[gone][:, [1, 3]]).all()
    assert np.isfinite(whole.x[~gone]).all()


def test_blank_cells_of_all_formats(tmp_path):
    y = blank(GOOD["y"], np.arange(600) == 300)
    columns = {**GOOD, "y": y}
    np.savez(tmp_path / "a.npz", **columns)
    savemat(tmp_path / "b.mat", columns)
    write_csv(tmp_path / "c.csv", columns)
    text = (tmp_path / "c.csv").read_text().splitlines()
    for name, cell in (("d.csv", ""), ("e.csv", " "), ("f.csv", "NaN"), ("g.csv", "N/A")):
        cells = text[301].split(",")
        lines = [*text[:301], ",".join([*cells[:2], cell, *cells[3:]]), *text[302:]]
        (tmp_path / name).write_text("\n".join(lines))
    for file in sorted(tmp_path.iterdir()):
        recording = read_recording(file, machine(**GIVEN), SPEC)
        assert np.flatnonzero(np.isnan(recording.y[:, 0])).tolist() == [300], file.name
        assert [f.kind for f in recording.findings] == ["missing"]


def test_inputs_and_times_must_be_known_and_an_output_must_have_been_measured(tmp_path):
    hole = np.arange(600) == 30
    told = problems(
        [
            wrote(tmp_path, "a.csv", u=blank(GOOD["u"], hole), y=blank(GOOD["y"], T < 9)),
            wrote(tmp_path, "b.csv", t=blank(T, hole)),
        ]
    )
    assert len(told) == 3
    assert "a.csv: row 32, column 'u' is 'nan', not a finite number" in told[0]
    assert "a.csv: column 'y' has no number in any row; y was not measured" in told[1]
    assert "b.csv: row 32, column 't'" in told[2]
    told = problems(wrote(tmp_path, wind=blank(T, T < 9)), WINDY, disturbances=(W,))
    assert len(told) == 1
    assert "run.csv: column 'wind' has no number in any row; wind was not measured" in told[0]
    # in a column that may have blanks, text and infinite numbers are as wrong as ever
    (told,) = problems(wrote(tmp_path, y=np.where(hole, np.inf, blank(GOOD["y"], T > 5))))
    assert "row 32, column 'y' is 'inf', not a finite number. " in told


def test_a_part_without_any_measurement_has_no_role(tmp_path):
    spec = replace(SPEC, windows={"run": (Window(0, 3, "train"), Window(3.5, 5.9, "valid"))})
    data = read(wrote(tmp_path, y=blank(GOOD["y"], T > 3.4)), spec, needed=("train",))
    assert [piece.role for piece in data.trajectories] == ["train"]
    assert [cut.why for cut in data.cuts] == ["valid: no sample of any output"]


def test_wrapped_angles_with_holes_count_on(tmp_path):
    angle = 3 * T
    wrapped = blank((angle + np.pi) % (2 * np.pi) - np.pi, np.arange(600) % 5 == 2)
    spec, turns = replace(SPEC, outputs=("y",)), {**GIVEN, "outputs": (Signal("phi", "rad", periodic=True),)}
    recording = read_recording(wrote(tmp_path, y=wrapped), machine(**turns), spec)
    known = np.isfinite(wrapped)
    np.testing.assert_allclose(recording.y[known, 0], angle[known], atol=1e-8)  # ten digits
    assert sorted(f.kind for f in recording.findings) == ["missing", "wrapped"]


def test_scales_and_excitation_of_slow_outputs():
    t = 0.02 * np.arange(20_000)
    rng = np.random.default_rng(0)
    slow = blank(np.sin(2 * np.pi * t / 20) + 1e-4 * rng.standard_normal(len(t)), np.arange(len(t)) % 10 != 4)
    fast = 3.0 + 1e-5 * rng.standard_normal(len(t))
    zero = np.zeros((len(t), 1))
    run = Trajectory("a", "train", 0.02, t, np.sin(t)[:, None], np.c_[slow, fast], zero, zero)
    assert time_scale([run], 0.02) == pytest.approx(20.0, rel=0.05)
    # 0.2 s of a sine of 20 s move (2 pi / 100)^3 = 2.5e-4 in third differences, 4e-5 of their standard deviation
    np.testing.assert_allclose(noise_of([run]), [1e-4, 1e-5], rtol=0.3)
    assert check_excitation([run]) == ()
    still = replace(run, y=np.c_[blank(np.full(len(t), 2.0), np.isnan(slow)), fast])
    with pytest.raises(InputError, match=r"output 1.*HM-DATA-022"):
        check_excitation([still])


# Sensors that end


CLIPPED = Signal("level", "m", -1, 2, saturation=(-0.5, 0.7))


def test_samples_at_the_ends_of_a_sensor_are_censored(tmp_path):
    exact = np.sin(2 * T)
    data = read(wrote(tmp_path, y=np.clip(exact, -0.5, 0.7)), outputs=(CLIPPED,), states=(Signal("h", "m"),))
    (whole,) = data.whole
    at = np.sin(2 * whole.t)
    np.testing.assert_array_equal(whole.censored[:, 0], np.where(at >= 0.7, 1, np.where(at <= -0.5, -1, 0)))
    assert data.findings == ()  # declared: nothing to say
    assert {-1, 0, 1} == {flag for piece in data.trajectories for flag in piece.censored.ravel().tolist()}
    # the truth is on the side that is said
    assert (at[whole.censored[:, 0] == 1] >= whole.y[whole.censored[:, 0] == 1, 0]).all()
    (plain,) = read(wrote(tmp_path)).whole
    assert not plain.censored.any()


def test_the_finding_of_a_clipped_sensor_names_the_remedy(tmp_path):
    file = wrote(tmp_path, y=np.clip(GOOD["y"], -0.5, 2.0))
    (finding,) = read(file).findings
    assert finding.kind == "clipped"
    assert "declare Signal(..., saturation=(-0.5, math.inf)) for y" in str(finding)
    assert read(file, outputs=(replace(Y, saturation=(-0.5, np.inf)),)).findings == ()
    (finding,) = read(file, outputs=(replace(Y, saturation=(-np.inf, 0.9)),)).findings  # another end
    assert "saturation=(-0.5, 0.9)" in str(finding)


def test_between_a_measured_and_a_censored_sample_the_grid_has_a_bound():
    t, y = np.arange(6.0), np.array([0.5, 1.0, 1.0, -1.0, 0.0, 1.0])
    flags = censored_of(y[:, None], (Signal("y", "m", saturation=(-1, 1)),))[:, 0]
    assert flags.tolist() == [0, 1, 1, -1, 0, 1]
    grid = np.array([0.0, 0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 4.5, 5.0])
    values, found = to_grid(t, y, flags, grid, 0.5, 1.0)
    assert found.tolist() == [0, 1, 1, 1, 1, 0, -1, -1, 0, 1, 1]
    np.testing.assert_array_equal(
        values, [0.5, 0.75, 1, 1, 1, np.nan, -1, -0.5, 0, 0.5, 1]
    )  # from end to end: unknown


def test_what_is_no_range_of_a_sensor():
    for saturation in ((1.0, 1.0), (2.0, 1.0), (0.0, float("nan"))):
        with pytest.raises(InputError, match=r"signal y \[m\]: saturation"):
            Signal("y", "m", saturation=saturation)
    with pytest.raises(InputError, match="HM-MACHINE-021"):
        Signal("y", "rad", periodic=True, saturation=(0, 1))


# Known delays


def smooth(t):
    return np.sin(2 * t) + 0.3 * np.sin(5 * t)


def test_known_delays_bring_columns_together(tmp_path):
    t = T + 3.0  # the recording's own time goes on
    late = {"u": 0.013, "y": 0.137, "wind": 0.05}
    columns = {"t": t, "u": smooth(t + 0.013), "y": smooth(t - 0.137), "wind": smooth(t - 0.05)}
    spec = replace(WINDY, delays=late)
    data = read(write_csv(tmp_path / "run.csv", columns), spec, disturbances=(W,))
    (whole,) = data.whole
    np.testing.assert_allclose(whole.y[:, 0], smooth(whole.t), atol=1e-4)  # 9.5 h^2 / 8 at 10 ms
    fine = whole.t[:, None] + np.linspace(0, 0.02, 201)
    mean = np.trapezoid(smooth(fine), fine, axis=1) / 0.02
    np.testing.assert_allclose(whole.w[:, 0], mean, atol=1e-4)
    np.testing.assert_allclose(whole.x[:, 0], smooth(whole.t), atol=1e-4)
    # an input is held from its stamp, shifted by 13 ms, to the next: on average it is 5 ms old
    np.testing.assert_allclose(whole.u[:, 0], mean, atol=0.005 * 3.5)
    assert whole.t[0] == pytest.approx(3.013)  # inputs are known from then on
    assert t[-1] - 0.137 - 0.02 <= whole.t[-1] + whole.dt <= t[-1] - 0.137 + 1e-9  # outputs until then
    ends = [(cut.start_s, cut.end_s) for cut in data.cuts if "not covered" in cut.why]
    assert ends == [pytest.approx((3.0, 3.013)), pytest.approx((t[-1] - 0.137, t[-1]))]


def test_the_delay_of_a_held_input_is_exact(tmp_path):
    """Fractions of a sample: the impulse of each step arrives when it should."""
    step = np.where(T >= 1.0, 1.0, 0.0)
    (whole,) = read(wrote(tmp_path, u=step), replace(SPEC, delays={"u": 0.0153})).whole
    ends = whole.t + 0.02
    np.testing.assert_allclose(whole.u[:, 0], np.clip((ends - 1.0153) / 0.02, 0, 1), atol=1e-9)


def test_delays_of_single_recordings_and_negative_ones(tmp_path):
    files = [wrote(tmp_path, f"{name}.csv", u=GOOD["u"] + k) for k, name in enumerate("abc")]
    spec = replace(SPEC, delays={"y": 0.1}, delays_of={"b": {"y": 0.0}, "c": {"y": -0.1, "u": 0.04}})
    a, b, c = read(files, spec).whole
    for whole, late, start in ((a, 0.1, 0.0), (b, 0.0, 0.0), (c, -0.1, 0.1)):
        np.testing.assert_allclose(whole.y[:, 0], np.sin(2 * (whole.t + late)), atol=1e-4)
        assert whole.t[0] == pytest.approx(start)


def test_delays_are_taken_off_each_side_of_a_gap(tmp_path):
    keep = (T < 2) | (T > 2.5)
    columns = {name: column[keep] for name, column in GOOD.items()}
    data = read(write_csv(tmp_path / "run.csv", columns), replace(SPEC, delays={"u": 0.3}))
    assert [whole.t[0] for whole in data.whole] == pytest.approx([0.3, 2.51 + 0.3])
    early = read(write_csv(tmp_path / "run.csv", columns)).whole
    for late, whole in zip(data.whole, early, strict=True):
        np.testing.assert_allclose(late.u, whole.u[: len(late.u)], atol=1e-9)  # the same inputs, later


def test_delays_longer_than_a_piece_leave_nothing(tmp_path):
    (told,) = problems(wrote(tmp_path), replace(SPEC, delays={"u": 7.0}))
    assert "shorter than the 0.4 s" in told


def test_bad_delays(tmp_path):
    file = wrote(tmp_path)
    spec = replace(SPEC, delays={"yy": 0.1}, delays_of={"run": {"t": 0.1}})
    told = problems(file, spec)
    assert "delays names column 'yy'" in told[0]
    assert "delays_of 'run' names column 't'" in told[1]
    with pytest.raises(InputError, match="HM-RECORDS-007"):
        replace(SPEC, delays={"y": float("nan")})


# Columns


def test_a_column_has_one_role(tmp_path):
    file = wrote(tmp_path)
    for spec, words in (
        (replace(SPEC, inputs=("y",)), "column 'y' is named in inputs and outputs"),
        (replace(SPEC, inputs=("t",)), "column 't' is named in inputs and time"),
        (replace(WINDY, disturbances=("u",)), "column 'u' is named in disturbances and inputs"),
        (replace(SPEC, inputs_of={"run": ("y",)}), "column 'y' is named in inputs_of 'run' and outputs"),
    ):
        more = {"disturbances": (W,)} if spec.disturbances else {}
        assert words in " ".join(problems(file, spec, **more))
    with pytest.raises(InputError, match=r"column 'y'.*HM-RECORDS-004"):
        replace(SPEC, outputs=("y", "y"))


def test_a_disturbance_may_be_a_files_own_input(tmp_path):
    """Asked for by name: there the supply was the command."""
    spec = replace(WINDY, inputs_of={"b": ("wind",)})
    a, b = read([wrote(tmp_path, "a.csv"), wrote(tmp_path, "b.csv")], spec, disturbances=(W,)).whole
    np.testing.assert_array_equal(a.w, b.w)
    np.testing.assert_allclose(b.u, b.w, atol=0.01)
    np.testing.assert_array_less(np.abs(a.u), 1 + 1e-12)  # sums of impulses
    hole = blank(GOOD["wind"], np.arange(600) == 30)  # as an input it must be known
    assert (
        "column 'wind' is 'nan'" in problems(wrote(tmp_path, "b.csv", wind=hole), spec, disturbances=(W,))[0]
    )


def test_one_column_under_two_names(tmp_path):
    savemat(tmp_path / "run.mat", {"run": GOOD})
    (told,) = problems(tmp_path / "run.mat", replace(SPEC, inputs=("run.y",)))
    assert re.search(r"'run.y' and 'y'.*HM-DATA-069", told)


def test_counts_of_columns_name_the_signals(tmp_path):
    told = problems(wrote(tmp_path), replace(SPEC, inputs_of={"x": ("a", "b")}), disturbances=(W,), inputs=())
    assert told[0].startswith(
        "data specification: inputs has 1 column ('u') for a prior with 0 inputs (none)"
    )
    assert "disturbances has 0 columns (none) for a prior with 1 disturbance (wind [m/s])" in told[1]
    assert "inputs_of 'x' has 2 columns ('a', 'b') for a prior with 0 inputs" in told[2]


def test_outputs_that_are_no_positions_have_no_states_yet(tmp_path):
    file = wrote(tmp_path)
    rough = replace(SPEC, smoothing=0.02)  # too few samples for a polynomial, and none is needed
    data = read(file, rough, states=STATES)
    assert all(np.isnan(piece.x).all() and piece.x.shape[1] == 3 for piece in data.trajectories)
    assert all(np.isnan(piece.xdot).all() for piece in data.trajectories)
    # as many as two to an output, but of other names
    (whole,) = read(file, states=(Signal("h", "m"), Signal("v", "m/s", -1e-3, 1e-3))).whole
    assert np.isnan(whole.x).all()
    # speeds of positions are checked, those of anything else are not
    slow = Signal("v", "m/s", -1.5, 1.5)
    assert [f.kind for f in read(file, states=(Y, slow)).findings] == ["speed"]
    assert read(file, states=(Signal("h", "m"), slow)).findings == ()
    with pytest.raises(InputError, match=r"0\.02.*HM-DATA-006"):
        read(file, rough, states=(Y, slow))


# Files


def test_a_sampling_time_in_place_of_a_column(tmp_path):
    plain = read(wrote(tmp_path)).whole[0]
    columns = {name: column for name, column in GOOD.items() if name != "t"}
    write_csv(tmp_path / "a.csv", columns)
    np.savez(tmp_path / "b.npz", **columns)
    savemat(tmp_path / "c.mat", columns)
    for name in ("a.csv", "b.npz", "c.mat"):
        (whole,) = read(tmp_path / name, replace(SPEC, time=0.01)).whole
        np.testing.assert_allclose(whole.t, plain.t, atol=1e-12)
        for name in ("u", "y", "x"):
            np.testing.assert_allclose(getattr(whole, name), getattr(plain, name), atol=1e-6)  # ten digits
    (told,) = problems(tmp_path / "a.csv", replace(SPEC, time=1.0))
    assert "check that the sampling time of 1 s is in seconds" in told
    for time in (0.0, -1.0, float("inf"), float("nan")):
        with pytest.raises(InputError, match="HM-RECORDS-012"):
            replace(SPEC, time=time)


@pytest.mark.parametrize(
    ("separator", "comma"), [(";", True), (";", False), ("\t", True), ("\t", False), (",", False)]
)
def test_separators_and_decimal_commas(tmp_path, separator, comma):
    plain = wrote(tmp_path)
    lines = [line.split(",") for line in plain.read_text().splitlines()]
    if comma:
        lines = [[cell.replace(".", ",") for cell in line] for line in lines]
    other = tmp_path / "other.csv"
    other.write_text("\ufeff" + "\r\n".join(separator.join(line) for line in lines), encoding="utf-8")
    a, b = (read_recording(file, machine(**GIVEN), SPEC) for file in (plain, other))
    for name in ("t", "u", "y"):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name))


def test_two_decimal_marks_are_refused(tmp_path):
    file = tmp_path / "run.csv"
    file.write_text("t;u;y\n0;1;1,5\n0.01;1;1,5\n")
    (told, *_) = problems(file)
    assert re.search(r"0\.01 and 1,5.*HM-DATA-097", told)
    file.write_text("t;u;y\n0;1\n")
    assert "row 2 has 2 cells" in problems(file)[0]


def test_names_with_units_in_brackets(tmp_path):
    columns = {"t [ms]": 1e3 * T, "u (V)": GOOD["u"], "y [mm]": 1e3 * GOOD["y"]}
    write_csv(tmp_path / "run.csv", columns)
    (plain,) = read(wrote(tmp_path, "plain.csv")).whole
    (whole,) = read(tmp_path / "run.csv").whole
    for name in ("t", "u", "y"):
        np.testing.assert_allclose(getattr(whole, name), getattr(plain, name), atol=1e-9)  # ten digits
    # the specification has the last word
    (other,) = read(tmp_path / "run.csv", replace(SPEC, units={"y": 1e-6})).whole
    np.testing.assert_allclose(other.y, 1e-3 * plain.y, atol=1e-9)
    write_csv(tmp_path / "run.csv", {"t": T, "u [counts]": GOOD["u"], "y": GOOD["y"], "y (filtered)": T})
    assert "'counts'" in problems(tmp_path / "run.csv")[0]  # nobody knows it
    (whole,) = read(tmp_path / "run.csv", replace(SPEC, units={"u": 1.0})).whole
    np.testing.assert_allclose(whole.y, plain.y, atol=1e-9)  # its own name comes first
    write_csv(tmp_path / "run.csv", {"t": T, "u": GOOD["u"], "y [m]": GOOD["y"], "y [mm]": T})
    assert re.search(r"'y \[m\]' or 'y \[mm\]'.*HM-DATA-084", problems(tmp_path / "run.csv")[0])


def test_units_in_brackets_are_those_of_their_signals(tmp_path):
    signals = {"inputs": (Signal("duty", "-"),), "outputs": (Signal("flow", "m^3/s"),)}
    write_csv(tmp_path / "run.csv", {"t": T, "u [%]": GOOD["u"], "y [l/min]": GOOD["y"]})
    (plain,), (whole,) = read(wrote(tmp_path, "plain.csv")).whole, read(tmp_path / "run.csv", **signals).whole
    np.testing.assert_allclose(whole.u, plain.u / 100, atol=1e-12)
    np.testing.assert_allclose(whole.y, plain.y / 6e4, atol=1e-12)
    write_csv(
        tmp_path / "run.csv", {"t": T, "u [1]": GOOD["u"], "y (1)": GOOD["y"]}
    )  # MATLAB's first columns
    np.testing.assert_allclose(read(tmp_path / "run.csv").whole[0].y, plain.y, atol=1e-9)
    write_csv(tmp_path / "run.csv", {"t": T, "u [V]": GOOD["u"], "y [kg]": GOOD["y"]})
    (told,) = problems(tmp_path / "run.csv")
    assert "'y [kg]' is in 'kg'" in told
    factor = replace(SPEC, units={"y": 2.0})
    np.testing.assert_allclose(read(tmp_path / "run.csv", factor).whole[0].y, 2 * plain.y, atol=1e-9)


def test_a_period_far_finer_than_the_sampling_is_refused(tmp_path):
    """Before it takes gigabytes."""
    (told,) = problems(wrote(tmp_path), replace(SPEC, dt=1e-6), states=STATES)
    assert re.search(r"1e-06 s.* 1000 times.* 0\.01 s.*HM-DATA-103", told)
