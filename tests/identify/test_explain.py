"""The search for missing terms: a term that was taken out is found, and none is added where none is missing."""

import json
import pickle
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest

from hybrid_mpc import (
    InputError,
    MechanicalPrior,
    OperatingPoint,
    Parameter,
    Prior,
    Signal,
    Trajectory,
    fit_prior,
)
from hybrid_mpc.cli.explain import summary
from hybrid_mpc.identify import term_table
from hybrid_mpc.identify.evidence import HeldOut
from hybrid_mpc.identify.explain import _Explain, explain
from hybrid_mpc.identify.explanation import Evidence, Explanation, HeldOutError, Trial
from hybrid_mpc.identify.fit import smoothed
from hybrid_mpc.identify.simulation import Simulation, visited
from hybrid_mpc.identify.term_fits import FittedCandidate, Present, TermFits
from hybrid_mpc.identify.term_library import Candidate, library
from hybrid_mpc.machine import terms
from hybrid_mpc.machine.terms import At, Term, extended
from hybrid_mpc.records import plain, record
from hybrid_mpc.workflow.explain_page import FEW, steps_table
from hybrid_mpc.workflow.explained import ExplainResult

DT = 0.02


class Pendulum(MechanicalPrior):
    states = (Signal("phi", "rad", -10.0, 10.0, periodic=True), Signal("phi_dot", "rad/s", -40.0, 40.0))
    inputs = (Signal("torque", "N m", -3.0, 3.0),)
    outputs = states[:1]
    parameters = (
        Parameter("J", 0.12, "kg m^2", 0.05, 0.3),
        Parameter("mgl", 1.8, "N m", 0.5, 4.0),
        Parameter("d", 0.03, "N m s/rad", 0.0, 0.5),
    )
    operating_point = OperatingPoint((0.0, 0.0), (0.0,))

    def mass_matrix(self, q, p):
        return p.J

    def potential(self, q, p):
        return -p.mgl * ca.cos(q.phi)

    def friction(self, q, v, p):
        return p.d * v.phi_dot


