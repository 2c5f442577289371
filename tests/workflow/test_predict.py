"""``hybrid-mpc predict``: from the artifact's folder alone, the same free runs and bands as the run's own."""

import csv
import json
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from patience import HANGS

from hybrid_mpc import InputError, load, load_trajectories, predict
from hybrid_mpc.files import write_json
from hybrid_mpc.kit.parts import read_description, write_description
from hybrid_mpc.workflow.predict import read_predictions
from hybrid_mpc.workflow.stages.results import read_results


@pytest.fixture(scope="module")
def model(bare_tanks, tmp_path_factory):
    """The artifact alone, away from its run."""
    return shutil.copytree(bare_tanks / "run" / "model", tmp_path_factory.mktemp("alone") / "model")


def whole(kit, path):
    spec = replace(kit.predicting.data, fractions=(1.0, 0.0, 0.0))
    (trajectory,) = load_trajectories([path], kit.models["prior"], spec, needed=()).whole
    return trajectory


def test_free_run_and_band_are_those_of_the_run(bare_tanks, model):
    kit = load(model)
    arrays = np.load(bare_tanks / "run" / "checkpoints" / "evaluation.npz")
    choice = read_results(bare_tanks / "run" / "results.json").choice
    (name, *_) = sorted({key.split("/")[1] for key in arrays if key.startswith("phy/")})
    t = arrays[f"phy/{name}/t"]
    trajectory = whole(kit, bare_tanks / f"{name.partition('#')[0]}.csv")
    first = int(np.argmin(np.abs(trajectory.t - t[0]))) - round(kit.predicting.data.warm_up / trajectory.dt)
    part = trajectory.part(slice(first, first + round(kit.predicting.data.warm_up / trajectory.dt) + len(t)))
    for own, key in (("prior", "phy"), ("hybrid", choice.deployed)):
        found = predict(kit, part, own)
        assert np.allclose(found.t, t)
        # the programs are those that were traced: rounding alone
        assert np.abs(found.free_run.y_hat - arrays[f"{key}/{name}/y_hat"]).max() < 1e-9
        # the run's figure lets the band grow to its own end, however long: alike where it is as long as those that
        # calibrated it, else only as long as the growth is the least part
        longest = kit.predicting.longest
        if t[-1] - t[0] <= longest:
            band = arrays[f"{key}/{name}/band"]
            assert np.abs(found.free_run.half_width / band - 1).max() < 1e-6


def test_predictions_are_free_runs_of_the_length_of_the_run(bare_tanks, model):
    """Each has its own warm-up: it is the free run over a part of the recording."""
    kit = load(model)
    spec, recording = kit.predicting.data, whole(kit, bare_tanks / "later.csv")
    n, warm = 40, round(spec.warm_up / spec.dt)
    short = replace(kit, predicting=replace(kit.predicting, data=replace(spec, free_run=n * spec.dt)))
    for name in ("prior", "hybrid"):
        found = predict(short, recording, name)
        assert found.run_length == n * spec.dt
        assert len(found.t) == len(recording.t) - warm
        for part in (0, 2):
            own = predict(kit, recording.part(slice(part * n, part * n + warm + n)), name).free_run
            shown = slice(part * n, (part + 1) * n)
            np.testing.assert_allclose(found.free_run.y_hat[shown], own.y_hat, atol=1e-12)
            np.testing.assert_allclose(found.free_run.half_width[shown], own.half_width, rtol=1e-9)


def test_a_longer_run_than_those_of_the_calibration_has_a_wider_band(bare_tanks, model):
    kit = load(model)
    # one run over the recording
    kit = replace(kit, predicting=replace(kit.predicting, data=replace(kit.predicting.data, free_run=None)))
    found = predict(kit, whole(kit, bare_tanks / "later.csv"), "prior")
    half, t = found.free_run.half_width[:, 0], found.t - found.t[0]
    assert t[-1] > 2 * kit.predicting.longest
    weights = kit.predicting.bands["prior"].weights[0]
    growth = weights[3] * kit.predicting.sizes.y[0] ** 2 * t / kit.predicting.longest
    least = kit.predicting.bands["prior"].scale[0] * np.sqrt(
        growth + weights[0] * kit.predicting.sigma[0] ** 2
    )
    assert (half >= least * (1 - 1e-9)).all()


