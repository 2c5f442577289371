"""The files of a kit: each written by one stage, composed by ``load``; what is missing or stale is named."""

import ast
import shutil
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest

import hybrid_mpc as hm
from hybrid_mpc import InputError, RunSettings, load_scenario
from hybrid_mpc.files import sha256
from hybrid_mpc.kit import parts as files
from hybrid_mpc.kit.artifact import Kit
from hybrid_mpc.kit.parts import (
    MODELS,
    OBSERVER,
    OWNERS,
    PROGRAMS,
    WatchFile,
    read_description,
    read_parts,
    save_loop,
    write_description,
)
from hybrid_mpc.kit.parts import (
    TASKS as TASK_LIST,
)
from hybrid_mpc.kit.promises import Promise, PromiseTable, read_promises
from hybrid_mpc.workflow import run as job
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.stages.export import EXPORT, NOISE, TASKS, ExportResult, NoiseResult, put_noise
from hybrid_mpc.workflow.stages.promises import PROMISES, put_promises
from hybrid_mpc.workflow.stages.watch import WATCH, WatchResult, put_limits

ROOT = Path(__file__).parents[1]
GOLF = load_scenario("golf_robot")
GOLF = replace(GOLF, tasks=tuple(task for task in GOLF.tasks if task.name in ("track_sine", "track_step")))
STEP = next(task.control for task in GOLF.tasks if task.control is not None)
FORCE = hm.ChannelLimit("force of phi", "N m", 0, 4.0, 2.0, (1e-4, 1e-4, 0.0, 1e-4), 2.0)
LIMITS = hm.WatchLimits("energy", 0.02, (FORCE,), (0.01,), (0,), 1.0, 0.1, "by hand", rest_speed=(0.2,))
WATCHED = "watch/hybrid.json"
WRITERS = {
    "export": ("save_artifact", "write_description"), "noise": ("write_observer",), "tasks": ("write_tasks",),
    "watch": ("write_watch",), "promises": ("write_promises",),
}  # fmt: skip
"""Functions that write a kit's files, by the stage that may call them."""
MODULES = {"noise": "export", "tasks": "export"}
"""Module in ``workflow/stages`` of a stage where its name is another one's."""


# a run whose stages take no time: what each writes says what it was made of

KINDS = ("export", "noise", "tasks", "promises", "watch")
VERSIONS = dict.fromkeys(KINDS, 0)
"""Of what a stage reads beside other stages: an edit adds one."""


def scenario(name=""):
    """The golf robot; an edit of its control problem changes what its observer takes for a large load."""
    return replace(GOLF, control=GOLF.control.changed(horizon=GOLF.control.horizon - VERSIONS["tasks"]))


def noise_for(programs_sha256, version):
    return 1e-6 * (1 + int(programs_sha256[:4], 16)) + 10.0 * version


def limit_for(noise, horizon):
    return 1.0 + noise + 1000.0 * horizon


def fake_stages(sources):
    """The kit's stages with their own results and files; the numbers say what they were computed with."""

    def of(context):
        return read_parts(context.out / "model").observer("hybrid")

    def limit(context):
        parts = read_parts(context.out / "model")
        return limit_for(
            context.read(NOISE).process_noise["hybrid_observer"][0], parts.loop.control[""].horizon
        )

    def export(context):
        folder, source = context.out / "model", sources[VERSIONS["export"]]
        shutil.copytree(source / MODELS, folder / MODELS, dirs_exist_ok=True)
        write_description(folder, read_description(source))
        return ExportResult(0.0, 0.0, sha256(folder / PROGRAMS))

    def noise(context):
        sigma = noise_for(context.read(EXPORT).programs_sha256, VERSIONS["noise"])
        return kept(
            put_noise,
            context,
            NoiseResult({"hybrid_observer": (sigma, 1e-2)}, read_parts(context.out / "model").models),
        )

    def watch(context):
        limits = replace(LIMITS, channels=(replace(FORCE, threshold=limit(context)),))
        held = {"hybrid": WatchFile({"energy": limits}, of=of(context))}
        return kept(put_limits, context, WatchResult(held, "energy"))

    def promises(context):
        rows = (Promise("p", "shown", f"{limit(context):g}"),)
        return kept(put_promises, context, PromiseTable(rows, context.kit.identity))

    def kept(put, context, found):
        assert put(context, found) == ""
        return found

    computes = {
        "export": export, "noise": noise, "tasks": TASKS.compute, "promises": promises, "watch": watch,
    }  # fmt: skip

    found = {}
    for stage in (EXPORT, NOISE, TASKS, *LOOPS):

        def reads(context, name=stage.name, looped=stage in LOOPS):
            return {"version": VERSIONS[name], "control problem": VERSIONS["tasks"] * looped}

        needs = tuple(found[need.name] for need in stage.needs if need.name in found)
        found[stage.name] = replace(
            stage, compute=computes[stage.name], reads=stage.reads if stage is TASKS else reads, needs=needs
        )
    return tuple(found.values())


