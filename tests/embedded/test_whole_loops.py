"""A period of the generated C with monitor and guard is one of the Python loop: readings, alarms, modes, inputs."""

import re
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

import embedded_parts as parts
import numpy as np
import pytest
import replay_parts as replays
from embedded_parts import needs_compiler
from replay_parts import Case, Whole, replay

import hybrid_mpc as hm
from hybrid_mpc import (
    CondensedController,
    DelayCompensation,
    ExtendedKalmanFilter,
    Guard,
    InputError,
    Limits,
    Mode,
    SafeController,
    load_scenario,
    make_monitor,
)
from hybrid_mpc.embedded.generate import CORE, make_sources, sources_of
from hybrid_mpc.kit.parts import loop_settings, read_parts, save_loop

sys.path.insert(0, str(Path(__file__).parents[1] / "golden"))
from golden_parts import Parts, faults_of, machine

pytestmark = needs_compiler
TOLERANCE = 1e-9
"""Of an input's range, a state's size, a reading's largest value. Sums of another order: they differed by 1e-12."""


def golden(name, loop, periods=300, seed=0, **changes):
    """A stored loop of a stored machine."""
    m = machine(name)
    given = m.data["loops"][loop]
    problem = given["problem"]
    estimator, safe, monitor, guard = Parts(m, problem, given["guard"]).made
    case = Case(
        estimator, safe, monitor, guard, load_scenario(m.name).plant(), m.reference(problem), given["x0"], periods,
        m.weight(problem), faults_of(given), seed,
    )  # fmt: skip
    return replace(case, **changes)


def prior_takes_over(periods=300):
    """The golf robot, heavier for a while: the fitted prior's own MPC and observer take over, within limits."""
    m = machine("golf_robot")
    prior, noise = m.models["prior"], m.data["observer"]
    estimator = ExtendedKalmanFilter(
        prior, sigma_y=noise["sigma_y"], sigma_x=noise["modes"][0]["sigma_x"], sigma_x0=noise["sigma_x0"],
        sigma_d=noise["modes"][0]["sigma_d"], sigma_d0=noise["sigma_d0"],
    )  # fmt: skip
    backup = SafeController(CondensedController(prior, m.problem("track")), prior, safe_input=[0.0])
    guard = Guard(
        backup=backup, backup_estimator=estimator, limits=Limits([-0.4], [0.4]), dwell=0.3, quiet=0.4
    )
    return golden("golf_robot", "heavy", periods, guard=guard)


@cache
def tanks():
    """The tanks' case; its limits are learned once."""
    return replays.tanks_case(400)


CASES = {
    "golf robot, heavier": (lambda: golden("golf_robot", "heavy", 250), {"NORMAL", "BACKUP"}),
    "golf robot, frozen": (lambda: golden("golf_robot", "frozen"), {"NORMAL", "REST", "BACKUP"}),
    "golf robot, prior takes over": (prior_takes_over, {"NORMAL", "BACKUP"}),
    "disk, weak": (lambda: golden("unbalanced_disk", "weak"), {"NORMAL", "LIMITED", "REST"}),
    "arm": (lambda: replays.arm_case(400), {"NORMAL", "LIMITED", "REST"}),
    "tanks": (tanks, {"NORMAL", "FALLBACK", "REST"}),
    "heaters": (lambda: replays.heaters_case(400), {"NORMAL", "LIMITED", "REST"}),
}
QUICK = ("arm", "tanks")


@pytest.mark.parametrize(
    "name", [n if n in QUICK else pytest.param(n, marks=pytest.mark.full) for n in CASES]
)
def test_a_loop_with_faults_replayed(name, tmp_path):
    """The same samples and plans: the same readings, alarms, modes, sources and inputs in every period."""
    make, modes = CASES[name]
    case = make()
    told = replay(Whole(tmp_path, case), case)
    assert set(told.modes) == modes
    assert told.alarms > 20
    assert told.input < TOLERANCE
    assert told.estimate < TOLERANCE
    assert told.reading < TOLERANCE


def test_a_loop_of_its_own_plans(tmp_path):
    """C that goes on from its own plans, told which inputs acted: nothing adds up."""
    case = tanks()
    told = replay(Whole(tmp_path, case), case, own=True)
    assert told.alarms > 20
    assert told.input < TOLERANCE
    assert told.estimate < TOLERANCE
    assert told.reading < TOLERANCE


def guarded(name):
    """A machine of the other tests with a monitor and a guard that goes through every mode."""
    if name == "arm":
        case = replays.arm_case(100)
        return replace(case, guard=Guard(Mode.FALLBACK, Mode.REST, dwell=0.1, quiet=0.2))
    case = replays.tanks_case(100) if name == "tanks" else golden("golf_robot", "heavy", 10)
    return case


