"""``hybrid-mpc explain``: what it finds, its files, the scenario that it writes, and what it refuses."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from machine_runs import recording, write

import hybrid_mpc as hm
from hybrid_mpc import InputError, RunSettings, extended, load_scenario, terms, with_nominal
from hybrid_mpc.check.preflight import check_scenario
from hybrid_mpc.cli.explain import summary
from hybrid_mpc.data.scales import time_unit
from hybrid_mpc.identify.evidence import ADDED
from hybrid_mpc.plots.explain import error_steps
from hybrid_mpc.records import plain
from hybrid_mpc.workflow import explain_page, explain_search
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.explain import RESULT
from hybrid_mpc.workflow.explain_search import chosen_terms
from hybrid_mpc.workflow.explained import scenario_code
from hybrid_mpc.workflow.stage import bring_up_to_date
from hybrid_mpc.workflow.stages.explain import EXPLAIN
from hybrid_mpc.workflow.stages.identify import DATA, PRIOR
from hybrid_mpc.workflow.stages.promises import found_terms

LAWS = ("coulomb", "quadratic")
DRY = 0.08
"""Dry friction [N m] of the simulated machine, which the prior lacks."""


@pytest.fixture(scope="module")
def files(machine):
    return tuple(machine / f"{name}.csv" for name in ("monday", "tuesday"))


@pytest.fixture(scope="module")
def explained(machine, files, tmp_path_factory):
    """Folder of a search, and what it found."""
    out = tmp_path_factory.mktemp("explained") / "out"
    settings = RunSettings(str(machine / "my_machine.py"), files)
    return out, hm.explain(settings, out, terms=LAWS, most=1)


def test_the_missing_friction_is_found(explained):
    out, found = explained
    told = found.explanation
    assert [term.made.maker for term in told.found] == ["coulomb"]
    assert told.values["F_c_phi_dot"] == pytest.approx(DRY, rel=0.1)
    assert told.after.ratio < 0.5
    assert told.nominal > told.before > told.steps[0].held_out.error > found.floor > 0
    assert found.tests["nominal"].error > found.tests["fitted"].error > 2 * found.tests["explained"].error
    assert json.loads((out / RESULT).read_text())["result"] == plain(found)


def test_its_page_shows_the_steps_and_the_term(explained):
    out, found = explained
    page = (out / "explain.html").read_text()
    for words in ("Coulomb friction of phi_dot", "-F_c_phi_dot sign(phi_dot)", found.file, "sensor noise"):
        assert words in page
    assert {p.name for p in (out / "figures").iterdir()} == {"error_by_step.png", "step_1_1.png"}
    assert page.count("data:image/png") == 2


def test_ratios_are_one_statistic_with_one_name(explained, machine):
    """Page, table and file say of what the ratio is the mean; the bars show errors alone, without a ratio."""
    out, found = explained
    told, words = found.explanation, found.explanation.averaged
    assert str(told.evidence.pieces) in words
    page = (out / "explain.html").read_text()
    assert words in page
    assert words in explain_page.steps_table(told).caption
    assert explain_page.RATIO in explain_page.steps_table(told).columns
    assert words in " ".join(summary(found, out))
    assert words in (out / found.file).read_text()
    figure = error_steps(*explain_page.bars_of(told), "error [-]")
    assert not any("%" in text.get_text() for text in figure.axes[0].texts)
    rule = f"below {ADDED:g} and the upper bound of its interval is below 1"
    assert rule in page
    assert rule in (Path(__file__).parents[2] / "docs/explain.md").read_text()


def test_its_scenario_has_the_prior_of_the_explanation(explained, machine, files, call):
    out, found = explained
    scenario, base = load_scenario(str(out / found.file)), load_scenario(str(machine / "my_machine.py"))
    assert scenario.name == f"{base.name}_explained"
    check_scenario(scenario)
    made, wanted = scenario.prior(), found.explanation.prior(type(base.prior()))(found.explanation.values)
    assert list(made.values) == list(wanted.values)
    np.testing.assert_allclose(made.p, wanted.p, rtol=1e-5)
    x, u = [0.3, 1.7], [0.2]
    np.testing.assert_allclose(
        made.equations.xdot(x, u, [], made.p).full(),
        wanted.equations.xdot(x, u, [], wanted.p).full(),
        rtol=1e-5,
    )
    assert scenario.prior({"d": 0.2}).values["d"] == 0.2
    own, given = (Context(RunSettings(one.name), one, out) for one in (scenario, base))
    assert found_terms(own) == tuple(term.name for term in found.explanation.found)
    assert found_terms(given) is None
    code, told, _ = call("check", out / found.file, *(word for path in files for word in ("--data", path)))
    assert code == 0
    assert "F_c_phi_dot" in told


def test_its_scenario_has_the_error_of_the_explanation(explained, files):
    out, found = explained
    scenario = load_scenario(str(out / found.file))
    prior, spec = scenario.prior(), scenario.data
    data = hm.load_trajectories(files, prior, spec)
    known = [*data.by_role("train"), *data.by_role("valid")]
    warm, unit = round(spec.warm_up / spec.dt), time_unit(data.by_role("train"), spec.dt)
    smoother = hm.fit_smoother(prior, known, spec.dt, time_unit=unit)
    runs = hm.evaluation_trajectories(smoother.smooth(data.by_role("test")), smoother, warm, spec.free_run)
    step = hm.PriorStep(prior, spec.dt, smoother.substeps)
    errors = hm.score(hm.free_runs(step, prior, runs, warm), prior)
    for label, rmse in found.tests["explained"].rmse.items():
        assert errors.rmse[label] == pytest.approx(rmse, rel=1e-2)


def test_the_command_goes_on_and_prints_the_table(explained, machine, files, call, monkeypatch):
    out, found = explained
    monkeypatch.setattr(explain_search, "search", None)  # nothing is searched again
    monkeypatch.setattr(explain_search, "fit_prior", None)
    words = [word for path in files for word in ("--data", path)]
    laws = [word for law in LAWS for word in ("--terms", law)]
    code, told, _ = call("explain", machine / "my_machine.py", *words, *laws, "--most", 1, "--out", out)
    assert code == 0
    told = " ".join(told.split())
    for text in ("prior, nominal", "-F_c_phi_dot sign(phi_dot)", "prior with the found terms", found.file):
        assert text in told
    code, _, said = call("explain", machine / "my_machine.py", *words, "--out", out)  # other settings
    assert code == 2
    assert "terms" in said


def test_a_stopped_command_goes_on_after_its_last_step(machine, files, tmp_path, monkeypatch):
    settings, whole = RunSettings(str(machine / "my_machine.py"), files), explain_search.search
    begun = []

    def stopped(*given, on_step, **more):
        def kept(told):
            on_step(told)
            raise KeyboardInterrupt

        return whole(*given, on_step=kept, **more)

    def resumed(*given, **more):
        begun.append(more["begun"])
        return whole(*given, **more)

    monkeypatch.setattr(explain_search, "search", stopped)
    with pytest.raises(KeyboardInterrupt):
        hm.explain(settings, tmp_path / "out", terms=LAWS)
    monkeypatch.setattr(explain_search, "search", resumed)
    monkeypatch.setattr(explain_search, "fit_prior", None)  # the fit is kept
    found = hm.explain(settings, tmp_path / "out", terms=LAWS)
    assert [step.name for step in begun[0].steps] == [step.name for step in found.explanation.steps]
    assert found.explanation.steps[0].terms[0].made.maker == "coulomb"


def test_a_search_goes_on_or_ends_with_another_number_of_steps(machine, files, tmp_path, monkeypatch):
    settings, out, whole = (
        RunSettings(str(machine / "my_machine.py"), files),
        tmp_path / "out",
        explain_search.search,
    )

    def stopped(*given, on_step, **more):
        def kept(told):
            on_step(told)
            raise KeyboardInterrupt

        return whole(*given, on_step=kept, **more)

    monkeypatch.setattr(explain_search, "search", stopped)
    with pytest.raises(KeyboardInterrupt):
        hm.explain(settings, out, terms=LAWS)
    monkeypatch.setattr(explain_search, "search", whole)
    first = hm.explain(settings, out, terms=LAWS, most=1)
    assert len(first.explanation.found) == 1
    assert (out / RESULT).is_file()
    more = hm.explain(settings, out, terms=LAWS, most=2).explanation
    assert more.steps[0] == first.explanation.steps[0]
    assert more.reason != first.explanation.reason  # the second step was searched
    monkeypatch.setattr(explain_search, "search", None)
    for most in (1, 2, 8):
        assert hm.explain(settings, out, terms=LAWS, most=most).explanation == more


def test_what_it_refuses(machine, files, tmp_path, call):
    path = machine / "my_machine.py"
    few = write(tmp_path / "few.csv", recording(3, seconds=3.0))
    for words in (
        (),  # no recordings
        ("--data", files[0], "--terms", "coulom"),  # no law
        ("--data", files[0], "--terms", "radiation"),  # of temperatures alone
        ("--data", few),
    ):
        out = tmp_path / "refused"
        code, _, said = call("explain", path, *words, "--out", out)
        assert code == 2, words
        assert "error:" in said
        assert not (out / "explain.json").exists()


def test_own_terms_are_tried_and_stand_in_the_file(machine, files, tmp_path):
    text = (machine / "my_machine.py").read_text()
    own = """
