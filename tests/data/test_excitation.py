"""Signals have the spectra that they promise, and recordings that excite too little are noticed."""

import numpy as np
import pytest

from hybrid_mpc import (
    InputError,
    Signal,
    Trajectory,
    check_excitation,
    chirp,
    excitation_of,
    multisine,
    prbs,
    random_steps,
)

DT = 0.02
INPUT, OUTPUT = (Signal("torque", "N m", -0.5, 0.5),), (Signal("phi", "rad", -3, 3),)


def crest_factor(u):
    return np.abs(u - u.mean()).max() / u.std()


def line_spectrum(u, dt):
    """Frequencies [Hz] and amplitudes of the sines of which a whole number of periods fits the record."""
    size = np.abs(np.fft.rfft(u)) / len(u)
    size[1 : (len(u) + 1) // 2] *= 2
    return np.fft.rfftfreq(len(u), dt), size


def test_steps_keep_bounds_and_hold_times_and_repeat_with_the_seed():
    t = np.arange(0, 50, 0.01)
    u = random_steps(t, -0.4, 0.9, hold=(0.5, 1.5), rng=np.random.default_rng(3))
    assert u.min() >= -0.4
    assert u.max() <= 0.9
    switch = t[1:][np.diff(u) != 0]
    assert np.diff(switch).min() >= 0.5 - 0.011  # one grid step of rounding
    assert np.diff(switch).max() <= 1.5 + 0.011
    again = random_steps(t, -0.4, 0.9, hold=(0.5, 1.5), rng=np.random.default_rng(3))
    np.testing.assert_array_equal(u, again)


def test_multisine_has_its_lines_all_of_one_size_and_nothing_else():
    t = 3.0 + 0.01 * np.arange(2000)  # 20 s: lines 0.05 Hz apart; the start of time does not matter
    u = multisine(t, 0.5, 0.2, 3.0, offset=0.1)
    f, amplitude = line_spectrum(u - 0.1, 0.01)
    inside = (f > 0.199) & (f < 3.001)
    assert inside.sum() == 57
    np.testing.assert_allclose(amplitude[inside], amplitude[inside][0], rtol=1e-9)
    assert amplitude[~inside].max() < 1e-12
    assert np.abs(u - 0.1).max() == pytest.approx(0.5, rel=1e-12)
    np.testing.assert_allclose(multisine(t - 3.0, 0.5, 0.2, 3.0, offset=0.1), u, atol=1e-12)


def test_multisine_repeats_and_may_leave_out_even_lines():
    t = 0.01 * np.arange(2000)
    u = multisine(t, 1.0, 0.1, 2.0, period=5.0, odd=True)
    np.testing.assert_allclose(u[500:], u[:-500], atol=1e-12)
    _, amplitude = line_spectrum(u[:500], 0.01)
    assert np.flatnonzero(amplitude > 1e-9).tolist() == [1, 3, 5, 7, 9]
    np.testing.assert_allclose(u[250:500], -u[:250], atol=1e-12)  # half a period later the opposite


@pytest.mark.parametrize("bits", [3, 5, 7, 10])
def test_prbs_has_the_levels_mean_and_lines_of_theory(bits):
    n, per, dt = 2**bits - 1, 8, 0.05
    t = 2.0 + dt * np.arange(per * n)
    u = prbs(t, -0.2, 0.6, clock=per * dt, bits=bits)
    assert set(u.tolist()) == {-0.2, 0.6}
    assert u.mean() == pytest.approx(0.2 + 0.4 / n, abs=1e-12)
    f, amplitude = line_spectrum(u, dt)
    k = np.arange(1, 2 * n)  # up to twice the clock's frequency
    # held over 8 samples: the sinc of continuous time becomes a ratio of sines
    hold = np.abs(np.sin(np.pi * k / n) / (per * np.sin(np.pi * k / (n * per))))
    np.testing.assert_allclose(amplitude[k], 2 * 0.4 * np.sqrt(n + 1) / n * hold, atol=1e-12)
    assert f[1] == pytest.approx(1 / (n * per * dt))
    half = np.interp(0.44 / (per * dt), f[k], hold)
    # between two lines; n of them to the clock's frequency
    assert half == pytest.approx(np.sqrt(0.5), abs=0.02)
    assert crest_factor(u) < 1 + 1.5 / n  # two levels, the mean a little off their middle


def test_prbs_holds_for_a_clock_and_repeats_only_after_its_length():
    t = 0.01 * np.arange(6000)
    u = prbs(t, 0.0, 1.0, clock=0.1)
    ticks = u.reshape(600, 10)
    assert (ticks == ticks[:, :1]).all()
    word = ticks[:, 0]
    # no run of 10 ticks (the register's length for 600) comes twice
    assert len({tuple(word[i : i + 10]) for i in range(591)}) == 591
    np.testing.assert_array_equal(prbs(t, 0.0, 1.0, clock=0.1, bits=10, shift=7)[:5930], u[70:])
    again = prbs(t, 0.0, 1.0, clock=0.1, bits=5)
    np.testing.assert_array_equal(again[310:], again[:-310])
    one, two = (prbs(t[:5115], -1.0, 1.0, clock=0.05, bits=10, shift=s) for s in (0, 400))
    assert abs(np.mean(one * two)) < 2 / 1023  # shifted ones are uncorrelated but for 1/N


def test_chirp_is_flat_between_its_frequencies():
    t = 0.005 * np.arange(16000)
    u = chirp(t, 0.8, 0.5, 4.5)
    f, amplitude = line_spectrum(u, 0.005)
    flat = 0.8 / np.sqrt(80 * 4.0)
    middle = amplitude[(f > 1.0) & (f < 4.0)]
    assert np.median(middle) == pytest.approx(flat, rel=0.05)  # Fresnel ripples die away from the ends
    assert (amplitude[(f < 0.3) | (f > 5.0)] < 0.2 * flat).all()
    assert crest_factor(u) == pytest.approx(np.sqrt(2), abs=0.02)
    crossings = t[1:][np.diff(np.sign(u)) != 0]
    # half a period, one sample
    assert crossings[-1] - crossings[-2] == pytest.approx(1 / (2 * 4.5), abs=0.005)


def test_what_cannot_be_made_is_refused():
    t = 0.01 * np.arange(1000)
    for make, match in (
        (lambda: multisine(t, 1.0, 0.2, 60.0), "HM-DATA-015"),
        (lambda: multisine(t, 1.0, 0.21, 0.29), r"0\.21.*0\.29.*0\.1.*HM-DATA-016"),
        (lambda: multisine(t, 1.0, 0.2, 0.2, odd=True), "HM-DATA-016"),
        (lambda: multisine(t[:1], 1.0, 0.2, 3.0), "more than one instant"),
        (lambda: chirp(t[:1], 1.0, 0.2, 3.0), "more than one instant"),
        (lambda: prbs(t, 1.0, 0.0, clock=0.1), "HM-DATA-017"),
        (lambda: prbs(t, 0.0, 1.0, clock=0.001), r"0\.01.*HM-DATA-017"),
        (lambda: prbs(t, 0.0, 1.0, clock=0.1, bits=40), r"40.*HM-DATA-018"),
        (lambda: random_steps(t, 0, 1, hold=(0.0, 1.0), rng=np.random.default_rng(0)), "hold"),
        (lambda: check_excitation([]), "HM-DATA-020"),
    ):
        with pytest.raises(InputError, match=match):
            make()


def run(u, y=None, name="run"):
    u = np.asarray(u, dtype=float).reshape(len(u), -1)
    t = DT * np.arange(len(u))
    y = np.sin(t)[:, None] if y is None else y
    return Trajectory(name, "train", DT, t, u, y, np.hstack([y, y]), np.hstack([y, y]))


def sine(f, seconds=20.0, amplitude=0.1):
    return amplitude * np.sin(2 * np.pi * f * DT * np.arange(round(seconds / DT)) + 1.0)


def test_lines_of_one_and_of_several_runs_are_counted_once():
    together = run(sine(0.5) + sine(1.0) + 0.5 * sine(2.0))
    assert len(excitation_of([together])[0].lines) == 3
    apart = [run(sine(f, seconds), name=str(f)) for f, seconds in ((0.5, 20.0), (1.0, 30.0), (0.5, 40.0))]
    np.testing.assert_allclose(excitation_of(apart)[0].lines, [0.5, 1.0], atol=0.01)
    weak = run(sine(0.5) + 0.05 * sine(2.0))  # below a tenth: not counted
    assert len(excitation_of([weak])[0].lines) == 1


def test_a_constant_input_is_refused_unless_another_run_moves_it():
    still = run(np.full(500, 0.2), name="monday#2")
    with pytest.raises(InputError, match=r"monday.*torque.*0\.2.*HM-DATA-021"):
        check_excitation([still], inputs=INPUT, outputs=OUTPUT)
    rounded = run(0.3 + 1e-15 * np.random.default_rng(0).standard_normal(500))
    with pytest.raises(InputError, match=r"torque.*HM-DATA-021"):  # rounding is no excitation
        check_excitation([rounded], inputs=INPUT)
    for level, size in ((0.0, 1e-9), (1e6, 1.0), (1e6, 1e-3)):  # beside any level, in any unit
        check_excitation([run(level + size * sine(0.5), level + size * np.c_[sine(0.5)])])
    with pytest.raises(InputError, match=r"input 2.*HM-DATA-021"):
        check_excitation([run(np.c_[sine(0.5), 0 * sine(0.5)])])
    assert check_excitation([still, run(sine(0.5))], inputs=INPUT, outputs=OUTPUT) == ()
    two_levels = [still, run(np.full(500, -0.2), name="tuesday")]
    assert check_excitation(two_levels, inputs=INPUT) == ()  # each constant, but not the same
    assert excitation_of(two_levels)[0].lines == ()
    stuck = run(sine(0.5), np.full((1000, 1), 0.7))
    with pytest.raises(InputError, match=r"run.*phi.*0\.7.*HM-DATA-022"):
        check_excitation([stuck], inputs=INPUT, outputs=OUTPUT)


def test_too_few_lines_are_a_warning_by_name():
    u = sine(0.5) + sine(1.5)
    assert check_excitation([run(u)], inputs=INPUT, parameters=4) == ()
    (warning,) = check_excitation([run(u)], inputs=INPUT, parameters=5)
    assert "torque excites 2 frequencies (0.5, 1.5 Hz); 5 parameters of a linear model need 3" in warning
    (warning,) = check_excitation([run(np.r_[np.zeros(3), 1.0])], inputs=INPUT, parameters=1)
    assert "no frequency" in warning  # four samples tell no frequency
