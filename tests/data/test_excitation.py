import numpy as np
import pytest

from hybrid_mpc import InputError, chirp, multisine, prbs, random_steps, sinusoid
from hybrid_mpc.data.excitation import crest_factor, hann_spectrum, line_spectrum


def test_chirp_has_the_stated_frequencies_at_its_ends():
    t = np.linspace(0, 20, 20001)
    crossings = t[1:][np.diff(np.sign(chirp(t, 1.0, 0.5, 2.0))) != 0]
    # half periods: 1/(2 f) up to the change of f within one half period (7.5 % at 0.5 Hz)
    assert crossings[1] - crossings[0] == pytest.approx(1.0, rel=0.15)
    assert crossings[-1] - crossings[-2] == pytest.approx(0.25, rel=0.02)


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


def test_bounds_are_refused_not_clipped():
    t = np.linspace(0, 1, 11)
    with pytest.raises(InputError, match="Lower the amplitude"):
        sinusoid(t, 1.0, 1.0, offset=0.2, upper=1.0)
    with pytest.raises(InputError, match="hold"):
        random_steps(t, 0, 1, hold=(0.0, 1.0), rng=np.random.default_rng(0))


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
    np.testing.assert_allclose(
        u[250:500], -u[:250], atol=1e-12
    )  # odd lines: half a period later the opposite


@pytest.mark.parametrize("first", [1, 20])
@pytest.mark.parametrize("count", [10, 20, 57, 200])
def test_schroeder_phases_keep_the_crest_factor_low(count, first):
    t = 0.005 * np.arange(4000)
    u = multisine(t, 1.0, first / 20, (first + count - 1) / 20)
    assert 1.6 < crest_factor(u) < 2.0
    rng, line = np.random.default_rng(count), 2 * np.pi * np.arange(first, first + count)[:, None] / 20
    random = [np.cos(line * t + rng.uniform(0, 2 * np.pi, (count, 1))).sum(axis=0) for _ in range(15)]
    assert np.median([crest_factor(v) for v in random]) > 2.3


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
    assert half == pytest.approx(
        np.sqrt(0.5), abs=0.02
    )  # between two lines, which are n to the clock's frequency
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
    f, amplitude = line_spectrum(chirp(t, 0.8, 0.5, 4.5), 0.005)
    band = (f > 1.0) & (f < 4.0)
    flat = 0.8 / np.sqrt(80 * 4.0)
    assert np.median(amplitude[band]) == pytest.approx(
        flat, rel=0.05
    )  # Fresnel ripples die away from the ends
    assert (amplitude[(f < 0.3) | (f > 5.0)] < 0.2 * flat).all()
    assert crest_factor(chirp(t, 0.8, 0.5, 4.5)) == pytest.approx(np.sqrt(2), abs=0.02)


def test_steps_have_their_power_at_low_frequencies():
    t = 0.01 * np.arange(100_000)
    f, amplitude = line_spectrum(
        random_steps(t, -1.0, 1.0, hold=(0.5, 1.5), rng=np.random.default_rng(5)), 0.01
    )
    power = amplitude[1:] ** 2
    low = f[1:] < 0.44
    assert 0.6 < power[low].sum() / power.sum() < 0.85  # 0.72 for equal holds
    decade = [power[(f[1:] > a) & (f[1:] < 1.5 * a)].mean() for a in (2.0, 8.0)]
    assert decade[0] / decade[1] == pytest.approx(16, rel=0.3)  # amplitude ~ 1/f; 1000 lines scatter by 3 %


def test_hann_spectrum_shows_a_sine_of_any_frequency():
    t = 0.01 * np.arange(1000)
    for f0 in (2.0, 2.03, 2.05):
        f, amplitude = hann_spectrum(5.0 + 0.7 * np.sin(2 * np.pi * f0 * t), 0.01)
        k = int(np.argmax(amplitude))
        assert abs(f[k] - f0) <= 0.05 + 1e-9
        assert 0.84 * 0.7 < amplitude[k] < 1.001 * 0.7
        assert np.delete(amplitude, range(k - 2, k + 3)).max() < 0.03 * 0.7


def test_what_cannot_be_made_is_refused():
    t = 0.01 * np.arange(1000)
    for make, match in (
        (lambda: multisine(t, 1.0, 0.2, 3.0, upper=0.9), "Lower the amplitude"),
        (lambda: multisine(t, 1.0, 0.2, 60.0), "half the sampling"),
        (lambda: multisine(t, 1.0, 0.21, 0.29), "no line between 0.21 and 0.29 Hz; they are 0.1 Hz apart"),
        (lambda: multisine(t, 1.0, 0.2, 0.2, odd=True), "odd multiples only"),
        (lambda: multisine(t[:1], 1.0, 0.2, 3.0), "more than one instant"),
        (lambda: prbs(t, 1.0, 0.0, clock=0.1), "lower < upper"),
        (lambda: prbs(t, 0.0, 1.0, clock=0.001), "at least the sampling time 0.01 s"),
        (lambda: prbs(t, 0.0, 1.0, clock=0.1, bits=40), "2 to 32 bits, got 40"),
        (lambda: crest_factor(np.ones(5)), "constant"),
    ):
        with pytest.raises(InputError, match=match):
            make()
