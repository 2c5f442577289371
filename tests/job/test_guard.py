"""The main job's energy guard: what it is learned from, what it is kept as, and what the run says of it."""

import re
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from closed_loop_parts import loop_row

from hybrid_mpc import (
    Bench,
    Calibration,
    Fault,
    InputError,
    RunSettings,
    load,
    load_scenario,
    set_calibration,
    set_process_noise,
    write_csv,
)
from hybrid_mpc.job.context import Context
from hybrid_mpc.job.loops import read_rows, write_rows
from hybrid_mpc.job.stages import compare as compare_job
from hybrid_mpc.job.stages import guard as guard_job
from hybrid_mpc.job.stages.compare import identity
from hybrid_mpc.job.stages.export import NOISE, NoiseResult
from hybrid_mpc.job.stages.figures import guard_figures
from hybrid_mpc.job.stages.guard import GUARD, guard_stage, learned
from hybrid_mpc.job.stages.monitor import MONITOR, MonitorResult
from hybrid_mpc.job.stages.report import guard_tables, guard_words
from hybrid_mpc.job.stages.results import _guard as guard_results
from hybrid_mpc.job.tasks import repeated
from scenarios.golf_robot.rig import Rig

GOLF = load_scenario("golf_robot")
DT, BLOCK = 0.02, 250
SIGMA = {"hybrid_observer": [1e-4, 2e-2]}
MODEL = SimpleNamespace(dt=DT, time_unit=1.0)
CALIBRATION = Calibration(0.5, 0.25, 5.0, 100, 0.1, "by hand", "", 0.4, 0.2)


def numbers(blocks, seed=0):
    """Made-up readings of a machine with one degree of freedom and one input, scattered like a nominal one's."""
    rng, n = np.random.default_rng(seed), blocks * BLOCK
    rows = np.zeros((n, 11))
    rows[:, 5], rows[:, 6] = np.sin(0.05 * np.arange(n)), 0.3 * np.cos(0.05 * np.arange(n))
    rows[:, 3] = 0.1 * rng.normal(size=n)
    rows[:, 7] = 0.02 * rng.normal(size=n)
    rows[:, 8:10], rows[:, 10] = 0.3, 0.5
    return rows


def test_the_rate_is_what_the_data_are_long_enough_for():
    # Two alarms share the rate; the tail reaches 20 blocks' worth beyond the data: 72, 36 and (at least) 30 blocks.
    assert learned([numbers(72)], DT, 1, "ff").false_alarms_per_hour == 1.0
    assert learned([numbers(18, 1), numbers(18, 2)], DT, 1, "ff").false_alarms_per_hour == 2.0
    assert learned([numbers(35)], DT, 1, "ff").false_alarms_per_hour == 5.0
    with pytest.raises(
        InputError, match=r"2\.4 min .* 10 false alarms an hour need 2\.5 min, 1 an hour 6 min"
    ):
        learned([numbers(29)], DT, 1, "ff")


@pytest.mark.parametrize("name", ["track_sine", "track_step"])
def test_a_repeated_task_has_no_jump(name):
    task = next(t for t in GOLF.tasks if t.name == name)
    many = repeated(task, DT, np.array([1.0, 0.6, 0.8]), speeds={0: 1})
    t = np.arange(0.0, many.duration, 1e-3)
    x = many.reference(t)
    slope = np.gradient(x[:, 0], t)
    # Central differences of 1 ms: the third derivative (some 100 rad/s^3) over 6 makes less than 1e-4 rad/s; where
    # the acceleration jumps, half of that jump (some 20 rad/s^2) times the step, 0.01.
    assert np.abs(slope - x[:, 1]).max() < 0.02
    assert np.abs(x[:, 1]).max() <= 1.01 * np.abs(task.reference(t[t < task.duration])[:, 1]).max()
    first, second = (
        np.abs(x[(t >= k * many.duration / 3) & (t < k * many.duration / 3 + task.duration), 0]).max()
        for k in (0, 1)
    )
    assert second == pytest.approx(0.6 * first, rel=1e-9)


