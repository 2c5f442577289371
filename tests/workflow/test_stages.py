"""Stages run again only where what they read has changed; what they found is read back as it was."""

import re
import shutil
import sys
from dataclasses import dataclass, replace
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

from hybrid_mpc import InputError, RunSettings, load, load_scenario
from hybrid_mpc.cli.run import run
from hybrid_mpc.engine import Progress
from hybrid_mpc.workflow import run as job
from hybrid_mpc.workflow import stage as stages
from hybrid_mpc.workflow.context import Context
from hybrid_mpc.workflow.run import NAMES, STAGES, _as_it_is, _end
from hybrid_mpc.workflow.stage import (
    UNKNOWN,
    Absent,
    Stage,
    Stored,
    bring_up_to_date,
    changed,
    differing,
    read_stage,
    source_of,
    write_stage,
)  # fmt: skip
from hybrid_mpc.workflow.stages import report
from hybrid_mpc.workflow.stages.compare import CONTROL
from hybrid_mpc.workflow.stages.export import EXPORT, NOISE, observed
from hybrid_mpc.workflow.stages.results import read_results


@dataclass(frozen=True)
class Sum:
    """A result with arrays."""

    total: float
    names: tuple[str, ...]
    arrays: dict


def stamps(out):
    return {name: (out / "checkpoints" / f"{name}.json").stat().st_mtime_ns for name in NAMES}


def rerun(before, after):
    return [name for name in NAMES if before[name] != after[name]]


@pytest.fixture
def own(machine, finished, arguments, tmp_path, monkeypatch):
    """A finished run, and its machine's file to edit. Its figures, which others look at, are not drawn again."""
    monkeypatch.setattr(report, "draw_all", lambda context: {})
    source = shutil.copy(machine / "my_machine.py", tmp_path / "my_machine.py")
    out = shutil.copytree(finished, tmp_path / "run")
    return Path(source), out, ["run", source, *arguments[2:], "--out", str(out), "--resume"]


@pytest.mark.parametrize(
    ("pattern", "put", "stages"),
    [
        (r'title="[^"]*"|"My machine[^"]*"', None, ["report"]),
        pytest.param(
            r"q=\(",
            "q=(2.0 * ",
            ["tasks", "control", "on_model", "promises", "watch", "analysis", "report"],
            marks=pytest.mark.full,
        ),
        ("$", "\n# a remark\n", []),
    ],
    ids=["title", "weight", "comment"],
)
def test_an_edit_runs_what_reads_it(own, call, pattern, put, stages):
    source, out, command = own
    text = source.read_text()
    if put is None:  # another title
        put = "\nscenario = dataclasses.replace(scenario, title='Another')\n"
        source.write_text(text + put)
    else:
        found = re.search(pattern, text)
        assert found
        source.write_text(text[: found.start()] + put + text[found.end() :])
    before = stamps(out)
    code, said, message = call(*command)
    assert code == 0, message
    assert rerun(before, stamps(out)) == stages, said
    if "control" in stages:
        assert "stage control runs again: changed: control problem" in said + message
    assert "Another" in (out / "report.html").read_text() or stages != ["report"]


