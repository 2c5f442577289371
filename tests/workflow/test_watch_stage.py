"""The main job's stage watch: what limits are learned from, what they are kept as, and what the run says of them."""

import re
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from closed_loop_parts import loop_row

from hybrid_mpc import (
    Bench,
    Fault,
    InputError,
    RunSettings,
    load,
    load_scenario,
    set_process_noise,
    write_csv,
)
from hybrid_mpc.compare import nominal
from hybrid_mpc.compare.loops import read_rows, write_rows
from hybrid_mpc.compare.nominal import broken, nominal_loops, stage_of
from hybrid_mpc.compare.tasks import repeated
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.stages import compare as compare_job
from hybrid_mpc.workflow.stages import watch as stage
from hybrid_mpc.workflow.stages.compare import identity
from hybrid_mpc.workflow.stages.export import NOISE, NoiseResult
from hybrid_mpc.workflow.stages.figures import _watch as watch_figures
from hybrid_mpc.workflow.stages.report import _watch_tables, _watch_words
from hybrid_mpc.workflow.stages.watch import WATCH, watch_stage
from scenarios.golf_robot.rig import Rig

GOLF = load_scenario("golf_robot")
DT = 0.02
SIGMA = {"hybrid_observer": [1e-4, 2e-2]}
MODEL = SimpleNamespace(dt=DT, time_unit=1.0)


def swing(n, seed=0):
    """Columns of a recording of the rig under a sum of sines."""
    rig, rng, t = Rig(), np.random.default_rng(seed), DT * np.arange(n)
    u = 0.2 * np.sin(2 * np.pi * 0.8 * t + seed) + 0.1 * np.sin(2 * np.pi * 0.31 * t)
    state, phi = rig.reset(np.zeros(2), seed), []
    for k in range(n):
        phi.append(rig.measure(state, rng)[0])
        state = rig.step(state, np.array([u[k]]), DT)
    return {"time_s": t, "u_nm": u, "phi_rad": np.array(phi)}


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
    quick = nominal_loops(GOLF, GOLF.budgets["quick"], MODEL)
    # two limits share the rate; the tail reaches 20 blocks' worth beyond the data: 72 and 36 blocks for 1 and 2 an hour
    assert len(quick) * nominal.BLOCKS >= 36
    full = nominal_loops(GOLF, GOLF.budgets["full"], MODEL)
    assert len(full) * nominal.BLOCKS >= 72
    assert {fault.value for loop in quick for fault in loop.faults} == {0.9, 1.1}
    assert any(not loop.faults for loop in quick)
    pendulum = load_scenario("pendulum")  # whose plant has no faults
    assert not any(loop.faults for loop in nominal_loops(pendulum, pendulum.budgets["quick"], MODEL))
    faults = tuple(replace(t, faults=(Fault(0.0, 1.0, "input_gain", 0.5),)) for t in GOLF.tasks)
    with pytest.raises(InputError, match="HM-COMPARE-019"):
        nominal_loops(replace(GOLF, tasks=faults), GOLF.budgets["quick"], MODEL)


def test_a_hybrid_is_watched_by_its_own_model_where_the_prior_is_recommended(golf_artifact):
    kit = load(golf_artifact).with_noise(SIGMA)
    spec = replace(nominal_loops(GOLF, GOLF.budgets["quick"], MODEL)[0], monitor="own", duration=1.0)
    rows = [
        Bench(GOLF, {"model": replace(kit, recommended=name)}).run(spec)[0] for name in ("hybrid", "prior")
    ]
    assert rows[0].cost == rows[1].cost
    assert rows[0].largest_violation == rows[1].largest_violation > 0


def test_a_nominal_loop_keeps_what_a_replay_needs(golf_artifact, monkeypatch):
    monkeypatch.setattr(nominal, "BLOCKS", 1)
    bench = Bench(GOLF, {"model": load(golf_artifact).with_noise(SIGMA)})
    spec = nominal_loops(GOLF, GOLF.budgets["quick"], MODEL)[1]
    assert (spec.task, spec.faults[0].value) == ("track_step", 1.1)
    row, _ = bench.run(spec)
    assert set(row.arrays) == {"t", "y", "u", "w"}
    assert row.arrays["y"].shape == (300, 1)  # a block and the second in which the estimator settles
    assert row.seconds == pytest.approx(6.0)
    assert row.cost < 100.0  # it follows the task; a club that hangs still costs 1e4 x 0.1 rad^2 x 6 s