LOOPS = (PROMISES, WATCH)
"""Stages that read the control problem."""


def light_kit(context):
    """The kit without its models, which take longer to load than these stages."""
    folder = context.out / "model"
    found = read_parts(folder)
    return Kit(
        {}, found.watch, found.description.provenance, found.description.model.input_delay, found.loop,
        programs_sha256=found.description.programs_sha256,
        promised=read_promises(folder), lacks=found.lacks,
    )  # fmt: skip


class Killed(BaseException):
    """The process ends."""


@pytest.fixture(scope="module")
def sources(golf_artifact, tmp_path_factory):
    """Two artifacts whose programs differ."""
    folder = tmp_path_factory.mktemp("sources")
    found = [shutil.copytree(golf_artifact, folder / name) for name in ("a", "b")]
    path = found[1] / PROGRAMS
    path.write_text(path.read_text() + "\n")
    write_description(found[1], replace(read_description(found[1]), programs_sha256=sha256(path)))
    return found


@pytest.fixture
def patched(monkeypatch, sources):
    monkeypatch.setattr(job, "STAGES", fake_stages(sources))
    monkeypatch.setattr(job, "load_scenario", scenario)
    monkeypatch.setattr(job, "check_scenario", lambda *given: SimpleNamespace(warnings=()))
    for name in ("check_data", "check_device", "report_so_far"):
        monkeypatch.setattr(job, name, lambda *given: None)
    monkeypatch.setattr(job, "read_results", lambda *given: None)
    monkeypatch.setattr(Context, "kit", property(light_kit))
    yield monkeypatch
    VERSIONS.update(dict.fromkeys(KINDS, 0))


def run(out, *, resume=True, only=(), skip=()):
    job.run(RunSettings("golf_robot"), out, resume=resume, only=only, skip=skip)


def check(folder):
    """All that a kit holds was made for what else it holds; what was not is named."""
    if sha256(folder / PROGRAMS) != read_description(folder).programs_sha256:
        with pytest.raises(InputError, match="stage export"):
            hm.load(folder)
        return
    found = read_parts(folder)
    horizon, noise = None, None
    if TASK_LIST not in found.lacks:
        horizon = found.loop.control[""].horizon
        assert found.loop.control["track_step"] == STEP
    if OBSERVER not in found.lacks:
        noise = found.loop.process_noise["hybrid_observer"][0]
        assert noise in [noise_for(found.description.programs_sha256, version) for version in (0, 1)]
    limit = None if horizon is None or noise is None else limit_for(noise, horizon)
    if WATCHED not in found.lacks and files.WATCH not in found.lacks:
        assert found.watch["hybrid"].limits["energy"].channels[0].threshold == limit
    rows = light_kit(SimpleNamespace(out=folder.parent)).promises
    assert rows[0].verdict == "not promised" or rows[0].evidence == f"{limit:g}"


def killing(patched, place):
    """Have the process end at the first or second file that a kit gets, or before a stage's checkpoint."""
    count, write = [], files._write

    def written(folder, file, content):
        count.append(file)
        if len(count) == place + 1:
            raise Killed
        write(folder, file, content)

    def kept(context, stage, keys, result):
        raise Killed

    if place == "checkpoint":
        patched.setattr(Context, "keep", kept)
    elif place is not None:
        patched.setattr(files, "_write", written)


@pytest.mark.parametrize(
    "place", [None, "checkpoint", *(pytest.param(n, marks=pytest.mark.full) for n in (0, 1))]
)
@pytest.mark.parametrize("edited", KINDS)
def test_any_order_of_stages_leaves_a_right_kit_or_says_what_it_lacks(patched, tmp_path, edited, place):
    """All pairs: what one stage reads is edited, it runs alone and is killed; then another one alone, or all but it."""
    begun = tmp_path / "begun"
    run(begun, resume=False)
    check(begun / "model")
    assert read_parts(begun / "model").lacks == {}
    VERSIONS[edited] = 1
    with pytest.MonkeyPatch.context() as patch:
        killing(patch, place)
        with suppress(Killed, InputError):
            run(begun, only=[edited])
    check(begun / "model")
    for other in KINDS:
        out = shutil.copytree(begun, tmp_path / other)
        with suppress(InputError):  # a stage that it needs is out of date
            run(out, only=[other])
        check(out / "model")
        if other not in ("export", "tasks"):
            run(out, skip=[other])
            check(out / "model")
        run(out)
        check(out / "model")
        assert read_parts(out / "model").lacks == {}
        assert read_parts(out / "model").loop.control[""].horizon == scenario().control.horizon


