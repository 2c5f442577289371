"""A run of a study is a loop of ``hybrid-mpc control``; what a study adds to it acts."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from hybrid_mpc import (
    Bench,
    FaultKind,
    InputError,
    Provenance,
    RandomFaults,
    Study,
    dry_run,
    load_scenario,
    run_study,
    set_process_noise,
)
from hybrid_mpc.compare.loops import run_loops
from hybrid_mpc.compare.study_run import TIMING, load_inputs, load_models
from hybrid_mpc.engine import Progress
from hybrid_mpc.kit.parts import read_description, write_description

GOLF = load_scenario("golf_robot")
SIGMA = dict.fromkeys(("prior", "hybrid"), (1e-3, 1e-1))
SHORT = 0.3  # s: 15 periods


def row_of(folder, **fields):
    """The row of a study of one short run."""
    fields = {"tasks": ["track_sine"], "controllers": ["hybrid"], "seeds": 1, "duration": SHORT, **fields}
    study = Study("golf_robot", folder, **fields)
    run, _ = load_inputs(study)
    (config,) = study.runs()
    return run(config)


def untimed(row):
    return {key: value for key, value in row.items() if not key.startswith(TIMING)}


def test_a_run_is_a_loop_on_a_bench(run_folder):
    study = Study(
        "golf_robot", run_folder, tasks=["stroke_4"], controllers=["hybrid_observer"], solvers=["rti", "sqp"],
        seeds=1, duration=SHORT,
    )  # fmt: skip
    run, _ = load_inputs(study)
    specs = list(study.runs())
    alone = run_loops(Bench(GOLF, {"model": load_models(study)["model"].kit}), specs)
    assert [run(spec)["cost"] for spec in specs] == [row.cost for row in alone]  # bit by bit
    assert len(specs) == 2


def test_what_a_study_adds_acts(run_folder):
    usual = row_of(run_folder, duration=0.6)
    assert untimed(row_of(run_folder, duration=0.6)) == pytest.approx(
        untimed(usual), rel=0, abs=0, nan_ok=True
    )
    others = {
        "horizon": row_of(run_folder, duration=0.6, horizons=[10]),
        "plant": row_of(run_folder, duration=0.6, vary={"mu_c": 0.3}),
        "fault": row_of(run_folder, duration=0.6, faults=["plant_friction=2@0.1"]),
        "seed": row_of(run_folder, duration=0.6, seeds=[1]),
    }
    for name, other in others.items():
        assert other["cost"] != usual["cost"], name
        assert np.isfinite(other["cost"]), name
    assert usual["hidden_units"] == 8
    late = RandomFaults([FaultKind("late", length=(0.1, 0.1))], at_once=(1, 1), start=(0.2, 0.2))
    missed = row_of(run_folder, duration=0.6, random_faults=late)
    assert missed["share_MPC"] == pytest.approx(25 / 30)  # 0.1 s of 0.6 s, 20 ms each


def test_monitors(run_folder):
    own, none, energy = (row_of(run_folder, monitors=[m], duration=1.0) for m in ("own", "none", "energy"))
    assert own["cost"] == none["cost"] == energy["cost"]  # monitors only watch
    assert np.isfinite(own["largest_violation_w"])
    assert np.isnan(none["largest_violation_w"])
    assert np.isnan([own["alarm_share"], none["alarm_share"]]).all()  # neither can alarm
    assert energy["alarm_share"] > 0.0
    assert 0.0 < energy["first_alarm_s"] < 1.0


@pytest.mark.full
def test_workers_give_the_bits_of_this_process(run_folder, tmp_path):
    study = Study(
        "golf_robot", run_folder, tasks=["track_sine", "stroke_1.4"], controllers=["prior", "hybrid_observer"],
        vary={"m": 0.2}, draws=2, seeds=1, duration=SHORT,
    )  # fmt: skip
    table = run_study(study, tmp_path / "s", workers=2).table
    run, _ = load_inputs(study)
    for config, row in zip(study.runs(), table.to_dict("records"), strict=True):
        assert row["id"] == config.id
        assert {key: row[key] for key in untimed(run(config))} == pytest.approx(
            untimed(run(config)), rel=0, abs=0, nan_ok=True
        )
    assert table["status"].tolist() == ["done"] * 8
    assert table[f"{TIMING}run_s"].min() > 0


@pytest.mark.full
def test_a_cluster_gives_the_same_bits(run_folder, tmp_path):
    from distributed import Client, LocalCluster

    study = Study(
        "golf_robot", run_folder, tasks=["track_sine", "stroke_1.4"], controllers=["prior", "hybrid_observer"],
        solvers=["rti", "sqp"], vary={"m": 0.2}, draws=2, seeds=1, duration=SHORT,
    )  # fmt: skip
    near = run_study(study, tmp_path / "near", workers=1).table
    moved = tmp_path / "moved"  # the workers do not find the model where the parent did
    shutil.copytree(run_folder, moved)
    away = replace(study, models={"model": moved})
    hidden = []

    class Hide(Progress):
        def start(self, title):
            if title == "running":
                hidden.append(shutil.move(moved / "model", tmp_path / "hidden"))

    with (
        LocalCluster(2, threads_per_worker=2, dashboard_address=None) as local,
        Client(local, set_as_default=False) as client,
    ):
        far = run_study(away, tmp_path / "far", cluster=client, progress=Hide()).table
    assert hidden
    keep = [c for c in near if not c.startswith(TIMING)]
    assert near[keep].set_index("id").sort_index().equals(far[keep].set_index("id").sort_index())


@pytest.mark.full
def test_a_resumed_study_keeps_its_noise(run_folder, tmp_path):
    moved = tmp_path / "run"
    shutil.copytree(run_folder, moved)
    study = Study("golf_robot", moved, tasks=["track_sine"], controllers=["prior"], seeds=2, duration=SHORT)
    first = run_study(study, tmp_path / "s", workers=1)
    again = run_study(study, tmp_path / "s", workers=1, resume=True)
    assert again.note.models["model"].noise == first.note.models["model"].noise
    assert again.table.equals(first.table)
    set_process_noise(moved / "model", SIGMA)  # another one is another model
    with pytest.raises(InputError, match="content of model model differ"):
        run_study(study, tmp_path / "s", workers=1, resume=True)


def test_dry_run_counts_and_times(run_folder):
    study = Study(
        "golf_robot", run_folder, tasks=["track"], controllers=["prior", "hybrid"], horizons=[10], seeds=3
    )
    told = []
    plan = dry_run(study, workers=3, say=told.append)
    assert plan.runs == 12
    assert len(plan.kinds) == 2
    assert len(told) == 4
    # 6 runs of each of two kinds on three workers
    assert plan.seconds == pytest.approx(6 * sum(plan.kinds.values()) / 3)
    assert 0.01 < plan.seconds < 3600


def refused(told, folder, **fields):
    study = Study("golf_robot", folder, **{"seeds": 1, **fields})
    with pytest.raises(InputError, match=told):
        load_inputs(study)


def test_what_does_not_fit_is_refused_before_the_first_run(run_folder, golf_artifact, tmp_path):
    refused(r"parameter.*of RigParameters 'mass'.*HM-RECORDS-011", run_folder, vary={"mass": 0.2})
    refused(r"'plant_fire'.*HM-LOOP-005", run_folder, faults=["plant_fire=1"])
    kinds = [{"target": "plant_fire", "low": 1, "high": 2}]
    refused(r"'plant_fire'.*HM-LOOP-005", run_folder, random_faults={"kinds": kinds, "at_once": [1, 1]})
    refused("HM-KIT-038", tmp_path / "none")
    folder = tmp_path / "model"
    shutil.copytree(golf_artifact, folder)
    note = read_description(folder)
    write_description(folder, replace(note, provenance=Provenance("torque_pendulum")))
    refused(r"torque_pendulum.*golf_robot.*HM-COMPARE-017", folder)
    write_description(folder, note)
    set_process_noise(folder, SIGMA)
    refused(r"energy.*HM-KIT-010", folder, controllers=["hybrid"], monitors=["energy"])
    with pytest.raises(InputError, match=r"plant.*HM-COMPARE-015"):
        load_inputs(Study("torque_pendulum", run_folder, seeds=1))