import casadi as ca
from hybrid_mpc import Parameter, Term
rub = Term("rubbing", "force", "phi_dot", (Parameter("rub", 0.0, "N m", 0.0, 1.0),),
           lambda at, p: -p.rub * ca.tanh(at.own / 0.05), "-rub sign(phi_dot)", loss=True)
scenario = dataclasses.replace(scenario, terms=("quadratic", rub))
"""
    (tmp_path / "own.py").write_text(text + own)
    found = hm.explain(RunSettings(str(tmp_path / "own.py"), files), tmp_path / "out", most=1)
    assert [term.name for term in found.explanation.found] == ["rubbing"]
    made = load_scenario(str(tmp_path / "out" / found.file))
    assert made.prior().values["rub"] == pytest.approx(DRY, rel=0.1)
    assert chosen_terms(made).own == ()  # it has the term already
    with pytest.raises(InputError):
        chosen_terms(replace(made, terms=("rubbing",)))


def test_a_prior_with_terms_can_be_explained_again(explained, machine, files, tmp_path):
    """Laws that it has are no candidates; a second file keeps the first terms."""
    out, found = explained
    scenario = load_scenario(str(out / found.file))
    kind = type(scenario.prior())
    values = {**kind().values, "F_c_phi_dot": 0.07}
    again = with_nominal(kind, values)
    assert again().values == values
    assert [term.made.maker for term in again.terms] == ["coulomb"]
    more = extended(again, terms.quadratic("phi_dot", hm.Parameter("c", 0.0, "N m s^2/rad^2", 0.0, 1.0)))
    assert more().values == {**values, "c": 0.0}
    with pytest.raises(InputError):
        with_nominal(kind, {"nothing": 1.0})
    with pytest.raises(InputError):  # its only law that may apply is there
        hm.explain(RunSettings(str(out / found.file), files), tmp_path / "again", terms=("coulomb",))


def test_a_found_state_is_added_to_the_control_problem_and_the_tasks(machine, explained, tmp_path):
    _, found = explained
    told, base = found.explanation, load_scenario(str(machine / "my_machine.py"))
    lag = terms.input_lag(
        "tau", hm.Parameter("t_tau", 0.1, "s", 0.01, 1.0), state=hm.Signal("s_tau", "N m", -9.0, 9.0)
    )
    term = replace(told.found[0], name=lag.name, made=lag.made)
    value = replace(told.parameters[-1], name="t_tau", value=0.2, lower=0.01, upper=1.0)
    changed = replace(
        told, steps=(replace(told.steps[0], terms=(term,)),), parameters=(*told.parameters[:-1], value)
    )
    file = tmp_path / "lagged.py"
    file.write_text(scenario_code(base, str(machine / "my_machine.py"), changed, tmp_path))
    assert str(machine) not in file.read_text()  # the way to it, so that both may move
    scenario = load_scenario(str(file))
    assert scenario.control.q.size == base.control.q.size + 1
    assert scenario.plant is None
    assert [s.name for s in scenario.prior().states][-1] == "s_tau"
    assert scenario.prior().values["t_tau"] == 0.2
    check_scenario(scenario)


def test_the_written_operating_point_is_an_equilibrium_with_the_found_terms(machine, explained, tmp_path):
    """An offset of the torque moves the equilibrium; a parameter that is fixed later in the base file says so."""
    _, found = explained
    told, path = found.explanation, tmp_path / "base.py"
    path.write_text((machine / "my_machine.py").read_text())
    shift = terms.input_offset("tau", hm.Parameter("o_tau", 0.0, "N m", -1.0, 1.0))
    term = replace(told.found[0], name=shift.name, made=shift.made)
    value = replace(told.parameters[-1], name="o_tau", value=0.3, lower=-1.0, upper=1.0)
    changed = replace(
        told, steps=(replace(told.steps[0], terms=(term,)),), parameters=(*told.parameters[:-1], value)
    )
    file = tmp_path / "shifted.py"
    file.write_text(scenario_code(load_scenario(str(path)), str(path), changed, tmp_path))
    scenario = load_scenario(str(file))
    old = type(load_scenario(str(path)).prior()).operating_point
    point = scenario.prior().operating_point
    assert point.x == old.x
    assert point.u[0] == pytest.approx(old.u[0] - 0.3)
    check_scenario(scenario)
    fixed = next(p for p in scenario.prior().parameters if p.name != "o_tau" and p.value != p.lower)
    kind = "class Fixed"
    path.write_text(
        path.read_text()
        + f"""