@pytest.mark.parametrize("skipped", KINDS)
def test_what_was_left_out_is_named_with_its_stage(patched, tmp_path, skipped):
    out = tmp_path / "run"
    if skipped in ("export", "tasks"):
        with pytest.raises(InputError):
            run(out, resume=False, skip=[skipped])
        return
    needing = [stage.name for stage in job.STAGES if NOISE.name in [s.name for s in stage.needs]]
    run(out, resume=False, skip=[skipped])
    lacks = read_parts(out / "model").lacks
    missing = {skipped, *(needing if skipped == "noise" else ())} - {"promises"}
    owners = {file: OWNERS.get(file, "watch") for file in lacks}
    assert set(owners.values()) == missing
    for file, why in lacks.items():
        assert f"stage {owners[file]}" in why


# one stage, one file


def calls_of(path):
    """Names of the functions that a module calls."""
    found = ast.walk(ast.parse(path.read_text()))
    return {node.func.id for node in found if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)}


def test_no_stage_writes_another_stage_s_file():
    """By the source: functions that write a kit's files are called in the module of their stage alone."""
    allowed = {}
    for stage, names in WRITERS.items():
        for name in names:
            allowed.setdefault(name, set()).add(MODULES.get(stage, stage))
    by_hand = {"set_limits", "set_process_noise", "save_artifact", "save_loop"}
    for path in sorted((ROOT / "hybrid_mpc" / "job").rglob("*.py")):
        for name in calls_of(path):
            assert name not in by_hand, f"{path.name} patches: {name}"
            assert path.stem in allowed.get(name, {path.stem}), f"{path.name} calls {name}"
    assert set(OWNERS.values()) == set(WRITERS)


def test_each_stage_writes_its_own_files_once(patched, sources, tmp_path):
    """By what is written: while a stage runs nothing but its own files changes, and a resume changes none."""
    written, now = [], []
    for module in (files, sys.modules["hybrid_mpc.kit.promises"]):
        write = module.write_document
        patched.setattr(
            module,
            "write_document",
            lambda path, value, write=write: (
                written.append((now[-1], Path(path).relative_to(tmp_path / "run" / "model").as_posix())),
                write(path, value),
            ),
        )
    stages = tuple(
        replace(
            stage, compute=lambda context, stage=stage: (now.append(stage.name), stage.compute(context))[1]
        )
        for stage in job.STAGES
    )
    patched.setattr(job, "STAGES", stages)
    run(tmp_path / "run", resume=False)
    assert len({file for _, file in written}) == len(written)
    for stage, file in written:
        place, _, _ = file.partition("/")
        assert OWNERS.get(file, OWNERS.get(f"{place}/*.json")) == stage
    assert {stage for stage, _ in written} == set(KINDS)
    kept = len(written)
    run(tmp_path / "run")
    assert len(written) == kept


# composed by load


@pytest.fixture(scope="module")
def whole(golf_artifact, tmp_path_factory):
    folder = shutil.copytree(golf_artifact, tmp_path_factory.mktemp("kit") / "model")
    save_loop(folder, replace(files.loop_settings(GOLF), process_noise={"hybrid_observer": (1e-4, 1e-2)}))
    hm.set_limits(folder, {"hybrid": [LIMITS]})
    return folder


@pytest.mark.parametrize(
    ("file", "use", "stage"),
    [
        (WATCHED, lambda kit: kit.monitor(), "watch"),
        (OBSERVER, lambda kit: kit.observer(), "noise"),
        (TASK_LIST, lambda kit: kit.controller(), "tasks"),
    ],
)
def test_what_a_folder_lacks_is_named_where_it_is_needed(whole, tmp_path, file, use, stage):
    use(hm.load(whole))
    folder = shutil.copytree(whole, tmp_path / "model")
    (folder / file).unlink()
    kit = hm.load(folder)
    assert list(kit.lacks) == [files.WATCH if file == WATCHED else file]
    with pytest.raises(InputError, match=f"stage {stage}"):
        use(kit)


def test_a_half_written_set_of_tasks_is_missing(whole, tmp_path):
    folder = shutil.copytree(whole, tmp_path / "model")
    path = next((folder / "tasks").glob("*.json"))
    other = replace(
        hm.load(folder).loop, control={"": GOLF.control, path.stem: GOLF.control.changed(horizon=7)}
    )
    save_loop(tmp_path / "other", other)
    shutil.copyfile(tmp_path / "other" / "tasks" / path.name, path)
    kit = hm.load(folder)
    assert "tasks" in kit.lacks[TASK_LIST]
    with pytest.raises(InputError, match=r"stage tasks.*HM-KIT-007"):
        kit.problem(path.stem)
