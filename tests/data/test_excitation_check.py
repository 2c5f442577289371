import numpy as np
import pytest

from hybrid_mpc import InputError, Signal, Trajectory, check_excitation, excitation_of, multisine, prbs

DT = 0.02
INPUT, OUTPUT = (Signal("torque", "N m", -0.5, 0.5),), (Signal("phi", "rad", -3, 3),)


def run(u, y=None, name="run"):
    u = np.asarray(u, dtype=float).reshape(len(u), -1)
    t = DT * np.arange(len(u))
    y = np.sin(t)[:, None] if y is None else y
    return Trajectory(name, "train", DT, t, u, y, np.hstack([y, y]), np.hstack([y, y]))


def sine(f, seconds=20.0, amplitude=0.1):
    return amplitude * np.sin(2 * np.pi * f * DT * np.arange(round(seconds / DT)) + 1.0)


@pytest.mark.parametrize("f", [0.5, 0.52, 0.525, 1.3])
def test_a_sine_is_one_line_wherever_it_lies_between_bins(f):
    (found,) = excitation_of([run(0.3 + sine(f))], INPUT)
    assert found.name == "torque"
    assert found.spread == pytest.approx(
        0.1 / np.sqrt(2), rel=0.02
    )  # of whole periods; others differ a little
    assert len(found.lines) == 1
    assert found.lines[0] == pytest.approx(f, abs=0.025 + 1e-9)  # half a bin of 20 s


def test_lines_of_one_and_of_several_runs_are_counted_once():
    together = run(sine(0.5) + sine(1.0) + 0.5 * sine(2.0))
    assert len(excitation_of([together])[0].lines) == 3
    apart = [run(sine(f, seconds), name=str(f)) for f, seconds in ((0.5, 20.0), (1.0, 30.0), (0.5, 40.0))]
    np.testing.assert_allclose(excitation_of(apart)[0].lines, [0.5, 1.0], atol=0.01)
    weak = run(sine(0.5) + 0.05 * sine(2.0))  # below a tenth: not counted
    assert len(excitation_of([weak])[0].lines) == 1


def test_broad_signals_have_many_lines():
    t = DT * np.arange(2000)
    for u in (
        multisine(t, 0.1, 0.1, 3.0),
        prbs(t, -0.1, 0.1, clock=0.2),
        0.1 * np.random.default_rng(0).standard_normal(2000),
    ):
        assert len(excitation_of([run(u)])[0].lines) >= 10
    assert check_excitation([run(multisine(t, 0.1, 0.1, 3.0))], parameters=12) == ()


def test_a_constant_input_is_refused_unless_another_run_moves_it():
    still = run(np.full(500, 0.2), name="monday#2")
    with pytest.raises(InputError, match=r"monday: the input torque is 0.2 throughout"):
        check_excitation([still], inputs=INPUT, outputs=OUTPUT)
    tiny = run(1e-9 * np.random.default_rng(0).standard_normal(500))
    with pytest.raises(InputError, match="the input torque"):  # rounding is no excitation
        check_excitation([tiny], inputs=INPUT)
    with pytest.raises(InputError, match="input 2 is 0 throughout"):
        check_excitation([run(np.c_[sine(0.5), 0 * sine(0.5)])])
    assert check_excitation([still, run(sine(0.5))], inputs=INPUT, outputs=OUTPUT) == ()
    two_levels = [still, run(np.full(500, -0.2), name="tuesday")]
    assert check_excitation(two_levels, inputs=INPUT) == ()  # each constant, but not the same
    assert excitation_of(two_levels)[0].lines == ()


def test_a_machine_that_never_moves_is_refused():
    stuck = run(sine(0.5), np.full((1000, 1), 0.7))
    with pytest.raises(InputError, match=r"run: the output phi is 0.7 throughout: the machine never moved"):
        check_excitation([stuck], inputs=INPUT, outputs=OUTPUT)


def test_too_few_lines_are_a_warning_by_name():
    u = sine(0.5) + sine(1.5)
    assert check_excitation([run(u)], inputs=INPUT, parameters=4) == ()
    (warning,) = check_excitation([run(u)], inputs=INPUT, parameters=5)
    assert "torque has 2 lines (0.5, 1.5 Hz), 5 parameters of a linear model need 3" in warning
    (warning,) = check_excitation([run(np.r_[np.zeros(3), 1.0])], inputs=INPUT, parameters=1)
    assert "no line" in warning  # four samples tell no frequency


def test_nothing_to_check_is_refused():
    with pytest.raises(InputError, match="no trajectories"):
        check_excitation([])