def test_what_is_tried_depends_on_what_the_plant_knows():
    model = SimpleNamespace(inputs=[SimpleNamespace(name="u")], outputs=[SimpleNamespace(name="phi")])
    names = [one.name for one in broken(GOLF, model, GOLF.control, 3.0)]
    assert names == ["friction", "weak_u", "load", "freeze_phi"]


@pytest.fixture(scope="module")
def context(golf_artifact, tmp_path_factory):
    """A run that was killed after its nominal loops; the recording is split by shares of time."""
    out = tmp_path_factory.mktemp("watch") / "run"
    shutil.copytree(golf_artifact, out / "model")
    (out / "data").mkdir()
    write_csv(out / "data" / "swing.csv", swing(1200))
    scenario = replace(GOLF, data=replace(GOLF.data, windows={}))
    made = Context(RunSettings("golf_robot"), scenario, out)
    set_process_noise(out / "model", SIGMA)
    made.keep(NOISE, {}, NoiseResult({name: tuple(sigma) for name, sigma in SIGMA.items()}))
    for i, spec in enumerate(nominal_loops(scenario, made.budget, MODEL)):
        found = swing(nominal.BLOCKS * 250 + 50, i + 1)
        arrays = {"t": found["time_s"], "y": found["phi_rad"][:, None], "u": found["u_nm"][:, None]}
        arrays["w"] = np.zeros((len(arrays["t"]), 0))
        row = loop_row(spec.task, spec.controller, spec.seed, seconds=46.0, arrays=arrays)
        write_rows(made.path(stage_of(spec)), [row], identity(made, [spec]))
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
        context.keep(WATCH, {}, watch_stage(context))
    return context.read(WATCH)


def test_the_stage_learns_from_what_is_kept_and_fills_the_kit(context, resumed):
    limits = load(context.out / "model").limits("hybrid")
    assert limits == resumed.limits
    assert (limits.kind, limits.false_alarms_per_hour, limits.rated) == ("energy", 2.0, True)
    assert [one.channel for one in limits.channels] == ["force of phi", "power of the free run"]
    assert limits.travel == pytest.approx((3 * np.sqrt(12) * GOLF.sensor_sigma[0],))
    assert re.fullmatch("[0-9a-f]{64}", limits.data_hash)
    spec = nominal_loops(context.scenario, context.budget, MODEL)[0]
    path, of = context.path("nominal/track_sine-500"), identity(context, [spec])
    (row,) = read_rows(path, of)
    other = replace(row, arrays=row.arrays | {"y": row.arrays["y"] + 1})
    write_rows(path, [other], of)
    changed = stage._loop_data(context).data_hash
    write_rows(path, [row], of)
    assert stage._loop_data(context).data_hash == limits.data_hash != changed


def test_the_faulted_loops_are_reported(context, resumed):
    by_name = {row.fault: row for row in resumed.faults}
    assert list(by_name) == ["friction", "weak_u", "load", "freeze_phi"]
    freeze = by_name["freeze_phi"]
    assert freeze.start_s == pytest.approx(3.0)
    # In motion: the estimator predicts three steps of the sensor, 5 mrad, within a few periods at some 1 rad/s.
    assert 0 <= freeze.delay_s < 0.5
    assert freeze.switches[-1].after == "REST"
    assert freeze.diagnosis == "sensor of phi frozen: its readings repeat although motion is predicted"
    assert [row.fault for row in resumed.faults] == list(by_name)
    limits = resumed.limits
    assert (limits.false_alarms_per_hour, limits.hours) == (2.0, pytest.approx(6 * 45 / 3600))
    table, loops, _ = _watch_tables(resumed)
    assert [row[0] for row in table.rows] == [
        "force of phi", "power of the free run", "phi frozen", "all together",
    ]  # fmt: skip
    assert len(loops.rows) == 4
    words = " ".join(_watch_words(resumed))
    assert "6 loops of the simulated machine" in words
    assert "2 false alarms an hour" in words
    assert "too short for 1 an hour" in words
    drawn = {name: caption for _, name, _, caption in watch_figures(context)}
    assert set(drawn) == {"monitor_swing", *(f"fault_{name}" for name in by_name)}
    assert "alarm after" in drawn["fault_freeze_phi"]


@pytest.mark.full
def test_without_a_plant_limits_are_learned_from_recordings(context, resumed, tmp_path):
    out = shutil.copytree(context.out, tmp_path / "run")
    real = Context(context.settings, replace(context.scenario, plant=None), out)
    found = watch_stage(real)
    assert not found.limits.rated  # 24 s
    assert "false alarms an hour need" in found.limits.method
    assert found.sources["energy"].startswith("undisturbed recordings")
    assert (found.faults, found.loops) == (None, ())
