"""A machine that is no pendulum: heat in two bodies, two outputs of other units, no balance."""

import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from hybrid_mpc import load, load_scenario, write_csv
from hybrid_mpc.cli.main import app
from hybrid_mpc.identify.evaluate import evaluation_trajectories, score
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.settings import RunSettings
from hybrid_mpc.workflow.stages import choose
from hybrid_mpc.workflow.stages.identify import runs_of
from hybrid_mpc.workflow.stages.results import read_results

MACHINE = """
from hybrid_mpc import Budget, DataSpec, OperatingPoint, Parameter, Prior, Scenario, Signal


class Bodies(Prior):
    states = (Signal("hot", "degC", 0.0, 200.0), Signal("cold", "degC", 0.0, 200.0))
    inputs = (Signal("power", "W", 0.0, 50.0),)
    outputs = (Signal("cold", "degC", 0.0, 200.0), Signal("sensor", "mV", 0.0, 5.0))
    parameters = (Parameter("gain", 0.05, "K/s/W", 0.02, 0.2), Parameter("loss", 0.04, "1/s", 0.01, 0.1))
    operating_point = OperatingPoint(x=(76.25, 51.25), u=(25.0,))

    def xdot(self, x, u, w, p):
        across = 0.05 * (x.hot - x.cold)
        return p.gain * u.power - across, across - p.loss * (x.cold - 20.0)

    def output(self, x, u, w, p):
        return x.cold, 0.02 * x.hot


scenario = Scenario(
    "bodies", "Two bodies", "", prior=Bodies,
    data=DataSpec("t", ("p",), ("c", "s"), dt=2.0, max_gap=5.0, smoothing=10.0, warm_up=10.0),
    budgets={
        "quick": Budget(hidden=4, networks=2, teacher_steps=10, free_run_steps=5, seeds=1),
        "prior": Budget(1, 1, 0, 0, seeds=1),
    },
)
"""


SKIPPED = [word for stage in ("control", "estimation", "watch") for word in ("--skip", stage)]