def test_what_was_not_watched_is_watched_by_the_next_step(tmp_path):
    """Without hmpc_finish the next hmpc_step does its work."""
    case = tanks()
    whole = Whole(tmp_path, case)
    goal = parts.goal(case.reference(np.zeros(1)))
    rng, found = np.random.default_rng(0), []
    for finishes in (True, False):
        rng = np.random.default_rng(0)
        inputs = []
        for k in range(60):
            y = whole.model.x0[1:] + 1e-3 * rng.standard_normal(1) if k % 30 < 20 else np.full(1, np.nan)
            whole.call("hmpc_step" if k else "hmpc_start", y, whole.model.w, None, goal)
            if finishes:
                whole.call("hmpc_finish", goal)
            inputs.append((float(whole.view["u"][0]), int(whole.view["guard_mode"])))
        found.append(inputs)
    assert found[0] == found[1]
    assert len({mode for _, mode in found[0]}) > 1


@pytest.mark.full
@pytest.mark.parametrize("name", ["arm", "tanks"])
def test_rubbish_leaves_inputs_within_their_limits(name, tmp_path):
    survives(guarded(name), tmp_path, 1500)


@pytest.mark.full
def test_rubbish_with_a_backup(tmp_path):
    survives(guarded("golf"), tmp_path, 3000)