def test_loops_are_nominal_and_age_where_the_plant_can():
    quick = guard_job.nominal_loops(GOLF, GOLF.budgets["quick"], MODEL)
    assert len(quick) * guard_job.BLOCKS >= guard_job.blocks_needed(2.0)
    full = guard_job.nominal_loops(GOLF, GOLF.budgets["full"], MODEL)
    assert len(full) * guard_job.BLOCKS >= guard_job.blocks_needed(1.0)
    assert {fault.value for loop in quick for fault in loop.faults} == {0.9, 1.1}
    assert any(not loop.faults for loop in quick)
    pendulum = load_scenario("pendulum")  # whose plant has no faults
    assert not any(
        loop.faults for loop in guard_job.nominal_loops(pendulum, pendulum.budgets["quick"], MODEL)
    )
    broken = tuple(replace(t, faults=(Fault(0.0, 1.0, "input_gain", 0.5),)) for t in GOLF.tasks)
    with pytest.raises(InputError, match="every task brings a fault"):
        guard_job.nominal_loops(replace(GOLF, tasks=broken), GOLF.budgets["quick"], MODEL)


def test_a_hybrid_is_watched_by_its_own_model_where_the_prior_is_recommended(golf_artifact):
    kit = load(golf_artifact).with_noise(SIGMA)
    spec = replace(
        guard_job.nominal_loops(GOLF, GOLF.budgets["quick"], MODEL)[0], monitor="own", duration=1.0
    )
    rows = [
        Bench(GOLF, {"model": replace(kit, recommended=name)}).run(spec)[0] for name in ("hybrid", "prior")
    ]
    assert rows[0].cost == rows[1].cost
    assert rows[0].largest_level == rows[1].largest_level > 0


def test_a_nominal_loop_is_what_the_guard_would_read(golf_artifact, monkeypatch):
    monkeypatch.setattr(guard_job, "BLOCKS", 1)
    bench = Bench(GOLF, {"model": load(golf_artifact).with_noise(SIGMA)})
    spec = guard_job.nominal_loops(GOLF, GOLF.budgets["quick"], MODEL)[1]
    assert (spec.task, spec.faults[0].value) == ("track_step", 1.1)
    row, _ = bench.run(spec)
    assert row.arrays["numbers"].shape == (BLOCK + 50, 11)
    assert np.isfinite(row.arrays["numbers"][50:]).all()  # the first second is no part of the readings
    assert len(row.arrays["y"]) == BLOCK + 50
    assert row.seconds == pytest.approx(6.0)
    assert row.cost < 100.0  # it follows the task; a club that hangs still costs 1e4 x 0.1 rad^2 x 6 s


def test_the_artifact_keeps_the_detector(golf_artifact, tmp_path):
    folder = shutil.copytree(golf_artifact, tmp_path / "model")
    detector = learned([numbers(36)], DT, 1, "hash of the data")
    set_calibration(folder, replace(CALIBRATION, detector=detector))
    found = load(folder).calibration
    assert found.detector == detector
    assert found.detector.data_hash == "hash of the data"
    assert replace(found, detector=None) == CALIBRATION


@pytest.fixture(scope="module")
def context(golf_artifact, tmp_path_factory):
    """A run that was killed after its nominal loops; the recording is split by shares of time."""
    out = tmp_path_factory.mktemp("guard") / "run"
    shutil.copytree(golf_artifact, out / "model")
    rig, rng, n = Rig(), np.random.default_rng(0), 1200
    state, phi, u = rig.reset(np.zeros(2), 0), [], 0.25 * np.sin(2 * np.pi * 0.8 * DT * np.arange(n))
    for k in range(n):
        phi.append(rig.measure(state, rng)[0])
        state = rig.step(state, np.array([u[k]]), DT)
    (out / "data").mkdir()
    columns = {"time_s": DT * np.arange(n), "u_nm": u, "phi_rad": np.array(phi)}
    write_csv(out / "data" / "swing.csv", columns)
    scenario = replace(GOLF, data=replace(GOLF.data, windows={}))
    made = Context(RunSettings("golf_robot"), scenario, out)
    set_process_noise(out / "model", SIGMA)
    made.keep(NOISE, {}, NoiseResult({name: tuple(sigma) for name, sigma in SIGMA.items()}))
    made.keep(MONITOR, {}, MonitorResult(CALIBRATION, ()))
    set_calibration(out / "model", CALIBRATION)
    for i, spec in enumerate(guard_job.nominal_loops(scenario, made.budget, MODEL)):
        read = np.vstack([np.full((50, 11), np.nan), numbers(guard_job.BLOCKS, i)])  # a second settles
        arrays = {"numbers": read, "y": np.full((9, 1), i), "u": np.zeros((9, 1))}
        row = loop_row(spec.task, spec.controller, spec.seed, seconds=46.0, arrays=arrays)
        write_rows(made.path(guard_job.stage_of(spec)), [row], identity(made, [spec]))
    return made