def recording(path):
    """900 samples; a little of the heat goes by radiation, which no prior knows."""
    rng, n = np.random.default_rng(0), 900
    power, x = np.repeat(rng.uniform(10.0, 40.0, n // 30), 30), np.array([70.0, 45.0])
    y = np.empty((n, 2))
    for k in range(n):
        y[k] = x[1], 0.02 * x[0]
        for _ in range(10):
            across = 0.05 * (x[0] - x[1])
            x = x + 0.2 * np.array(
                [0.06 * power[k] - across, across - 0.05 * (x[1] - 20.0) - 1e-5 * (x[1] - 20.0) ** 2]
            )
    y += rng.normal(0.0, (0.05, 0.001), y.shape)
    return write_csv(path, {"t": 2.0 * np.arange(n), "p": power, "c": y[:, 0], "s": y[:, 1]})


@pytest.fixture(scope="module")
def bodies(jobs_here, tmp_path_factory):
    """Folder of a run, and what the terminal was told."""
    folder = tmp_path_factory.mktemp("bodies")
    (folder / "bodies.py").write_text(MACHINE)
    data, out = recording(folder / "run.csv"), folder / "run"
    words = ("run", folder / "bodies.py", "--data", data, *SKIPPED, "--out", out)
    done = CliRunner().invoke(app, [*map(str, words)])
    assert done.exit_code == 0, done.output
    return out, done.stdout.partition("free runs on held-out data:")[2]


def test_every_output_has_its_figures_and_there_is_no_mopgrnn(bodies):
    out, told = bodies
    results = read_results(out / "results.json")
    found = {name: scores.model for name, scores in results.evaluation.scores.items()}
    assert set(found) == {"phy_nominal", "phy", "rnn", "pgrnn"}
    for scores in found.values():
        assert set(scores.rmse) == set(scores.fit_percent) == {"cold [degC]", "sensor [mV]"}
        assert scores.violation == {}
    assert found["phy"].fit_percent["cold [degC]"] > 90
    assert set(results.choice.choice.candidates) == {"phy", "pgrnn"}
    assert set(results.evaluation.bands["phy"].width) == {"cold [degC]", "sensor [mV]"}
    for words in ("RMSE cold [degC]", "RMSE sensor [mV]", "ARX", "N4SID"):
        assert words in told
    assert "mopgrnn" not in told
    # what models are compared by is over the outputs' spreads: neither unit rules it
    shares = [1 - fit / 100 for fit in found["phy"].fit_percent.values()]
    assert found["phy"].error == pytest.approx(
        np.sqrt(np.mean(np.square(shares))), rel=0.5
    )  # of training data


def test_the_report_has_the_units_of_the_machine_and_says_what_is_missing(bodies):
    page = (bodies[0] / "report.html").read_text()
    text = re.sub(r"<[^>]+>", " ", page)
    for words in ("RMSE of cold [degC]", "RMSE of sensor [mV]", "FIT of sensor [%]", "There is no MOPGRNN"):
        assert words in text
    assert not re.search(r"\[(rad|W|N m)\]", text.partition("Names and definitions")[0])


def test_a_run_without_training_mentions_no_network(jobs_here, tmp_path):
    (tmp_path / "bodies.py").write_text(MACHINE)
    data, out = recording(tmp_path / "run.csv"), tmp_path / "run"
    words = ("run", tmp_path / "bodies.py", "--data", data, *SKIPPED, "--budget", "prior", "--out", out)
    done = CliRunner().invoke(app, [*map(str, words)])
    assert done.exit_code == 0, done.output
    results = read_results(out / "results.json")
    assert set(results.evaluation.scores) == {"phy_nominal", "phy"}
    assert set(results.choice.choice.candidates) == {"phy"} == {results.choice.choice.recommended}
    page = (out / "report.html").read_text()
    assert "RNN" not in done.stdout.upper() + re.sub(r"<[^>]+>|[\w+/]{80,}", " ", page)
    models = load(out / "model").models  # the kit's hybrid equals the prior
    x, u, none = np.array([70.0, 50.0]), np.array([20.0]), np.zeros(0)
    steps = [m.step(x, np.zeros(m.n_h), u, none, m.p)[0].full() for m in models.values()]
    np.testing.assert_allclose(steps[0], steps[1], rtol=1e-12)  # rounding


def test_a_model_that_is_not_there_cannot_be_deployed(call, bodies, tmp_path):
    folder = bodies[0].parent
    words = ("--data", folder / "run.csv", "--deploy", "mopgrnn", "--out", tmp_path / "no")
    code, _, told = call("run", folder / "bodies.py", *words)
    assert code == 2
    assert "model to deploy" in told
    assert not (tmp_path / "no").exists()


@pytest.mark.full
def test_a_share_of_the_correction_goes_into_all_that_follows(bodies, jobs_here, tmp_path, monkeypatch):
    """Figures and artifact have half of what the networks say; the prior is linear, and so is the step's difference."""
    whole, out, recommend = bodies[0], tmp_path / "half", choose.recommend
    shutil.copytree(whole, out)

    def half(errors, *, shrunk, **given):
        found = recommend(errors, shrunk=shrunk, **given)
        own = replace(found.candidates["pgrnn"], share=0.5)
        return replace(found, candidates={**found.candidates, "pgrnn": own})

    monkeypatch.setattr(choose, "recommend", half)
    words = ("--data", whole.parent / "run.csv", *SKIPPED, "--out", out, "--resume", "--deploy", "pgrnn")
    done = CliRunner().invoke(app, [*map(str, ("run", whole.parent / "bodies.py", *words))])
    assert done.exit_code == 0, done.output
    before, after = (read_results(f / "results.json") for f in (whole, out))
    assert after.choice.choice.candidates["pgrnn"].share == 0.5
    scenario = load_scenario(str(whole.parent / "bodies.py"))
    context = Context(RunSettings(scenario.name, (whole.parent / "run.csv",), 0), scenario, out)
    phy = scenario.prior(context.prior.fit.values)
    smoother = context.prior.fit.smoother(phy, context.spec.dt)
    test = evaluation_trajectories(context.smoothed("test"), smoother, context.warm, context.spec.free_run)
    of_share = [
        score(runs_of(context, "pgrnn", phy, test, share=share)[0], phy, smoother.sizes.y).error
        for share in (1.0, 0.5)
    ]
    found, phys = (
        [results.evaluation.scores[name].model.error for results in (before, after)]
        for name in ("pgrnn", "phy")
    )
    assert found == pytest.approx(of_share, rel=1e-9)
    assert of_share[0] != pytest.approx(of_share[1], rel=1e-3)
    bands = [results.evaluation.bands["pgrnn"].width["cold [degC]"] for results in (before, after)]
    assert bands[0] != pytest.approx(bands[1], rel=1e-3)
    assert phys[0] == phys[1]
    x, u, steps = np.array([70.0, 50.0]), np.array([20.0]), []
    for folder in (whole, out):
        models = load(folder / "model").models
        h = np.zeros(models["hybrid"].n_h)
        none = np.zeros(0)
        hybrid = models["hybrid"].step(x, h, u, none, models["hybrid"].p)[0]
        prior = models["prior"].step(x, none, u, none, models["prior"].p)[0]
        steps.append((hybrid - prior).full().ravel())
    assert np.abs(steps[0]).max() > 1e-6
    np.testing.assert_allclose(steps[1], 0.5 * steps[0], rtol=1e-8, atol=1e-12)
    assert re.search(r"<td>50\s%</td>", (out / "report.html").read_text())
