import sys
from dataclasses import replace
from importlib.util import find_spec

import numpy as np
import pytest
import torch
from simulated_pendulum import DT, TRUTH, Pendulum, record

from hybrid_mpc import InputError, PriorStep, check_parity, free_runs, model_info, trace_model
from scenarios.paper.jobs import figures_of
from scenarios.paper.sindy import Factor, Library, SindyStep, fit_sindy, machine_libraries
from scenarios.pendulum.data import exact_runs
from scenarios.pendulum.plant import DampedPendulum
from scenarios.pendulum.prior import PendulumPrior

needs_pysindy = pytest.mark.skipif(
    find_spec("pysindy") is None, reason="pysindy (extra sindy) is not installed"
)
EMPTY = torch.zeros(0, dtype=torch.float64)
SINE, V, U = (Factor("phi", "sin"),), (Factor("phi_dot"),), (Factor("torque"),)
WARM = 10


def friction(phi, v):
    """Dry friction [N m] that depends on the load, as the golf robot's."""
    return -0.1 * np.tanh(20.0 * v) * abs(np.cos(phi))


@pytest.fixture(scope="module")
def runs():
    rubbed = [record(seed, seconds=3.0, extra=friction) for seed in range(5)]
    return rubbed[:3], rubbed[3:]


@pytest.fixture(scope="module")
def exact():
    return [exact_runs(role, count) for role, count in (("train", 2), ("valid", 1), ("test", 1))]


@needs_pysindy
@pytest.mark.parametrize(
    ("target", "tolerance"),
    [
        pytest.param("mean_rate", 1e-5, marks=pytest.mark.full),
        pytest.param("derivative", 1e-9, marks=pytest.mark.full),
    ],
)
def test_the_pendulums_equation_comes_out_of_exact_runs(exact, target, tolerance):
    plant, (training, validation, test) = DampedPendulum().parameters, exact
    libraries = [
        lib for lib in machine_libraries(PendulumPrior()) if lib.name in ("polynomial", "friction_20")
    ]
    step = fit_sindy(
        training, PendulumPrior(), 0.01, validation=validation, libraries=libraries, target=target
    )
    found = dict(zip(step.library.labels, step.coefficients[:, 0].tolist(), strict=True))
    truth = {"u": 1.0, "phi_dot": -plant.d, "sin(phi)": -plant.gravity}
    truth = {label: value / plant.inertia for label, value in truth.items()}
    assert set(found) == set(truth)  # these terms and no other, out of 12
    # mean rates: Simpson's rule errs by (w dt)^4 / 2880 = 2e-7 and the cubic's middle by as much again, relative to
    # the acceleration; the derivative is exact but for rounding, which the normal equations square
    for label, value in truth.items():
        assert found[label] == pytest.approx(value, rel=tolerance)
    (run,) = free_runs(step, PendulumPrior(), test, 0, EMPTY)
    # it runs along the truth to the step's own error in 10 ms, a few 1e-6 rad at 15 rad/s
    assert np.abs(run.y_hat - run.y).max() < 1e-4


@pytest.mark.full
@needs_pysindy
def test_friction_of_an_unknown_slope_is_found_and_beats_what_lacks_it(runs):
    step = fit_sindy(runs[0], Pendulum(), DT, validation=runs[1], warm=WARM)
    assert step.library.name == "friction_20"
    # no run leaves +-90 degrees, where |cos| is cos: the earlier of the two is kept
    assert step.library.labels == ("sin(phi)", "phi_dot", "torque", "tanh(20 phi_dot) cos(phi)")
    truth = [-TRUTH["mgl"], -TRUTH["d"], 1.0, -0.1]
    # Simpson's rule over a period in which the smooth sign turns: a share of a per cent of the friction
    np.testing.assert_allclose(step.coefficients[:, 0] * TRUTH["J"], truth, atol=1e-3)
    test = [record(9, seconds=3.0, extra=friction)]
    ours, prior = (
        figures_of(free_runs(s, Pendulum(TRUTH), test, WARM, EMPTY))["e_sim_s"]
        for s in (step, PriorStep(Pendulum(TRUTH), DT))
    )
    assert ours < 0.01 * prior  # 0.0005 and 2.0: the prior has no friction


@needs_pysindy
def test_validation_alone_chooses_and_the_fewest_terms_win(runs):
    step = fit_sindy(runs[0], Pendulum(), DT, validation=runs[1], warm=WARM)
    errors = [c.validation for c in step.candidates]
    size = np.mean([np.abs(np.diff(t.x, axis=0)).sum(1).mean() / DT for t in runs[1]])
    equal = [c for c in step.candidates if c.validation <= min(errors) + max(0.02 * min(errors), 1e-3 * size)]
    chosen = min(equal, key=lambda c: c.terms)
    assert (chosen.library, chosen.terms) == (step.library.name, len(step.library.terms))
    names = {c.library for c in step.candidates}
    assert names == {library.name for library in machine_libraries(Pendulum())}
    # what a candidate is said to score is what its step scores
    alone = figures_of(free_runs(step, Pendulum(), runs[1], WARM, EMPTY))["e_sim_s"]
    # without the terms of coefficient 0: another rounding
    assert alone == pytest.approx(chosen.validation, rel=1e-9)


GOOD = Library("good", (SINE, V, U))