def survives(case, folder, periods):
    """NaN, infinities and 1e308 under the sanitizers: inputs stay within limits, and modes change."""
    from test_export import RUBBISH, SANITIZERS

    found = parts.write(folder, case)
    text = RUBBISH.replace('"hmpc_math.h"', '"hmpc_math.h"\n#include "hmpc_tables.h"')
    text = text.replace("    solved += ", "    seen |= 1 << (int)s.guard.mode;\n    solved += ")
    text = text.replace("  long periods = 0;", "  long periods = 0;\n  int seen = 0;")
    text = text.replace('printf("%d %d\\n", outside, solved)', 'printf("%d %d %d\\n", outside, solved, seen)')
    (folder / "rubbish.c").write_text(text)
    words = ["cc", "-std=c11", *SANITIZERS, *sources_of(found), "rubbish.c", "-lm", "-o", "rubbish"]
    made = subprocess.run(words, cwd=folder, capture_output=True, text=True, check=False)
    if made.returncode and "sanitize" in made.stderr:
        pytest.skip("no sanitizers")
    assert made.returncode == 0, made.stderr
    done = subprocess.run([folder / "rubbish", str(periods)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr[-3000:]
    outside, solved, seen = map(int, done.stdout.split())
    assert outside == 0
    assert 0 < solved < periods
    assert seen.bit_count() > 1


WATCHED = {"arm": lambda: replays.arm_case(60), "tanks": tanks}


@pytest.mark.parametrize(
    "single", [False, pytest.param(True, marks=pytest.mark.full)], ids=["double", "float"]
)
@pytest.mark.parametrize(
    "name", [n if n == "tanks" else pytest.param(n, marks=pytest.mark.full) for n in WATCHED]
)
def test_vectors_with_readings_and_no_warning(name, single, tmp_path):
    """The test program of the folder compares readings too; a changed one is noticed."""
    from test_export import STRICT

    found = parts.write(tmp_path, WATCHED[name](), single=single)
    strict, sources = ["cc", "-O2", *STRICT], sources_of(found)
    subprocess.run([*strict, "-c", *sources], cwd=tmp_path, check=True)
    objects = [str(Path(name).with_suffix(".o")) for name in sources]
    words = [*strict, *objects, "hmpc_test.c", "-lm", "-o", "test"]
    subprocess.run(words, cwd=tmp_path, check=True)
    assert subprocess.run([tmp_path / "test"], capture_output=True, check=False).returncode == 0
    text = (tmp_path / "hmpc_vectors.h").read_text()
    table = re.search(r"vector_reading\[.*?\] = (\{.*?\});", text, re.S)
    last = re.findall(r"R\([^()]*\)", table[1])[-1]  # of the last period
    changed = (
        table[0][: table[0].rindex(last)] + f"{last} + R(1.0)" + table[0][table[0].rindex(last) + len(last) :]
    )
    (tmp_path / "hmpc_vectors.h").write_text(text.replace(table[0], changed))
    subprocess.run(words, cwd=tmp_path, check=True)
    assert subprocess.run([tmp_path / "test"], capture_output=True, check=False).returncode == 1


@pytest.mark.full
@pytest.mark.skipif(shutil.which("cppcheck") is None, reason="there is no cppcheck")
@pytest.mark.parametrize("name", [*WATCHED, "golf robot"])
def test_cppcheck_finds_nothing(name, tmp_path):
    """In the monitor, the loop and, of the golf robot, the backup's own files."""
    case = WATCHED[name]() if name in WATCHED else golden("golf_robot", "heavy", 10)
    found = parts.write(tmp_path, case)
    names = [n for n in sources_of(found) if n not in CORE and "qp" not in n]
    done = subprocess.run(
        ["cppcheck", "--enable=warning,style,performance,portability", "--inconclusive", "--std=c11", "--quiet",
         "--suppress=moduloofone", "--suppress=knownConditionTrueFalse", "--error-exitcode=1", *names],
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


def refused(case, match, **changes):
    case = replace(case, **changes)
    controller = case.safe.controller
    with pytest.raises(InputError, match=match):
        make_sources(
            controller.model, controller.ocp, estimator=case.estimator, fallback=case.safe.fallback,
            safe_input=case.safe.safe_input, monitor=case.monitor, guard=case.guard,
        )  # fmt: skip


def test_what_has_no_c_is_refused_by_name_all_at_once():
    case = replays.arm_case(10)
    model, plain = case.safe.controller.model, replace(case, guard=None)
    refused(plain, "HM-EMBEDDED-011", monitor=object())
    refused(plain, "HM-EMBEDDED-011", estimator=None)
    other = make_monitor(parts.online_models.pendulum_model())
    refused(plain, "HM-EMBEDDED-011", monitor=other)
    refused(case, "HM-EMBEDDED-011", monitor=None)
    bare = SafeController(case.safe.controller, model)
    both = "HM-EMBEDDED-011"
    twice = CondensedController(model, case.safe.controller.ocp, iterations=2)
    guard = Guard(backup=twice, backup_estimator=DelayCompensation(case.estimator))
    refused(case, both, safe=bare, guard=guard)


@pytest.mark.full
def test_a_kits_monitor_and_guard(noisy_artifact, tmp_path, call):
    """Of a run's folder: its monitor by default, its guard where it is asked for."""
    run = shutil.copytree(noisy_artifact, tmp_path / "model")
    golf = load_scenario("golf_robot")
    save_loop(run, loop_settings(golf, read_parts(run).loop.process_noise))
    code, _, err = call("export", "c", run, "--guard", "--out", tmp_path / "early")
    assert code == 2
    assert "no limits of energy" in err
    hm.set_limits(run, {"hybrid": [machine("golf_robot").limits]})
    sizes = {}
    for words in ((), ("--no-monitor",), ("--guard",), ("--adapt",)):
        folder = tmp_path / "-".join(["c", *words])
        code, _, err = call("export", "c", run, "--out", folder, *words)
        assert code == 0, err
        text = (folder / "hmpc_config.h").read_text()
        names = ("MONITOR", "GUARD", "ON_MODEL", "BACKUP")
        sizes[words] = [
            int(found[1]) if (found := re.search(rf"HMPC_{n} (\d+)", text)) else None for n in names
        ]
    assert sizes == {
        (): [1, 0, None, 0], ("--no-monitor",): [0, 0, None, 0], ("--guard",): [1, 1, int(Mode.NORMAL), 0],
        ("--adapt",): [1, 1, int(Mode.BACKUP), 1],
    }  # fmt: skip
    told = (folder / "README.md").read_text()
    assert "`hmpb_state backup`" in told
    done = subprocess.run(
        ["make", "-s", "-C", folder, "CFLAGS=-O1", "test"], capture_output=True, check=False
    )
    assert done.returncode == 0, done.stderr
    kit = hm.load(run)
    with pytest.raises(InputError, match="no guard 'both'"):
        hm.generate_controller(kit, tmp_path / "none", guard="both")
    with pytest.raises(InputError, match="HM-KIT-025"):
        hm.generate_controller(kit, tmp_path / "none", guard="rest", monitor=False)


def test_a_guard_counts_whole_periods():
    """Times that are no whole number of periods end with the first period that is not earlier, as Python's do."""
    case = replays.arm_case(10)
    guard = Guard(Mode.FALLBACK, Mode.NORMAL, dwell=0.05, quiet=0.06, patience=0.0)
    found = make_sources(
        case.safe.controller.model, case.safe.controller.ocp, estimator=case.estimator, fallback=case.safe.fallback,
        monitor=case.monitor, guard=guard,
    )  # fmt: skip
    assert [found.sizes[name] for name in ("DWELL", "QUIET", "PATIENCE")] == [3, 3, 0]