class Fixed(type(scenario.prior())):
    parameters = tuple(
        dataclasses.replace(p, value=p.lower, upper=p.lower) if p.name == {fixed.name!r} else p
        for p in type(scenario.prior()).parameters
    )
scenario = dataclasses.replace(scenario, prior=Fixed)
"""
    )
    with pytest.raises(InputError) as refused:
        load_scenario(str(file))
    assert "HM-MACHINE-046" in str(refused.value)
    assert kind in str(refused.value)
    assert str(path) in str(refused.value)


def test_bars_without_a_finite_error_are_refused():
    assert error_steps(["a", "b", "c"], [1.0, float("inf"), 0.5], "error [-]").axes
    with pytest.raises(InputError):
        error_steps(["a"], [float("nan")], "error [-]")


def test_explain_json_is_plain(explained):
    out, _ = explained
    held = json.loads((out / "explain.json").read_text())
    assert (held["schema"], held["schema_version"]) == ("hybrid-mpc explain", 1)
    assert held["result"]["explanation"]["steps"][0]["terms"][0]["made"]["maker"] == "coulomb"


@pytest.fixture(scope="module")
def asking(machine, files, tmp_path_factory):
    """Settings of runs whose scenario names one law, with and without --explain."""
    path = tmp_path_factory.mktemp("asking") / "my_machine.py"
    text = (machine / "my_machine.py").read_text()
    path.write_text(f'{text}\nscenario = dataclasses.replace(scenario, terms=("coulomb",))\n')
    settings = RunSettings(str(path), files, explain=True)
    return settings, replace(settings, explain=False)


def test_stages_go_on_with_the_found_terms(asking, tmp_path):
    """Fit, and what trains and closes loops elsewhere, have the extended prior; without --explain the user's."""
    settings, bare = asking
    for own in (settings, settings, bare):
        context = Context(own, load_scenario(own.scenario), tmp_path)
        said = [bring_up_to_date(context, stage) for stage in (DATA, EXPLAIN, PRIOR)]
        values = context.prior.fit.values
        if not own.explain:
            assert said[1:] == ["", ""]  # the prior of the search is no longer the run's
            assert "F_c_phi_dot" not in values
            assert context.scenario is context.given
            break
        assert values["F_c_phi_dot"] == pytest.approx(DRY, rel=0.1)
        assert context.scenario.name == "my_machine_explained"
        assert load_scenario(context.scenario_path).prior().values["F_c_phi_dot"] == pytest.approx(
            DRY, rel=0.1
        )
        assert context.as_given.scenario.name == "my_machine"
        assert said in ([""] * 3, ["up to date"] * 3)


@pytest.mark.full  # two fits and their pictures
def test_a_run_shows_the_found_terms(asking, tmp_path):
    settings, bare = asking
    for own, shown in ((settings, True), (bare, False)):
        assert hm.run(own, tmp_path / "run", resume=not shown, only=("data", "explain", "prior")) is None
        page = (tmp_path / "run" / "report.html").read_text()
        assert ("Missing terms" in page) == ("--explain" in page) == shown
