"""``hybrid-mpc benchmark`` on a machine that is simulated here, and what it refuses."""

import shutil
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
from cart import DELAY, TRUE, recording, written

from hybrid_mpc import BenchmarkBudget, BenchmarkSpec, InputError, Signal, fit_prior, load, load_scenario
from hybrid_mpc.data.trajectories import Trajectory
from hybrid_mpc.files import read_document, write_document
from hybrid_mpc.identify.dataset import cut_windows
from hybrid_mpc.identify.delay import shifted
from hybrid_mpc.identify.predict import predict
from hybrid_mpc.workflow import benchmark as job_benchmark
from hybrid_mpc.workflow.benchmark import BenchmarkContext, BenchmarkSettings, benchmark, read_benchmark
from hybrid_mpc.workflow.benchmark_runs import BenchmarkRun, read_test, read_training, run_error, run_freely
from hybrid_mpc.workflow.predict import read_recordings_of
from hybrid_mpc.workflow.settings import RunSettings
from hybrid_mpc.workflow.stages import identify
from hybrid_mpc.workflow.stages.identify import trained_models, training_settings


@pytest.fixture(scope="module")
def machine(tmp_path_factory):
    return written(tmp_path_factory.mktemp("cart"))


pytestmark = pytest.mark.usefixtures("jobs_here")


@pytest.fixture(scope="module")
def made(machine, jobs_here, tmp_path_factory):
    """A finished benchmark, by the command itself."""
    scenario, train, test = machine
    out = tmp_path_factory.mktemp("out") / "run"
    settings = BenchmarkSettings(str(scenario), (train,), (test,))
    return out, benchmark(settings, out)


def context_of(machine, out):
    """The results of a benchmark's stages."""
    settings = RunSettings(str(machine[0]), (machine[1],))
    return BenchmarkContext(settings, load_scenario(str(machine[0])), out)


def test_the_delay_and_the_parameters_are_found(machine):
    scenario = load_scenario(str(machine[0]))
    data = read_training(scenario, [machine[1]])
    fit = fit_prior(scenario.prior, data.train, data.valid, dt=0.1, length=20.0, largest_delay=0.3)
    # a tenth of a period; the delayed input is a mean over the period, which a swing of 3 s hardly notices
    assert abs(fit.delay - DELAY) < 0.01
    # the cubic spring counts as a stiffer one: at most 3 * 0.5 * 0.7^2 more, with swings of up to 0.7 m
    assert TRUE["k"] < fit.values["k"] < TRUE["k"] + 0.75
    assert abs(fit.values["d"] - TRUE["d"]) < 0.15
    assert set(fit.standard_errors) == {"k", "d"}


def test_a_test_file_is_judged_after_what_is_given_and_on_nothing_before(machine, made):
    out, results = made
    (name,), (row,) = results.test, results.test.values()
    assert name == "test.csv"
    run = row.runs[0]
    # 10 periods of warm-up: 11 samples are given, the next one is the first that counts
    assert run.t[0] == pytest.approx(1.1)
    assert len(run.t) == 400 - 11 - 1  # the last sample's input has no period after it
    assert set(row.errors) == {"phy", "rnn", "pgrnn", "mopgrnn", "hybrid", "ARX", "N4SID"}
    for model in ("phy", "hybrid"):
        assert 0 < row.errors[model].error < 0.3  # the prior knows the machine but for its cubic spring
    error = 1e3 * (run.y_hat["phy"] - run.y)[:, 0]
    assert row.errors["phy"].rmse == {"s [mm]": pytest.approx(np.sqrt(np.mean(error**2)))}
    share = np.sqrt(np.mean(error**2)) / np.std(1e3 * run.y)
    assert row.errors["phy"].error == pytest.approx(share)
    assert row.errors["phy"].fit_percent == {"s [mm]": pytest.approx(100 * (1 - share))}
    written = read_benchmark(out / "results.json")
    assert written.test["test.csv"].errors == row.errors
    assert written.data.seconds["train"] > written.data.seconds["valid"] > 0