@pytest.fixture(scope="module")
def resumed(context):
    """The stage after the kill: no loop that is kept runs again."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compare_job, "run_specs", lambda *args: pytest.fail(f"runs {args} again"))
        patch.setattr(
            compare_job,
            "run_jobs",
            lambda jobs, *args, **more: jobs and pytest.fail(f"runs {list(jobs)} again"),
        )
        context.keep(GUARD, {}, guard_stage(context))
    return context.read(GUARD)


def test_the_stage_learns_from_what_is_kept_and_fills_the_artifact(context, resumed):
    stored = load(context.out / "model").calibration
    assert stored.detector == resumed.detector
    assert stored.detector.false_alarms_per_hour == 2.0
    assert re.fullmatch("[0-9a-f]{64}", stored.detector.data_hash)
    assert stored.threshold_w == CALIBRATION.threshold_w
    spec = guard_job.nominal_loops(context.scenario, context.budget, MODEL)[0]
    path, of = context.path("guard/track_sine-500"), identity(context, [spec])
    (row,) = read_rows(path, of)
    other = replace(row, arrays=row.arrays | {"y": row.arrays["y"] + 1})
    write_rows(path, [other], of)
    changed = guard_job._from_loops(context, MODEL).data_hash
    write_rows(path, [row], of)
    assert guard_job._from_loops(context, MODEL).data_hash == stored.detector.data_hash != changed


def test_the_faulted_loops_are_reported(context, resumed):
    friction, freeze = resumed.faults
    assert (friction.fault, freeze.fault) == ("friction", "freeze")
    assert freeze.start_s == pytest.approx(3.0)
    # In motion: the estimator predicts three steps of the sensor, 5 mrad, within a few periods at some 1 rad/s.
    assert 0 <= freeze.delay_s < 0.5
    assert freeze.switches[-1].after == "REST"
    assert freeze.diagnosis == "the sensor repeats itself while motion is predicted"
    group = guard_results(context)
    assert [row.fault for row in group.faults] == ["friction", "freeze"]
    tables = guard_tables(group)
    assert "2 false alarms an hour" in tables[0].caption
    assert group.data_hash[:16] in tables[0].caption
    assert "too short for one false alarm an hour" in " ".join(guard_words(group))
    drawn = {name: caption for _, name, _, caption in guard_figures(context)}
    assert set(drawn) == {"guard_friction", "guard_freeze"}
    assert "alarm after" in drawn["guard_freeze"]


@pytest.mark.full
def test_without_a_detector_the_recording_is_shown_and_how_much_is_missing(context, resumed, tmp_path):
    out = shutil.copytree(context.out, tmp_path / "run")
    real = Context(context.settings, replace(context.scenario, plant=None), out)
    real.keep(GUARD, {}, guard_stage(real))
    group = guard_results(real)
    assert group.false_alarms_per_hour is None
    assert "10 false alarms an hour need 2.5 min" in group.reason  # of 24 s
    assert load(out / "model").calibration.detector is None
    assert guard_words(group)[0].startswith("No detector could be learned from undisturbed recordings")
    assert [name for _, name, _, _ in guard_figures(real)] == ["guard_recorded"]