def test_the_command_writes_tables_figures_and_numbers(call, bare_tanks, model, tmp_path):
    out = tmp_path / "week"
    code, told, error = call(
        "predict", model, bare_tanks / "later.csv", bare_tanks / "monday.csv", "--out", out
    )
    assert code == 0, error
    assert {path.name for path in out.iterdir()} == {
        f"{name}.{end}" for name in ("later", "monday") for end in ("csv", "png")
    } | {"predict.json"}
    found = json.loads((out / "predict.json").read_text())
    write_json(tmp_path / "again.json", read_predictions(out / "predict.json"))
    assert json.loads((tmp_path / "again.json").read_text()) == found
    kit = load(model)
    assert found["model"] == kit.recommended
    rows = list(csv.DictReader((out / "later.csv").open()))
    y, hat, lower, upper, residual = (
        np.array([float(row[f"lower{what}_m"]) for row in rows])
        for what in ("", "_hat", "_lower", "_upper", "_residual")
    )
    assert residual == pytest.approx(y - hat, abs=1e-9)
    row = next(row for row in found["recordings"] if row["recording"] == "later")
    own = row["free_run"]
    # a table has ten digits
    assert own["rmse"]["lower [m]"] == pytest.approx(np.sqrt(np.mean(residual**2)), rel=1e-6)
    assert own["fit_percent"]["lower [m]"] == pytest.approx(
        100 * (1 - np.sqrt(np.mean(residual**2)) / y.std()), rel=1e-6
    )
    assert own["inside"]["lower [m]"] == pytest.approx(np.mean((lower <= y) & (y <= upper)), abs=1.5 / len(y))
    # the observer knows the sample before: the sensor's noise is 1 mm
    assert row["one_step"]["rmse"]["lower [m]"] < 0.3 * own["rmse"]["lower [m]"]
    assert "free run" in told
    assert "one step" in told


def test_all_that_is_wrong_with_recordings_is_told_at_once(call, bare_tanks, model, tmp_path):
    lines = (bare_tanks / "later.csv").read_text().splitlines()
    (tmp_path / "named.csv").write_text("\n".join([lines[0].replace("pump", "pmup"), *lines[1:]]))
    (tmp_path / "coarse.csv").write_text("\n".join([lines[0], *lines[1::2]]))
    (tmp_path / "short.csv").write_text("\n".join(lines[:22]))
    (tmp_path / "torn.csv").write_text("\n".join([*lines[:22], *lines[50:70]]))
    files = [tmp_path / f"{name}.csv" for name in ("named", "coarse", "short", "torn")]
    code, _, error = call("predict", model, *files, "--out", tmp_path / "o")
    assert code == 2
    for words in (
        "named.csv", "'pump'", "coarse.csv: sampled every 10 s, too slow for the model period of 5 s",
        "short.csv: the recording is 100 s long (21 samples), but the warm-up (100 s)",
        "torn.csv: too short. Its longest part without a gap has 100 s; the warm-up of 100 s and 10 periods need 150 s",
    ):  # fmt: skip
        assert words in error
    assert not (tmp_path / "o").exists()


def test_models_and_artifacts_that_cannot_predict(call, bare_tanks, model, tmp_path):
    words = ("predict", model, bare_tanks / "later.csv", "--out", tmp_path / "o")
    code, _, error = call(*words, "--model", "hybird")
    assert (code, "did you mean 'hybrid'" in error) == (2, True)
    old = shutil.copytree(model, tmp_path / "old")
    write_description(old, replace(read_description(old), predicting=None))
    code, _, error = call("predict", old, bare_tanks / "later.csv", "--out", tmp_path / "o")
    assert (code, "an older version wrote it" in error) == (2, True)
    kit = load(model)
    trajectory = whole(kit, bare_tanks / "later.csv")
    with pytest.raises(InputError, match="HM-IDENTIFY-041"):
        predict(kit, trajectory.part(slice(0, 15)))
    with pytest.raises(InputError, match=r"10.*HM-IDENTIFY-044"):
        predict(kit, replace(trajectory, dt=10.0))
    quiet = replace(kit, loop=replace(kit.loop, control={}))
    assert predict(quiet, trajectory).one_step is None
    assert "HM-KIT-007" in predict(quiet, trajectory).reason


def test_missing_samples_are_predicted_in_the_free_run(bare_tanks, model):
    kit = load(model)
    trajectory = whole(kit, bare_tanks / "later.csv")
    holes = trajectory.y.copy()
    holes[60:70] = np.nan
    full, found = (predict(kit, replace(trajectory, y=y), "hybrid") for y in (trajectory.y, holes))
    assert np.array_equal(found.free_run.y_hat, full.free_run.y_hat)
    assert np.isnan(found.one_step.y_hat).sum() == 10
    assert found.free_run.rmse["lower [m]"] > 0


@pytest.mark.full
def test_it_needs_no_torch(bare_tanks, model, tmp_path):
    code = (
        "import sys\nclass Refuse:\n    def find_spec(self, name, *rest):\n"
        "        assert name.split('.')[0] != 'torch', 'torch is refused here'\n"
        "sys.meta_path.insert(0, Refuse())\nsys.argv = ['hybrid-mpc', *sys.argv[1:]]\n"
        "from hybrid_mpc.cli.main import main\nmain()"
    )
    words = ["predict", str(model), str(bare_tanks / "later.csv"), "--out", str(tmp_path / "o")]
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, timeout=HANGS)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "o" / "later.png").is_file()