def test_a_file_is_judged_by_all_runs_that_fit_in(machine, made, tmp_path):
    scenario, _, test = machine
    again = tmp_path / "cart.py"
    again.write_text(scenario.read_text().replace("piece=20.0,", "piece=20.0, length=5.0, repeated=True,"))
    settings = BenchmarkSettings(str(again), (), (test,), model=made[0] / "model")
    (row,) = benchmark(settings, tmp_path / "judged").test.values()
    # a run takes 10 given periods, 50 judged ones and a sample at either end: six of them fit into 400 samples
    assert [run.t[0] for run in row.runs] == pytest.approx([1.1 + 6.2 * i for i in range(6)])
    assert {len(run.t) for run in row.runs} == {50}
    with pytest.raises(InputError, match="HM-MACHINE-026"):
        BenchmarkSpec({}, repeated=True)


def test_linear_baselines_run_over_the_same_samples(machine, made):
    row = made[1].test["test.csv"]
    run, scenario = row.runs[0], load_scenario(str(machine[0]))
    (whole,) = read_test(scenario, machine[2])
    for name, model in made[1].choice.linear.items():
        (y_hat,) = model.free_runs(
            [whole], len(whole.t) - len(run.t)
        )  # what is given ends before the first that counts
        np.testing.assert_array_equal(run.y_hat[name], y_hat)
        assert np.array_equal(whole.y[-len(run.t) :], run.y)
        assert 0 < row.errors[name].error < 0.5  # the cart is linear but for its cubic spring
    assert read_benchmark(made[0] / "results.json").choice.linear["ARX"].chosen.text.startswith("order ")


def test_nothing_after_the_warm_up_is_known_to_a_free_run(machine, made, tmp_path):
    scenario, model = load_scenario(str(machine[0])), made[1]
    prior, networks = (
        scenario.prior(model.prior.fit.values),
        context_of(machine, made[0]).networks(model.choice),
    )
    lines = machine[2].read_text().splitlines()
    # from the 12th sample on, the measured position is something else; time and input are as they were
    changed = [*lines[:12], *(",".join([*line.split(",")[:2], "0.5"]) for line in lines[12:])]
    (tmp_path / "changed.csv").write_text("\n".join(changed) + "\n")
    assert lines[0].split(",") == ["t", "u", "s"]
    found = [
        run_freely(
            prior,
            model.prior.fit,
            networks,
            read_test(scenario, path),
            warm_up=1.0,
            length=None,
            linear=model.choice.linear,
        )[0]
        for path in (machine[2], tmp_path / "changed.csv")
    ]
    assert {"ARX", "N4SID"} < set(found[0].y_hat)
    for name, y_hat in found[0].y_hat.items():
        np.testing.assert_array_equal(y_hat, found[1].y_hat[name], err_msg=name)
    assert not np.allclose(found[0].y, found[1].y)


def test_the_recommended_model_is_best_on_validation_and_on_runs_of_full_length(made):
    model = made[1].choice
    validation, long = model.validation, model.long
    names = ("phy", "pgrnn", "mopgrnn")
    worse = {n: max(part[n].error / part["phy"].error for part in (validation, long)) for n in names}
    able = ("phy", *model.choice.sure)
    assert made[1].hybrid == min((n for n in names if n.partition(" ")[0] in able), key=worse.get)
    assert set(model.choice.sure) == {
        n for n, own in model.choice.candidates.items() if n != "phy" and own.upper < 1
    }


@pytest.mark.full
def test_a_share_of_a_correction_is_kept_judged_and_told(machine, made, tmp_path, monkeypatch):
    scenario, train, test = machine
    out, whole_choice = tmp_path / "half", job_benchmark.choice_stage
    shutil.copytree(made[0], out)
    (out / "checkpoints" / "choice.json").unlink()

    def half(context):
        found = whole_choice(context)
        own = replace(found.choice.candidates["mopgrnn"], share=0.5)
        candidates = {**found.choice.candidates, "mopgrnn": own}
        return replace(found, choice=replace(found.choice, candidates=candidates, sure=("mopgrnn",)))

    monkeypatch.setattr(job_benchmark, "choice_stage", half)
    results = benchmark(BenchmarkSettings(str(scenario), (train,), (test,)), out)
    context = context_of(machine, out)
    whole, kept = trained_models(context, "mopgrnn"), context.networks(results.choice)["mopgrnn"]
    for name, weight in whole.weights.items():
        np.testing.assert_array_equal(
            kept.weights[name], (0.5 if name in ("w_out", "b_out") else 1.0) * weight
        )
    before, after = (r.test["test.csv"].errors for r in (made[1], results))
    assert after["mopgrnn"].error != pytest.approx(before["mopgrnn"].error, rel=1e-4)
    assert after["pgrnn"] == before["pgrnn"]
    assert "mopgrnn: 50 % of its correction" in job_benchmark.table(results)