@pytest.fixture
def library(tmp_path, monkeypatch):
    """A copy of the library's sources, which stages now read."""
    copies = {name: tmp_path / name for name in stages._PACKAGES}
    for name, path in stages._PACKAGES.items():
        shutil.copytree(path, copies[name], ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(stages, "_PACKAGES", copies)
    forget()
    yield copies["hybrid_mpc"]
    forget()


def test_a_library_that_draws_otherwise_runs_the_report_alone(own, call, library):
    """A page that an older library made is drawn anew: nothing else reads figures and templates."""
    _, out, command = own
    before = stamps(out)
    code, said, message = call(*command)
    assert (code, rerun(before, stamps(out))) == (0, []), said + message  # where it lies does not count
    for name in ("report/templates/report.css", "plots/style.py", "workflow/stages/figures.py"):
        with (library / name).open("a") as file:
            file.write("\n")
        forget()
        before = stamps(out)
        code, said, message = call(*command)
        assert (code, rerun(before, stamps(out))) == (0, ["report"]), said + message
        assert "stage report runs again: changed: the program" in said + message


def forget():
    """Sources are read once in a process."""
    stages.sources.cache_clear()
    stages._module.cache_clear()


def test_only_and_skip(own, call):
    _, out, command = own
    (out / "checkpoints" / "watch.json").unlink()
    before = {"watch": 0} | {
        name: (out / "checkpoints" / f"{name}.json").stat().st_mtime_ns for name in NAMES if name != "watch"
    }
    code, _, message = call(*command, "--skip", "watch")
    assert code == 0, message
    assert not (out / "checkpoints" / "watch.json").exists()
    assert read_results(out / "results.json").watch == Absent("stage watch was skipped")
    code, _, message = call(*command, "--only", "watch")
    assert code == 0, message
    after = stamps(out)
    assert [name for name in NAMES if after[name] != before[name]] == ["watch", "report"]
    for words, told in (
        (("--skip", "prior"), "HM-WORKFLOW-031"),
        (("--only", "prio"), "did you mean 'prior'"),
    ):
        code, _, message = call(*command, *words)
        assert (code, told in message.replace("\n", " ")) == (2, True)


def test_only_control_after_an_edit_takes_the_edited_problem_and_keeps_the_monitor(own, call):
    source, out, command = own
    before = load(out / "model")
    text = source.read_text()
    source.write_text(text + "\nproblem = scenario.control.changed(q=[2.0 * q for q in scenario.control.q])\n"
                      "scenario = dataclasses.replace(scenario, control=problem)\n")  # fmt: skip
    code, said, message = call(*command, "--only", "control")
    assert code == 0, said + message
    after = load(out / "model")
    np.testing.assert_allclose(after.control.q, 2.0 * np.array(before.control.q))
    assert after.watch == before.watch
    # limits of the input are the observer's too: with them a stage that control needs is out of date
    source.write_text(source.read_text().replace("changed(", "changed(u_max=[0.5], ", 1))
    kept = (out / "model" / "tasks.json").read_bytes()
    code, _, message = call(*command, "--only", "control")
    assert code == 2
    assert "changed: limits of inputs" in message
    assert (out / "model" / "tasks.json").read_bytes() == kept
    code, said, message = call(*command, "--only", "noise", "--only", "control")
    assert code == 0, said + message
    assert load(out / "model").control.u_max == (0.5,)


def test_only_the_first_stages_of_a_new_run(own, call, tmp_path):
    """The fit alone is no error; what cannot run is refused before there is a folder."""
    _, _, command = own
    words = [*command[: command.index("--out")], "--out", str(tmp_path / "new")]
    code, _, message = call(*words, "--only", "watch")
    assert code == 2
    assert "stage data has not run in" in message
    assert "watch needs it" in message
    assert not (tmp_path / "new").exists()
    code, told, message = call(*words, "--only", "data", "--only", "prior")
    assert code == 0, message
    assert "the run stops here" in told
    assert "The run is not finished" in (tmp_path / "new" / "report.html").read_text()
    assert not (tmp_path / "new" / "results.json").exists()


@pytest.mark.full
def test_what_lies_outside_the_stage_s_file_is_missed(own, call):
    _, out, command = own
    (out / "model" / "models" / "programs.json").write_text("{}")
    (out / "report.html").unlink()
    before = stamps(out)
    code, said, message = call(*command)
    assert code == 0, message
    again = rerun(before, stamps(out))
    assert again[0] == "export"
    assert "training" not in again
    assert load(out / "model").watch
    assert (out / "report.html").is_file()
    assert "stage export runs again" in said + message


def test_every_result_is_read_back_as_it_was(finished, tmp_path):
    context = Context(RunSettings("pendulum"), load_scenario("pendulum"), finished)
    for stage in STAGES:
        stored = context.stored(stage)
        again = write_stage(tmp_path / f"{stage.name}.json", stage, stored.keys, stored.result)
        assert again.content == stored.content, stage.name
        assert read_stage(tmp_path / f"{stage.name}.json", stage, "").content == stored.content


def never(context):
    """What must not be computed."""
    raise AssertionError


def one(compute, reads=lambda context: {"seed": context.settings.seed}, **named):
    return Stage("sum", "adding up", Sum, compute, reads, **named)


@pytest.fixture
def context(tmp_path):
    return Context(RunSettings("pendulum"), load_scenario("pendulum"), tmp_path)


def test_a_stage_is_computed_once_and_again_where_what_it_reads_has_changed(context):
    calls = []

    def compute(context):
        calls.append(context.settings.seed)
        return Sum(float(context.settings.seed), ("a",), {"x": np.arange(3.0), "on": np.array([True])})

    stage = one(compute)
    assert bring_up_to_date(context, stage) == ""
    fresh = Context(context.settings, context.scenario, context.out)
    assert bring_up_to_date(fresh, stage) == "up to date"
    found = fresh.read(stage)
    assert (found.total, found.names, found.arrays["on"].dtype) == (0.0, ("a",), np.dtype(bool))
    np.testing.assert_array_equal(found.arrays["x"], np.arange(3.0))
    other = Context(replace(context.settings, seed=5), context.scenario, context.out)
    bring_up_to_date(other, stage)
    unknown = one(compute, reads=lambda context: {"seed": UNKNOWN})
    for _ in range(2):
        bring_up_to_date(Context(context.settings, context.scenario, context.out), unknown)
    assert calls == [0, 5, 0, 0]


def test_another_program_computes_its_stages_again_and_says_why(context, monkeypatch):
    stage, warned = one(lambda context: Sum(1.0, (), {})), []
    bring_up_to_date(context, stage)
    monkeypatch.setattr(stages, "sources", lambda module: "another")
    fresh = Context(context.settings, context.scenario, context.out)
    monkeypatch.setattr(fresh.progress, "warn", warned.append)
    assert bring_up_to_date(fresh, stage) == ""
    assert warned == ["stage sum runs again: changed: the program"]
    again = Context(context.settings, context.scenario, context.out)
    assert bring_up_to_date(again, stage) == "up to date"


@pytest.mark.parametrize(
    ("edited", "again"),
    [
        ("identify/fit.py", {"identify", "choose", "compare", "watch", "report"}),
        ("engine.py", {"identify", "choose", "compare", "watch", "report"}),
        ("compare/loops.py", {"compare", "watch", "report"}),
        ("watch/learn.py", {"watch", "report"}),
        (
            "embedded/c/hmpc_loop.c",
            {"identify", "choose", "compare", "watch", "report"},
        ),  # a kit may run as C
        ("report/templates/report.css", {"report"}),
        ("plots/style.py", {"report"}),
        ("compare/study.py", set()),
        ("cli/run.py", set()),
    ],
)
def test_an_edit_of_a_source_counts_for_the_stages_that_import_it(edited, again, library):
    def of():
        forget()
        return {name: stages.sources(f"hybrid_mpc.workflow.stages.{name}") for name in names}

    names = ("identify", "choose", "compare", "watch", "report")
    before = of()
    with (library / edited).open("a") as file:
        file.write("\n")
    after = of()
    assert {name for name in names if after[name] != before[name]} == again


@dataclass(frozen=True)
class OldSum:
    """What an older version found: no names, and a mean."""

    total: float
    mean: float
    arrays: dict


def test_a_result_of_another_version_is_computed_again_and_that_is_said(context):
    old = Stage("sum", "adding up", OldSum, lambda context: OldSum(1.0, 1.0, {}), one(never).reads)
    bring_up_to_date(context, old)
    told = []
    progress = Progress()
    progress.warn = told.append
    fresh = Context(context.settings, context.scenario, context.out, progress)
    with pytest.raises(InputError, match="HM-RECORDS-003"):
        fresh.read(one(never))
    assert bring_up_to_date(fresh, one(lambda context: Sum(2.0, ("a",), {}))) == ""
    assert fresh.read(one(never)).total == 2.0
    (line,) = told
    assert line.startswith(
        "stage sum runs again: another version wrote its result (sum.json: no field 'mean'"
    )
    again = Context(context.settings, context.scenario, context.out)
    assert bring_up_to_date(again, one(never)) == "up to date"


def test_only_does_not_take_a_result_of_another_version(context, monkeypatch):
    old = Stage("sum", "adding up", OldSum, lambda context: OldSum(1.0, 1.0, {}), one(never).reads)
    bring_up_to_date(context, old)
    fresh = Context(context.settings, context.scenario, context.out)
    monkeypatch.setattr(job, "STAGES", (one(never), replace(one(never), name="later")))
    with pytest.raises(InputError, match=r"sum.*later.*HM-WORKFLOW-032"):
        _end(fresh, ("later",))
    assert _as_it_is(fresh, one(None, optional=True)) == "skipped"


def test_a_stage_reads_others_by_what_they_found(context):
    first, calls = one(lambda context: Sum(1.0, (), {})), []

    def compute(context):
        calls.append(context.read(first).total)
        return Sum(2.0, (), {})

    second = Stage("twice", "twice", Sum, compute, lambda context: {}, (first,))
    for seed in (0, 5):  # the first is computed again, and finds the same
        again = Context(replace(context.settings, seed=seed), context.scenario, context.out)
        bring_up_to_date(again, first)
        bring_up_to_date(again, second)
    assert calls == [1.0]


def test_a_failure_costs_an_optional_stage_alone_and_is_tried_again(context):
    def breaks(context):
        raise ZeroDivisionError(r"by nothing.*HM-WORKFLOW-048")

    stage = one(breaks, optional=True)
    assert "could not run: ZeroDivisionError: by nothing" in bring_up_to_date(context, stage)
    assert "ZeroDivisionError" in (context.out / "checkpoints" / "sum.error.txt").read_text()
    assert context.find(stage).failed
    with pytest.raises(InputError, match=r"by nothing.*HM-WORKFLOW-048"):
        context.read(stage)
    mended = one(lambda context: Sum(1.0, (), {}), optional=True)
    bring_up_to_date(Context(context.settings, context.scenario, context.out), mended)
    assert context.find(one(breaks)) != mended
    with pytest.raises(ZeroDivisionError):
        bring_up_to_date(Context(context.settings, context.scenario, context.out / "b"), one(breaks))
    none = one(lambda context: Absent("the machine has none"), optional=True)
    fresh = Context(context.settings, context.scenario, context.out / "c")
    bring_up_to_date(fresh, none)
    assert (
        bring_up_to_date(Context(context.settings, context.scenario, context.out / "c"), none) == "up to date"
    )


PLANT = '''
"""A plant."""
{extra}
class Plant:
    """Falls."""
    def step(self, state):
        return state - {g}


scenario = {title!r}
'''


def test_source_is_code_without_words(tmp_path):
    def made(**given):
        text = PLANT.format(**{"extra": "", "g": 9.81, "title": "a", **given})
        (tmp_path / "falling.py").write_text(text)
        spec = spec_from_file_location("falling", tmp_path / "falling.py")
        module = module_from_spec(spec)
        sys.modules["falling"] = module
        spec.loader.exec_module(module)
        return source_of(module.Plant)

    same = made()
    assert made(title="b", extra="# a remark") == same
    assert made(g=1.62) != same
    assert made(extra="G = 1") != same
    (tmp_path / "inside.so").write_bytes(b"\xf7\x00")  # a compiled module counts by its bytes
    compiled = sys.modules["inside"] = ModuleType("inside")
    compiled.__file__ = str(tmp_path / "inside.so")
    before = made(extra="import inside")
    (tmp_path / "inside.so").write_bytes(b"\xf7\x01")
    assert before != made(extra="import inside") != same
    sys.modules.pop("inside")
    sys.modules.pop("falling")
    assert source_of(None) is None


def test_loops_read_tasks_by_what_they_say(tmp_path):
    def keys(**changed):
        golf = load_scenario("golf_robot")
        first, *others = golf.tasks
        scenario = replace(golf, tasks=(replace(first, **changed), *others))
        context = Context(RunSettings("golf_robot", budget="full"), scenario, tmp_path)
        context._read.update(
            {EXPORT.name: Stored({}, Absent("none"), "e"), NOISE.name: Stored({}, Absent("none"), "n")}
        )
        return CONTROL.keys(context)

    same, name = keys(), load_scenario("golf_robot").tasks[0].name
    assert all(same.values())  # nothing is unknown
    assert keys(title="Another") == same
    other = keys(reference=lambda t: np.zeros((len(t), 2)))
    assert [key for key in same if same[key] != other[key]] == [f"task {name}"]
    assert keys(figures=eval("lambda result: {}"))[f"task {name}"] == ""


def test_the_help_of_run_names_every_stage():
    names = run.__doc__.partition("The stages are ")[2].partition(". ")[0]
    assert tuple(re.split(r",\s+|\s+and\s+", names)) == NAMES


def test_changes_are_named():
    assert changed({"a": "1", "b": "2"}, {"a": "3", "c": "4"}) == "changed: a, c, b"
    assert changed({}, {"plant": ""}) == "plant may have changed: a change cannot be detected"


def test_the_observer_s_stage_names_what_it_reads():
    """A horizon of its own is no change of weights alone."""
    scenario = load_scenario("golf_robot")
    longer = replace(scenario, control=scenario.control.changed(horizon=scenario.control.horizon + 1))
    before, now = (
        observed(SimpleNamespace(scenario=one, budget=scenario.budgets["quick"]))
        for one in (scenario, longer)
    )
    (label,) = [name for name in now if repr(now[name]) != repr(before[name])]
    assert "horizon" in label
    assert differing({label: "1"}, {label: "2"}) == f"changed: {label}"
