"""What is doubtful about a user's recordings, and about the fit of the prior, reaches the terminal and the files."""

import json
from dataclasses import replace

import numpy as np
import pytest
from cart import recording as cart_recording
from cart import written
from machine_runs import recording, write

from hybrid_mpc import InputError, load_scenario
from hybrid_mpc.cli.progress import Bars, Lines
from hybrid_mpc.engine import Progress
from hybrid_mpc.workflow import run as job
from hybrid_mpc.workflow.benchmark import BenchmarkSettings, _read


class Heard(Progress):
    """Keeps the warnings."""

    def __init__(self):
        self.warnings = []

    def warn(self, text):
        self.warnings.append(text)


def stopped(context):
    raise InputError("stopped here")


def frozen(columns):
    columns["phi_rad"][300:360] = columns["phi_rad"][300]
    return columns


def clipped(columns):
    columns["phi_rad"] = np.minimum(columns["phi_rad"], 0.3)
    return columns


@pytest.fixture
def doubtful(machine, tmp_path):
    """Words of a run on a frozen and a clipped recording, with one parameter to fit, whose bounds are too narrow."""
    text = (machine / "my_machine.py").read_text()
    for whole, part in (("0.3, 3.0)", "0.3, 1.02)"), ("0.0, 0.5)", "0.05, 0.05)")):
        assert whole in text
        text = text.replace(whole, part)
    (tmp_path / "my_machine.py").write_text(text)
    files = [
        write(tmp_path / "monday.csv", frozen(recording(0, 6.0))),
        write(tmp_path / "sunday.csv", clipped(recording(1, 6.0))),
    ]
    data = [word for file in files for word in ("--data", file)]
    return [tmp_path / "my_machine.py", *data, "--out", tmp_path / "out"]


def test_the_terminal_hears_of_doubts_and_of_the_fit_s_warnings(call, doubtful, tmp_path, monkeypatch):
    monkeypatch.setattr(job, "STAGES", (*job.STAGES[:3], replace(job.STAGES[3], compute=stopped)))
    code, told, message = call("run", *doubtful)
    assert (code, "stopped here" in message) == (2, True)
    reading, fitting = told.index("reading the measurements"), told.index("fitting the prior")
    first, second = (
        told.index("warning: monday.csv: column 'phi_rad' repeats"),
        told.index("warning: sunday.csv: column"),
    )
    fit = told.index("warning: fit of the prior: mgl")
    assert reading < first < second < fitting < fit
    kept = {
        name: json.loads((tmp_path / "out" / "checkpoints" / f"{name}.json").read_text())["result"]
        for name in ("data", "prior")
    }
    assert [text.split(":")[0] for text in kept["data"]["warnings"]][:2] == ["monday.csv", "sunday.csv"]
    assert f"warning: fit of the prior: {kept['prior']['fit']['warnings'][0]}" in told


def test_bars_and_lines_print_warnings_as_they_are(capsys):
    for progress in (Bars(console()), Lines()):
        with progress:
            progress.start("reading")
            progress.warn("a.csv: column 'phi' [rad] repeats itself")
            progress.finish("")
        assert "warning: a.csv: column 'phi' [rad] repeats itself\n" in capsys.readouterr().out


def console():
    from rich.console import Console

    return Console(force_terminal=False, width=40)


def test_all_recordings_are_refused_at_once_and_leave_nothing(call, machine, tmp_path):
    wrapped = recording(2)
    wrapped["phi_rad"] = (3.0 * wrapped["time_s"] + np.pi) % (2 * np.pi) - np.pi
    broken = recording(3)
    broken["tau_nm"][7] = np.nan
    files = [
        write(tmp_path / "wrapped.csv", wrapped),
        write(tmp_path / "broken.csv", broken),
        tmp_path / "none.csv",
    ]
    words = [word for file in files for word in ("--data", file)]
    code, _, message = call("run", machine / "my_machine.py", *words, "--out", tmp_path / "out")
    assert code == 2
    for part in (
        "3 problems",
        "wrapped.csv: column 'phi_rad' jumps",
        "periodic=True",
        "broken.csv: row 9",
        "none.csv: file not found",
    ):
        assert part in message
    assert not (tmp_path / "out").exists()


def test_inputs_and_outputs_that_do_nothing_are_refused_together(call, machine, tmp_path):
    dull = {"time_s": 0.01 * np.arange(1200), "tau_nm": np.full(1200, 0.1), "phi_rad": np.full(1200, 0.2)}
    file = write(tmp_path / "dull.csv", dull)
    code, _, message = call("run", machine / "my_machine.py", "--data", file, "--out", tmp_path / "out")
    assert code == 2
    for part in ("2 problems:", "HM-DATA-021", "HM-DATA-022"):
        assert part in message


def test_the_benchmark_tells_doubts_of_all_its_files_and_refuses_all_bad_ones(tmp_path):
    file, train, test = written(tmp_path)
    scenario = load_scenario(str(file))
    for path in (train, test):
        table = np.genfromtxt(path, delimiter=",", names=True)
        table["s"][100:140] = table["s"][100]
        write(path, {name: table[name] for name in ("t", "u", "s")})
    data, tests, doubts = _read(BenchmarkSettings(str(file), (train,), (test,)), scenario)
    assert data is not None
    assert set(tests) == {"test.csv"}
    assert [text.split(" repeats")[0] for text in doubts] == ["train.csv: column 's'", "test.csv: column 's'"]
    bad = cart_recording(tmp_path / "bad.csv", seed=2)
    bad.write_text(bad.read_text().replace("u,s", "u,x"))
    worse = tmp_path / "worse.csv"
    worse.write_text("")
    with pytest.raises(InputError, match="HM-DATA-085") as caught:
        _read(BenchmarkSettings(str(file), (bad,), (test, worse)), scenario)
    assert [
        word in text for word, text in zip(("bad.csv", "worse.csv"), caught.value.problems, strict=True)
    ] == [True, True]


def test_what_a_reproduction_reads_is_told(measured_with_findings, tmp_path):
    from scenarios.paper.run import Work, record_stage
    from scenarios.paper.settings import ReproductionSettings, experiment_of

    scenario = load_scenario(measured_with_findings)
    settings = ReproductionSettings(measured_with_findings)
    experiment, heard = experiment_of(scenario), Heard()
    work = Work(settings, scenario, experiment, settings.effort(experiment), tmp_path, heard, 0)
    record_stage(work)
    assert [text.split(" repeats")[0] for text in heard.warnings] == ["mine.csv: column 'phi_rad'"]
    assert work.notes()[0] == heard.warnings[0]
    assert {t.role for t in work.recorded["exact"]} == {"train", "valid", "test"}


@pytest.fixture
def measured_with_findings(tmp_path):
    """An experiment of a user's own on a recording with a frozen stretch."""
    write(tmp_path / "mine.csv", frozen(recording(0)))
    path = tmp_path / "experiment.py"
    path.write_text(f"""
from dataclasses import replace
from pathlib import Path
from hybrid_mpc import DataSpec
from hybrid_mpc import load_trajectories
from scenarios.pendulum import scenario
spec = DataSpec("time_s", ("tau_nm",), ("phi_rad",), dt=0.02, max_gap=0.05, smoothing=0.2, warm_up=0.2)


def runs(data_set, seed, folder):
    files = [Path({str(tmp_path)!r}) / "mine.csv"]
    return load_trajectories(files, scenario.prior(), spec)


scenario = replace(scenario, experiment=replace(scenario.experiment, runs=runs))
""")
    return str(path)