def test_networks_are_trained_with_what_the_budget_says(machine, tmp_path):
    budget = BenchmarkBudget(4, 2, teacher_steps=5, free_run_steps=5, horizon=10, decay=7.0, prior_replay=3.0)
    scenario = load_scenario(str(machine[0]))
    scenario = replace(scenario, benchmark=replace(scenario.benchmark, budgets={"own": budget}))
    context = BenchmarkContext(RunSettings("cart", seed=1, budget="own"), scenario, tmp_path)
    settings = training_settings(context, "pgrnn")
    for name, value in vars(budget).items():
        assert getattr(settings, name) == value
    assert (settings.seed, settings.warm, settings.parts) == (1, 10, 4)


def test_a_benchmark_leaves_a_kit_that_predicts(machine, made):
    kit = load(made[0])
    assert set(kit.models) >= {"prior", "hybrid"}
    assert kit.provenance.scenario == "cart"
    (recording,), _ = read_recordings_of(kit, [machine[2]])
    free = predict(kit, recording, "prior").free_run
    assert 1e3 * free.rmse["s [m]"] == pytest.approx(
        made[1].test["test.csv"].errors["phy"].rmse["s [mm]"], rel=0.1
    )


@pytest.mark.full
def test_a_model_made_before_gives_the_same_figures_and_an_interrupted_run_goes_on(machine, made, tmp_path):
    scenario, train, test = machine
    out, results = made
    again = benchmark(BenchmarkSettings(str(scenario), test=(test,), model=out), tmp_path / "again")
    folder = out / "checkpoints" / "training" / results.training.folder
    (folder / "pgrnn.json").unlink()  # as if it had been killed before this was written
    (folder / "pgrnn.npz").unlink()
    resumed = benchmark(BenchmarkSettings(str(scenario), (train,), (test,)), out)
    before = results.test["test.csv"].errors
    for found in (run.test["test.csv"].errors for run in (again, resumed)):
        for name in before:
            if name in results.choice.linear:  # its matrices lie in memory otherwise: sums in another order
                assert found[name].error == pytest.approx(before[name].error, rel=1e-9)
            else:
                assert found[name] == before[name]


def test_a_changed_machine_is_known_again_after_a_few_seconds(machine, made, tmp_path):
    scenario, _, _ = machine
    changed = recording(tmp_path / "changed.csv", seed=2, seconds=40.0, k=7.0)
    settings = BenchmarkSettings(str(scenario), test=(changed,), model=made[0], refit=10.0)
    found = benchmark(settings, tmp_path / "judged").test["changed.csv"].refit
    assert 7.0 < found.values["k"] < 7.75  # the cubic spring counts as at most 3 * 0.5 * 0.7^2 more
    for name in ("phy", "hybrid"):
        assert found.after[name].rmse["s [mm]"] < 0.25 * found.before[name].rmse["s [mm]"]
    with pytest.raises(InputError, match="HM-WORKFLOW-012"):
        benchmark(
            BenchmarkSettings(str(scenario), test=(changed,), model=made[0], refit=50.0), tmp_path / "no"
        )


def test_the_shortest_refit_is_shorter_than_its_longest_run(machine, made, tmp_path):
    scenario, _, test = machine
    settings = BenchmarkSettings(str(scenario), test=(test,), model=made[0], refit=1.5)
    assert benchmark(settings, tmp_path / "judged").test["test.csv"].refit.seconds == 1.5


def test_the_delay_takes_samples_from_the_start_only(machine):
    scenario = load_scenario(str(machine[0]))
    (whole,) = read_test(scenario, machine[2])
    (late,) = shifted([whole], DELAY)
    assert late.t[-1] == whole.t[-1]
    assert len(whole.t) - len(late.t) == 2
    assert len(cut_windows([late], 0, 10, 10)) > 0


def test_a_diverging_run_is_infinite_and_not_nan():
    y = np.array([[0.0], [1.0]])
    run = BenchmarkRun("run", np.arange(2.0), y, y, {"rnn": np.array([[0.0], [np.nan]])})
    found = run_error([run], "rnn", [Signal("phi", "rad")], BenchmarkSpec())
    assert found.rmse == {"phi [rad]": float("inf")}
    assert found.error == float("inf")