@needs_pysindy
def test_candidates_that_diverge_or_are_too_stiff_are_shown_and_not_chosen(runs):
    (polynomial,) = (lib for lib in machine_libraries(Pendulum()) if lib.name == "polynomial")
    sign = Library("sign", (*GOOD.terms, (Factor("phi_dot", "tanh", 1e4),)))
    step = fit_sindy(runs[0], Pendulum(), DT, validation=runs[1], libraries=(polynomial, GOOD, sign))
    assert step.library.name == "good"
    # a cubic in phi_dot without gravity runs away; a sign this steep needs more than 20 sub-steps
    assert {c.library for c in step.candidates if np.isinf(c.validation)} == {"polynomial", "sign"}
    for bad in (polynomial, sign):
        alone = fit_sindy(runs[0], Pendulum(), DT, validation=runs[1], libraries=(bad,), thresholds=(0.0,))
        assert alone.library.name == bad.name
        assert [c.validation for c in alone.candidates] == [np.inf]  # said, not hidden


LAW = Library("law", (SINE, V, U, (Factor("phi_dot", "tanh", 5.0), Factor("phi", "abs_cos")), ()))
VALUES = torch.tensor([[-12.0], [-0.5], [10.0], [-1.0], [0.3]], dtype=torch.float64)


def test_a_step_is_its_equation_for_any_batch():
    step, x, u = (
        SindyStep(Pendulum(), LAW, VALUES, DT),
        torch.rand(2, 3, 2).double(),
        torch.rand(3, 1).double(),
    )
    assert step.text() == (
        "phi_dot' = - 12 sin(phi) - 0.5 phi_dot + 10 torque - 1 tanh(5 phi_dot) |cos(phi)| + 0.3",
    )
    phi, v = x.unbind(-1)
    law = -12 * phi.sin() - 0.5 * v + 10 * u[:, 0] - (5 * v).tanh() * phi.cos().abs() + 0.3
    xdot = step.xdot(x, EMPTY, u, EMPTY)
    torch.testing.assert_close(xdot, torch.stack([v, law], -1), rtol=1e-14, atol=1e-14)  # rounding
    many = SindyStep(Pendulum(), LAW, torch.stack([VALUES, 2 * VALUES, 0 * VALUES]), DT, 1)
    for i, factor in enumerate((1.0, 2.0, 0.0)):  # a model for each row of the batch
        torch.testing.assert_close(
            many.xdot(x, EMPTY, u, EMPTY)[:, i, 1], factor * law[:, i], rtol=1e-14, atol=1e-14
        )


@pytest.mark.full
def test_it_exports_at_rounding():
    step = SindyStep(Pendulum(), LAW, VALUES, DT)
    parity = check_parity(
        step, trace_model(step), model_info(step.prior, DT), [record(0, seconds=1.0)], seed=0
    )
    assert parity.max_abs_error < 1e-12
    assert parity.jacobian_max_abs_error < 1e-12


def test_without_pysindy_the_remedy_is_told(runs, monkeypatch):
    monkeypatch.setitem(sys.modules, "pysindy", None)
    with pytest.raises(InputError, match="HM-SCENARIOS-041"):
        fit_sindy(runs[0], Pendulum(), DT, validation=runs[1])


def bad_runs(runs, change):
    return [runs[0][0], replace(runs[0][1], **change(runs[0][1]))], runs[1]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t: {"u": np.hstack([t.u, t.u])}, r"run1.*Pendulum.*HM-SCENARIOS-038"),
        (lambda t: {"x": t.x[:, :1]}, r"run1.*HM-SCENARIOS-038"),
        (lambda t: {"dt": 0.01}, "resample"),
        (lambda t: {"x": np.where(t.t[:, None] == t.t[40], np.nan, t.x)}, r"run1.*0\.8.*HM-IDENTIFY-006"),
    ],
)
@needs_pysindy
def test_runs_that_do_not_fit_are_refused_by_name(runs, change, words):
    training, validation = bad_runs(runs, change)
    with pytest.raises(InputError, match=words):
        fit_sindy(training, Pendulum(), DT, validation=validation)


@needs_pysindy
def test_other_bad_input_is_refused_with_the_remedy(runs):
    training, validation = runs
    still = [replace(t, u=np.full_like(t.u, 0.2)) for t in training]
    short = [replace(t, **{k: getattr(t, k)[:1] for k in ("t", "u", "y", "x", "xdot")}) for t in training[:1]]
    short[0] = replace(short[0], u=training[0].u[:1])
    nowhere = Library("nowhere", ((Factor("psi"),),))
    derivative = [replace(t, xdot=t.xdot * np.nan) for t in training]
    for runs_given, options, words in (
        (still, {}, "HM-SCENARIOS-040"),
        ([], {}, "HM-SCENARIOS-037"),
        (training, {"thresholds": ()}, "HM-SCENARIOS-036"),
        (training, {"thresholds": (-1.0,)}, "HM-SCENARIOS-036"),
        (training, {"target": "rate"}, r"mean_rate, derivative.*HM-SCENARIOS-035"),
        (training, {"libraries": (nowhere,)}, r"Pendulum.*phi, phi_dot, torque.*HM-SCENARIOS-034"),
        (training, {"libraries": (Library("empty", ()),)}, "HM-SCENARIOS-034"),
        (derivative, {"target": "derivative"}, r"xdot.*HM-IDENTIFY-006"),
    ):
        with pytest.raises(InputError, match=words):
            fit_sindy(runs_given, Pendulum(), DT, validation=validation, **options)
    with pytest.raises(InputError, match="HM-SCENARIOS-040"):
        fit_sindy(short, Pendulum(), DT, validation=validation)
    for wrong in ({"function": "exp"}, {"power": 0}):
        with pytest.raises(InputError):
            Factor("phi", **wrong)
    with pytest.raises(InputError, match=r"\(5, 1\).*HM-SCENARIOS-032"):
        SindyStep(Pendulum(), LAW, VALUES.T, DT)