def recorded(prior, count=6, seconds=8.0, seed=0):
    """Runs of a plant from rest under torques that change every 0.3 s, each of its own size."""
    rng, simulation, runs = np.random.default_rng(seed), Simulation(prior.equations.xdot, DT), []
    n = round(seconds / DT)
    for k in range(count):
        torque = np.repeat(rng.uniform(-1, 1, n // 15 + 1), 15)[:n, None] * (0.6 + 0.25 * k)
        states = simulation.values(np.zeros((1, 2)), torque[None], np.zeros((1, n, 0)), prior.p, 10)[0]
        y = states[:, :1] + 1e-3 * rng.standard_normal((n, 1))
        nothing = np.full((n, 2), np.nan)
        runs.append(Trajectory(f"run{k}", "train", DT, DT * np.arange(n), torque, y, nothing, nothing))
    return runs


class PointMass(Pendulum):
    """A pendulum as a point mass: its weight gives its inertia."""

    parameters = (
        Parameter("m", 0.6, "kg", 0.1, 2.0),
        Parameter("l", 0.3, "m", 0.3, 0.3),
        Parameter("d", 0.03, "N m s/rad", 0.0, 0.5),
    )

    def mass_matrix(self, q, p):
        return p.m * p.l**2

    def potential(self, q, p):
        return -9.81 * p.m * p.l * ca.cos(q.phi)


def searched(plant, base=Pendulum):
    runs = recorded(plant)
    fit = fit_prior(base, runs, [], dt=DT, length=2.0)
    return explain(base, fit.values, smoothed(base, fit, runs, DT), dt=DT, length=2.0)


def test_dry_friction_that_is_missing_is_found():
    level = Parameter("F", 0.15, "N m", 0.0, 1.0)
    found = searched(extended(Pendulum, terms.coulomb("phi_dot", level, width=0.05))())
    first = found.steps[0]
    assert first.name == "Coulomb friction of phi_dot"
    assert first.held_out.ratio < 0.3
    assert first.held_out.lower < first.held_out.ratio < first.held_out.upper < 1.0
    assert first.held_out.harm < 0.01
    assert found.values["F_c_phi_dot"] == pytest.approx(0.15, rel=0.1)
    assert found.values["mgl"] == pytest.approx(1.8, rel=0.02)
    (friction,) = first.parameters
    assert abs(friction.value - 0.15) < 4 * friction.standard_error
    assert all(trial.outcome != "added" for trial in first.alternatives)
    (picture,) = first.pictures
    assert (picture.abscissa, picture.ordinate) == ("phi_dot [rad/s]", "Coulomb friction of phi_dot [N m]")
    at, drawn, asked = (np.array(column) for column in (picture.at, picture.term, picture.data))
    assert (np.diff(at) >= 0).all()
    fast = np.abs(at) > 1.0
    np.testing.assert_allclose(drawn[fast], -friction.value * np.sign(at[fast]), atol=1e-3)
    assert np.abs(asked - drawn)[fast].mean() < 0.1
    again = record(Explanation, json.loads(json.dumps(plain(found))), "explanation")
    assert again == found
    made = again.prior(Pendulum)(again.values)
    x, u = [0.4, 2.0], [0.7]
    wanted = extended(Pendulum, *found.terms())(found.values).equations.xdot(x, u, [], made.p)
    np.testing.assert_array_equal(made.equations.xdot(x, u, [], made.p).full(), wanted.full())


def test_a_missing_inertia_of_a_single_axis_is_named_beside_a_weight_that_explains_as_much():
    """With another mass, ``m l^2 phi'' = u - (m l - G) sin phi`` is the same motion."""
    rotor = terms.inertia("phi_dot", Parameter("J", 0.02, "kg m^2", 0.0, 1.0))
    (step,) = searched(extended(PointMass, rotor)(), PointMass).steps
    assert step.held_out.ratio < 0.5
    named = {step.name, *(trial.terms[0].name for trial in step.alternatives)}
    assert {"gravity error of phi_dot", "inertia of phi_dot"} <= named


def test_no_term_is_added_where_none_is_missing():
    found = searched(Pendulum({"J": 0.14, "mgl": 2.1}))
    assert found.steps == ()
    assert found.prior(Pendulum) is Pendulum
    assert found.reason
    assert found.after.ratio == 1.0


def test_every_term_of_the_library_vanishes_where_the_search_begins():
    prior = Pendulum()
    runs = smoothed(
        Pendulum, fit_prior(Pendulum, recorded(prior, 2), [], dt=DT, length=1.0), recorded(prior, 2), DT
    )
    every = [
        form for one in library(prior, visited(runs), DT, 2.0) for form in one.forms if form.state is None
    ]
    made = extended(Pendulum, *every)()
    x, u = [0.4, 1.3], [0.7]
    np.testing.assert_allclose(
        made.equations.xdot(x, u, [], made.p).full(),
        prior.equations.xdot(x, u, [], prior.p).full(),
        rtol=1e-12,
    )
    assert len(every) > 20


def slopes_of(term, values, grid):
    """Slopes of a map of an input or sensor along a grid."""
    own = ca.SX.sym("own")
    nothing = dict.fromkeys(At._fields)
    value = term.law(At(**{**nothing, "own": own}), ca.DM(values))
    return ca.Function("slope", [own], [ca.gradient(value, own)]).map(len(grid))(grid).full().ravel()


def test_no_map_of_an_input_or_sensor_reverses_within_its_bounds():
    """Also where the recordings cover a small part of the signal's range, and without a range."""
    rng = np.random.default_rng(0)
    x, u = rng.uniform(-0.3, 0.3, (200, 2)), rng.standard_normal((200, 1)) * 0.4

    class Unbounded(Pendulum):
        inputs = (Signal("torque", "N m"),)
        outputs = (Signal("phi", "rad"),)

    laws = set()
    for prior, (low, high) in ((Pendulum(), (-10.0, 10.0)), (Unbounded(), (-0.4, 0.4))):
        for candidate in library(prior, (x, u, np.zeros((200, 0))), DT, 2.0):
            for form in candidate.forms:
                if form.place in ("input", "output") and form.state is None:
                    grid = (
                        np.linspace(-3.0, 3.0, 601) if form.place == "input" else np.linspace(low, high, 601)
                    )
                    if form.place == "input" and prior.inputs[0].upper == np.inf:
                        grid = np.linspace(1.5 * u.min(), 1.5 * u.max(), 601)
                    (one,) = form.parameters
                    for value in np.linspace(one.lower, one.upper, 21):
                        assert slopes_of(form, [value], grid).min() > 0.0, (form.name, value)
                    laws.add(form.made.maker)
    assert laws == {
        "input_gain", "input_offset", "gain_by_direction", "dead_zone", "saturation", "input_curve",
        "output_gain", "output_offset", "output_curve",
    }  # fmt: skip


def own(law, unit="N m", upper=1.0, name="own", **more):
    return Term(name, "force", "phi_dot", (Parameter("k_own", 0.0, unit, 0.0, upper),), law, **more)


def begun(*terms, runs, candidates=(), **more):
    known = smoothed(Pendulum, fit_prior(Pendulum, runs, [], dt=DT, length=1.0), runs, DT)
    return explain(
        Pendulum, Pendulum().values, known, dt=DT, length=1.0, candidates=candidates, own=terms, **more
    )


@pytest.mark.parametrize(
    ("given", "seconds", "code"),
    [
        ([own(lambda at, p: -p.k_own * at.own)], 3.0, "MACHINE-042"),  # units
        (2 * [own(lambda at, p: -p.k_own)], 3.0, "IDENTIFY-013"),  # one name
        (
            [own(lambda at, p: p.k_own * ca.tanh(at.own), loss=True)],
            3.0,
            "IDENTIFY-074",
        ),  # a loss that supplies
        (
            [replace(own(lambda at, p: p.k_own * ca.tanh(at.own / 0.3)), place="potential")],
            3.0,
            "MACHINE-043",
        ),
        ([], 0.5, "IDENTIFY-012"),  # too little evidence
    ],
)
def test_what_cannot_be_searched_is_refused(given, seconds, code):
    with pytest.raises(InputError, match=code):
        begun(*given, runs=recorded(Pendulum(), 4 if given else 1, seconds))


def test_a_candidate_whose_fit_diverges_is_reported_and_the_search_goes_on():
    level = Parameter("F", 0.15, "N m", 0.0, 1.0)
    runs = recorded(extended(Pendulum, terms.coulomb("phi_dot", level, width=0.05))(), 4, 4.0)
    wild = own(lambda at, p: -p.k_own * ca.tanh(at.own / 1e-6), name="wild")  # too stiff to be integrated
    found = begun(
        wild,
        Term(
            "dry", "force", "phi_dot", (Parameter("k_dry", 0.0, "N m", 0.0, 1.0),),
            lambda at, p: -p.k_dry * ca.tanh(at.own / 0.05), loss=True,
        ),
        runs=runs,
    )  # fmt: skip
    assert [term.name for term in found.found] == ["dry"]
    assert [trial.name for trial in found.diverged] == ["wild"]


@pytest.mark.parametrize("failure", [InputError("too stiff"), np.linalg.LinAlgError("singular")])
def test_a_pair_is_needed_where_the_model_without_a_term_cannot_be_simulated(failure):
    def fail(evidence, terms, theta):
        raise failure

    search = SimpleNamespace(without=lambda terms, theta, form: (terms, theta), held_out=fail)
    own = SimpleNamespace(search=search, now=SimpleNamespace(terms=()), evidence=None)
    pair = SimpleNamespace(sure=True, forms=("one", "other"), theta=np.zeros(2))
    assert _Explain._as_needed(own, pair) is pair


def test_of_a_pair_with_a_needless_term_the_other_one_is_tried_alone():
    """One step: the pair passes, but without its first term the error is the same."""
    needless = terms.input_gain("torque", Parameter("g", 0.0, "-", -0.5, 0.5))
    needed = terms.coulomb("phi_dot", Parameter("F", 0.0, "N m", 0.0, 1.0), width=0.05)
    error = HeldOutError(0.1, 0.7, 0.6, 0.8, 0.0)
    pair = FittedCandidate((needless, needed), error, np.zeros(2), np.array([0.7]), sure=True)
    alone = FittedCandidate((needed,), error, np.zeros(1), np.array([0.7]), sure=True)
    ranked = SimpleNamespace(best=lambda count, beyond=None: [] if beyond is None else [pair.forms])
    search = SimpleNamespace(
        without=lambda terms, theta, form: (form, theta),
        held_out=lambda by, kept, theta: np.array([0.7 if kept is needless else 1.0]),
    )
    own = SimpleNamespace(
        steps=[], pool=[], search=search, now=SimpleNamespace(terms=()),
        evidence=SimpleNamespace(compared=lambda a, b, n: replace(error, ratio=float(a[0] / b[0]))),
        _scored=lambda number: (SimpleNamespace(best=lambda count: []), lambda: ranked, []),
        _fitted=lambda some, text: [pair if len(forms) == 2 else alone for forms in some],
        _trial=lambda one, chosen: one,
    )  # fmt: skip
    own._as_needed = lambda one: _Explain._as_needed(own, one)
    own._chosen = lambda fitted: next((one for one in fitted if one.sure), None)
    trials, _, chosen = _Explain._step(own)
    assert chosen is alone
    assert [one.reason for one in trials] == ["gain of torque is not needed", ""]
    told = _Explain._trial(own, trials[0], alone)
    assert (told.outcome, told.reason) == ("worse", "gain of torque is not needed")


def test_no_law_acts_on_the_state_of_a_term_that_is_there():
    lag = terms.input_lag(
        "torque", Parameter("t", 0.1, "s", 0.01, 1.0), state=Signal("late", "N m", -9.0, 9.0)
    )
    lagged, rng = extended(Pendulum, lag), np.random.default_rng(0)
    points = rng.standard_normal((50, 3)), rng.standard_normal((50, 1)), np.zeros((50, 0))
    forms = [form for one in library(lagged(), points, 0.02, 4.0) for form in one.forms]
    assert not {form.of for form in forms} & {"late"}
    for form in forms:
        assert len(extended(lagged, form).parameters) > len(lagged.parameters)


def test_an_own_term_may_have_parameters_that_are_not_zero():
    level = Parameter("F", 0.15, "N m", 0.0, 1.0)
    runs = recorded(extended(Pendulum, terms.coulomb("phi_dot", level, width=0.05))(), 4, 4.0)
    steep = Parameter("gamma", 10.0, "s/rad", 5.0, 40.0)
    own_level = Parameter("F_own", 0.1, "N m", 0.0, 1.0)
    dry = Term(
        "dry", "force", "phi_dot", (own_level, steep), lambda at, p: -p.F_own * ca.tanh(p.gamma * at.own), loss=True,
    )  # fmt: skip
    found = begun(dry, runs=runs)
    assert found.values["F_own"] == pytest.approx(0.15, rel=0.1)
    assert found.prior(Pendulum, [dry]) is extended(Pendulum, dry)
    with pytest.raises(InputError):  # its own code alone can make it
        found.prior(Pendulum)


def test_a_stopped_search_goes_on_where_it_was():
    level = Parameter("F", 0.15, "N m", 0.0, 1.0)
    runs = recorded(extended(Pendulum, terms.coulomb("phi_dot", level, width=0.05))(), 4, 4.0)
    dry = Candidate("dry", (terms.coulomb("phi_dot", Parameter("F_c", 0.0, "N m", 0.0, 1.0), width=0.05),))
    steps, said = [], []
    whole = begun(
        runs=runs, candidates=(dry,), on_step=steps.append, on_progress=lambda *one: said.append(one)
    )
    assert [step.name for step in steps[0].steps] == ["Coulomb friction of phi_dot"]
    assert said
    again = begun(runs=runs, candidates=(dry,), begun=steps[0])
    assert [step.name for step in again.steps] == [step.name for step in whole.steps]
    assert again.values["F_c"] == pytest.approx(whole.values["F_c"], rel=1e-3)


class Vessel(Prior):
    states = (Signal("temperature", "degC", -100.0, 200.0),)
    inputs = (Signal("power", "W", -10.0, 10.0),)
    outputs = states
    parameters = (Parameter("tau", 4.0, "s", 1.0, 10.0), Parameter("gain", 2.0, "K/W", 0.5, 5.0))
    operating_point = OperatingPoint((0.0,), (0.0,))

    def xdot(self, x, u, w, p):
        return ((p.gain * u.power - x.temperature) / p.tau,)


def warmed(prior, drift, count=6, n=300, dt=0.2, seed=0):
    """Recordings of a vessel, each with a slow disturbance [K/s] of its own that nobody measures."""
    rng, f, runs = np.random.default_rng(seed), prior.equations.xdot, []
    for k in range(count):
        power = np.repeat(rng.uniform(-5, 5, n // 20), 20)[:, None]
        disturbance = drift * np.sin(2 * np.pi * np.arange(n) / n + rng.uniform(0, 6))
        x = [np.zeros(len(prior.states))]
        for u, d in zip(power[:-1], disturbance, strict=False):
            for _ in range(4):
                rate = f(x[-1], u, [], prior.p).full().ravel()
                rate[0] += d
                x.append(x[-1] + 0.25 * dt * rate)
        y = np.array(x[::4])[:, :1] + 0.02 * rng.standard_normal((n, 1))
        nothing = np.full((n, 1), np.nan)
        runs.append(Trajectory(f"run{k}", "train", dt, dt * np.arange(n), power, y, nothing, nothing))
    return runs


@pytest.mark.parametrize("drift", [0.0, 0.5])
def test_a_slow_disturbance_is_not_taken_for_a_second_capacity(drift):
    """Free first states of a slow state would explain it in every run."""
    wall = terms.storage(
        "temperature", Parameter("k_s", 0.0, "1/s", 0.0, 1.0), Parameter("tau_s", 12.0, "s", 0.2, 30.0),
        state=Signal("wall", "degC", -100.0, 200.0),
    )  # fmt: skip
    plant = Vessel() if drift else extended(Vessel, wall)({"k_s": 0.3})
    runs = warmed(plant, drift)
    known = smoothed(Vessel, fit_prior(Vessel, runs, [], dt=0.2, length=15.0), runs, 0.2)
    found = explain(
        Vessel,
        Vessel().values,
        known,
        dt=0.2,
        length=15.0,
        warm_up=2.0,
        candidates=(Candidate("wall", (wall,)),),
    )
    assert [term.name for term in found.found] == ([] if drift else ["second capacity of temperature"])


class Bath(Prior):
    states = (Signal("water", "degC", 0.0, 120.0),)
    inputs = (Signal("power", "W", 0.0, 500.0),)
    disturbances = (Signal("room", "degC", 0.0, 40.0),)
    outputs = states
    parameters = (Parameter("C", 2000.0, "J/K", 500.0, 8000.0), Parameter("G", 3.0, "W/K", 0.0, 20.0))
    operating_point = OperatingPoint((40.0,), (60.0,), (20.0,))

    def xdot(self, x, u, w, p):
        return ((u.power - p.G * (x.water - w.room)) / p.C,)


def cooled(exponent, count=5, n=400, dt=5.0):
    """Recordings of a bath that loses its heat by free convection alone."""
    rng, runs = np.random.default_rng(0), []
    for k in range(count):
        power, room = np.repeat(rng.uniform(0, 400, n // 40), 40)[:, None], 15.0 + 3 * k
        water = [room + rng.uniform(0, 20)]
        for u in power[:-1, 0]:
            one = water[-1]
            for _ in range(5):
                one += 0.2 * dt * (u - 1.2 * np.sign(one - room) * abs(one - room) ** exponent) / 2000.0
            water.append(one)
        y, nothing = np.array(water)[:, None] + 0.05 * rng.standard_normal((n, 1)), np.full((n, 1), np.nan)
        rooms = np.full((n, 1), room)
        runs.append(Trajectory(f"run{k}", "train", dt, dt * np.arange(n), power, y, nothing, nothing, rooms))
    return runs


def test_a_loss_with_an_exponent_between_those_of_the_library_is_one_term():
    runs = cooled(1.33)
    fit = fit_prior(Bath, runs, [], dt=5.0, length=1000.0)
    found = explain(Bath, fit.values, smoothed(Bath, fit, runs, 5.0), dt=5.0, length=1000.0, warm_up=50.0)
    assert [term.name for term in found.found] == ["loss to room of water"]
    (exponent,) = (p for p in found.parameters if p.name.startswith("n_"))
    assert exponent.value == pytest.approx(1.33, abs=0.05)
    assert abs(exponent.value - 1.33) < 4 * exponent.standard_error


def test_a_short_recording_is_fewer_pieces_of_evidence():
    """Ten seconds of a machine with a natural frequency of 4 rad/s are no eight pieces."""
    dry = Candidate("dry", (terms.coulomb("phi_dot", Parameter("F_c", 0.0, "N m", 0.0, 1.0), width=0.05),))
    short, long = (begun(runs=recorded(Pendulum(), 1, t), candidates=(dry,)).evidence for t in (10.0, 40.0))
    assert short.pieces == 4
    assert long.pieces == 8
    assert short.text == "4 blocks of one recording in 5 groups"


def test_products_need_several_recordings():
    dry = Candidate("dry", (terms.coulomb("phi_dot", Parameter("F_c", 0.0, "N m", 0.0, 1.0), width=0.05),))
    made = terms.product("phi_dot", Parameter("k", 0.0, "1/s^2", -1.0, 1.0), one="phi", two="phi")
    pool = dry, Candidate("product", (made,))
    assert [
        begun(runs=recorded(Pendulum(), n, 20.0), candidates=pool, most=0).candidates for n in (2, 3)
    ] == [1, 2]


@pytest.mark.parametrize(
    ("recordings", "ratio", "added"), [(1, 0.8, 0), (2, 0.8, 0), (2, 0.6, 1), (3, 0.8, 1), (5, 0.9, 0)]
)
def test_a_few_recordings_must_show_more(recordings, ratio, added):
    summary = SimpleNamespace(recordings=recordings)
    found = HeldOutError(error=0.1, ratio=ratio, lower=0.5, upper=0.95, harm=0.0)
    doubt = HeldOut.doubt(SimpleNamespace(summary=summary), found, 0.5 * np.ones((2, 3)), np.ones((2, 3)), 10)
    assert (not doubt) == bool(added)


@pytest.mark.parametrize(
    ("ratio", "short", "added"), [(0.9, "", 1), (0.9, "not significant", 0), (0.97, "", 0)]
)
def test_short_runs_may_show_what_long_ones_do_not(ratio, short, added):
    long, brief = (HeldOutError(0.1, r, 0.7, 1.1, 0.2) for r in (ratio, 0.8))
    evidence = SimpleNamespace(compared=lambda *squares: long, doubt=lambda *squares: "not significant")
    search = SimpleNamespace(
        evidence=evidence,
        short=SimpleNamespace(compared=lambda *squares: brief, doubt=lambda *squares: short),
        _short=lambda terms, theta: np.ones((2, 3)),
        _at_bounds=lambda terms, forms, theta: [],
    )
    present = Present((), np.zeros(1), np.ones((2, 3)))
    judged = TermFits._evaluated(search, present, (), np.zeros(1), 0.5 * np.ones((2, 3)), 10, [])
    assert judged.sure == bool(added)
    assert judged.short == (None if ratio > 0.95 else brief)


@pytest.mark.parametrize(("worse", "simple"), [(1.1, True), (1.3, False)])
def test_a_further_parameter_must_gain_as_much_as_a_further_term(worse, simple):
    level = Parameter("F", 0.0, "N m", 0.0, 1.0)
    dry = terms.coulomb("phi_dot", level, width=0.05)
    other = terms.coulomb_by_position(
        "phi_dot",
        *(Parameter(name, 0.0, "N m", -1.0, 1.0) for name in ("F_1", "F_2")),
        width=0.05,
        turning=True,
    )
    error = HeldOutError(0.1, 0.5, 0.4, 0.6, 0.0)
    near, best = (
        FittedCandidate((form,), replace(error, ratio=r), np.zeros(1), np.array([r]), sure=True)
        for form, r in ((dry, worse * 0.5), (other, 0.5))
    )
    evidence = SimpleNamespace(compared=lambda own, than, n: replace(error, ratio=float(own[0] / than[0])))
    assert _Explain._chosen(SimpleNamespace(evidence=evidence), [near, best]) is (near if simple else best)


@pytest.mark.parametrize(
    ("ratio", "lower", "outcome"),
    [(1.02, 1.01, "alternative"), (1.2, 0.9, "alternative"), (1.2, 1.1, "worse")],
)
def test_alternatives_are_nearly_equal_or_not_surely_worse(ratio, lower, outcome):
    pool = [
        terms.input_gain(name, Parameter(f"g_{name}", 0.0, "-", -0.5, 0.5)) for name in ("torque", "other")
    ]
    error = HeldOutError(0.1, 0.5, 0.4, 0.6, 0.0)
    added, tied = (FittedCandidate((form,), error, np.zeros(1), np.zeros(1)) for form in pool)
    evidence = SimpleNamespace(compared=lambda one, other, n: replace(error, ratio=ratio, lower=lower))
    assert _Explain._trial(SimpleNamespace(evidence=evidence), tied, added).outcome == outcome


@pytest.mark.parametrize(
    ("ratio", "outcome", "words"),
    [
        (0.97, "unsure", "not significantly better"),
        (0.8, "unsure", "not significantly better"),
        (1.1, "worse", "worse"),
    ],
)
def test_the_outcome_does_not_contradict_the_ratio(ratio, outcome, words):
    error = HeldOutError(error=0.1, ratio=ratio, lower=0.7, upper=1.2, harm=0.5)
    trial = _Explain._trial(
        SimpleNamespace(), FittedCandidate((), error, np.zeros(1), np.zeros(1), "why", False), None
    )
    assert (trial.outcome, trial.outcome_words) == (outcome, words)
    assert "(0.70 to 1.20)" in error.words
    among = Trial((), "worse", replace(error, ratio=0.6))  # beside an added term that is surely better
    assert among.outcome_words == "worse than the added term"
    assert Trial((), "worse", None).outcome_words == "no gain"


def test_the_rule_for_few_recordings_stands_where_it_applies():
    for count in (1, 2, 5):
        own = Explanation(
            "Prior", 1.0, 0.1, HeldOutError(0.1, 1.0, 1.0, 1.0, 1.0), (), (), (),
            Evidence(count, 8, 5, 1.0, f"{count} recordings"), 30, "no gain",
        )  # fmt: skip
        assert (FEW in steps_table(own).caption) == (count < 3)
        lines = summary(ExplainResult("tank", own, 0.0, 0.01), Path("out"))
        assert (FEW in lines) == (count < 3)
        assert "no scenario file was written" in lines[-1]


def test_the_page_of_terms_is_that_of_the_library():
    assert {law for laws in term_table.GROUPS.values() for law in laws.split()} == set(terms.EXPLANATIONS)
    assert (Path(__file__).parents[2] / "docs/terms.md").read_text() == term_table.document()


class Reactor(Prior):
    states = (Signal("conc", "mol/l", 0.0, 1.0), Signal("temp", "degC", 27.0, 139.0))
    inputs = (Signal("jacket", "degC", 45.0, 95.0),)
    outputs = states[1:]
    parameters = (
        Parameter("k", 3e-3, "1/s", 5e-4, 2e-2),
        Parameter("E", 7900.0, "K", 5e3, 1.2e4),
        Parameter("cool", 4.5e-3, "1/s", 1e-3, 2e-2),
    )

    def xdot(self, x, u, w, p):
        rate = p.k * ca.exp(-p.E * (1 / (x.temp + 273.15) - 1 / 350.0)) * x.conc
        return (1 - x.conc) / 300 - rate, (32.0 - x.temp) / 300 + 100 * rate - p.cool * (x.temp - u.jacket)


def test_a_lag_is_found_beside_a_state_that_no_output_measures():
    """In short windows the first concentration explains the lag: the error of such a fit over long runs is larger."""
    rng, n, dt, lag = np.random.default_rng(0), 700, 5.0, 20.0
    plant = Reactor({"k": 3.3e-3, "E": 8000.0, "cool": 5e-3})
    jacket = np.repeat(rng.uniform(55, 85, n // 25 + 1), 25)[:n, None]
    x, acts = [np.array([0.6, 71.0])], jacket[0, 0]
    for u in jacket[:-1, 0]:
        z = x[-1]
        for _ in range(5):
            acts += (u - acts) * (1 - np.exp(-dt / 5 / lag))
            z = z + dt / 5 * plant.equations.xdot(z, acts, [], plant.p).full().ravel()
        x.append(z)
    y, nothing = np.array(x)[:, 1:] + 0.1 * rng.standard_normal((n, 1)), np.full((n, 2), np.nan)
    run = [Trajectory("day", "train", dt, dt * np.arange(n), jacket, y, nothing, nothing)]
    fit = fit_prior(Reactor, run, [], dt=dt, length=300.0)
    known, fitted = smoothed(Reactor, fit, run, dt), Reactor(fit.values)
    pool = [one for one in library(fitted, visited(known), dt, 300.0) if one.name == "lag of jacket"]
    found = explain(Reactor, fit.values, known, dt=dt, length=300.0, warm_up=100.0, candidates=pool)
    assert [term.name for term in found.found] == ["lag of jacket"]
    assert found.values["tau_jacket"] == pytest.approx(lag, rel=0.15)


def test_candidates_may_be_fitted_in_other_processes():
    """Answers from pickled work and windows of their own, in reverse order, are those of one process."""
    level = Parameter("F", 0.15, "N m", 0.0, 1.0)
    runs = recorded(extended(Pendulum, terms.coulomb("phi_dot", level, width=0.05))(), 4, 4.0)
    dry = terms.coulomb("phi_dot", Parameter("F_c", 0.0, "N m", 0.0, 1.0), width=0.05)
    tau = Parameter("tau", 0.1, "s", 0.01, 1.0)
    lag = terms.input_lag("torque", tau, state=Signal("late", "N m", -9.0, 9.0))
    pool = [Candidate(one.name, (one,)) for one in (dry, lag)]
    stiff = own(lambda at, p: -p.k_own * ca.tanh(at.own / 1e-6), name="stiff")
    known = smoothed(Pendulum, fit_prior(Pendulum, runs, [], dt=DT, length=2.0), runs, DT)
    other = TermFits(Pendulum, Pendulum().values, known, DT, 1.0, 0.0, (stiff,))

    def answers(works):
        for i, work in reversed(list(enumerate(pickle.loads(pickle.dumps(works))))):
            yield i, pickle.loads(pickle.dumps(other.answer(work)))

    found = [
        explain(
            Pendulum, Pendulum().values, known, dt=DT, length=1.0, candidates=pool, own=(stiff,), answers=way
        )
        for way in (None, answers)
    ]
    assert found[0] == found[1]
    assert [term.name for term in found[0].found] == [dry.name]
    assert found[0].diverged