@pytest.fixture
def call(call):
    """Run the command in this process: ``(exit code, stdout, stderr)``."""
    return partial(call, "benchmark")


def test_the_command_judges_a_model_and_draws_it(call, machine, made, tmp_path):
    out = tmp_path / "judged"
    code, told, _ = call(machine[0], "--model", made[0], "--test", machine[2], "--out", out)
    assert code == 0
    assert "RMSE s [mm]" in told
    assert all(name in told for name in ("hybrid", "ARX", "N4SID"))
    assert (out / "results.json").is_file()
    assert (out / "figures" / "test.png").stat().st_size > 10_000  # an empty page of this size has about 2 kB


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "HM-WORKFLOW-005"),
        (("--data", "a.csv", "--model", "m"), "HM-WORKFLOW-006"),
        (("--model", "nowhere"), "--test FILE"),
        (("--data", "a.csv", "--budget", "huge"), "'huge'; choose one of: quick [HM-WORKFLOW-004]"),
        (("--data", "missing.csv"), "HM-DATA-025"),
        (("--model", "nowhere", "--test", "TEST"), "HM-WORKFLOW-009"),
    ],
)
def test_what_the_command_refuses(call, machine, tmp_path, words, message):
    words = [machine[2] if word == "TEST" else word for word in words]
    code, _, told = call(machine[0], *words, "--out", tmp_path / "out")
    assert code == 2
    assert message in told
    assert not (tmp_path / "out" / "results.json").exists()


def test_a_folder_whose_pieces_had_other_roles_is_refused(machine, made):
    scenario, train, _ = machine
    note = read_document(made[0] / "benchmark.json")
    write_document(
        made[0] / "benchmark.json", note | {"settings": note["settings"] | {"pieces": "of another version"}}
    )
    try:
        with pytest.raises(InputError, match=r"pieces.*HM-FOLDER-005"):
            benchmark(BenchmarkSettings(str(scenario), (train,)), made[0])
    finally:
        write_document(made[0] / "benchmark.json", note)


def test_a_folder_of_another_benchmark_is_refused(call, machine, made):
    code, _, told = call(machine[0], "--data", machine[2], "--out", made[0])
    assert code == 2
    assert "other settings (data, pieces differ)" in told
    code, _, told = call("golf_robot", "--data", machine[2], "--out", made[0])
    assert code == 2
    assert "HM-WORKFLOW-013" in told


def test_a_scheduler_s_workers_examine_the_fit_and_train_the_networks(machine, tmp_path, monkeypatch):
    """The jobs go to the engine with the scheduler's address; tests of the engine say what it does with them."""
    scenario, train, test = machine
    asked = []

    def engine(jobs, on_progress, workers, *, cluster):
        asked.append((sorted(jobs), cluster))
        if "pgrnn" in jobs:
            raise InputError("no worker")
        return {"wrong terms": "", "recordings": ()}

    monkeypatch.setattr("hybrid_mpc.workflow.stages.identify.run_jobs", engine)
    with pytest.raises(InputError, match="no worker"):
        benchmark(BenchmarkSettings(str(scenario), (train,), (test,)), tmp_path, cluster="tcp://127.0.0.1:9")
    address = "tcp://127.0.0.1:9"
    assert asked == [(["recordings", "wrong terms"], address), (["mopgrnn", "pgrnn", "rnn"], address)]


def test_linear_models_of_runs_over_acting_inputs_are_fitted_to_them(monkeypatch):
    """With a fitted delay, models of the commanded inputs would be judged by other inputs than they know."""
    n, seen = 20, []
    u = np.arange(n, dtype=float)[:, None]
    run = Trajectory("run", "train", 0.1, 0.1 * np.arange(n), u, u, u, u, np.zeros((n, 0)))
    monkeypatch.setitem(identify.BASELINES, "ARX", lambda train, valid, dt, warm: seen.append(train[0].u))
    monkeypatch.delitem(identify.BASELINES, "N4SID")
    context = SimpleNamespace(trajectories=lambda role: [run], spec=SimpleNamespace(dt=0.1), warm=3)
    identify.linear_models(context)
    identify.linear_models(context, 0.2)
    np.testing.assert_array_equal(seen[0], u)
    np.testing.assert_array_equal(seen[1], u[:-2])
