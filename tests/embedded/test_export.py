"""The folder of C: compiles without a warning, replays its vectors, survives rubbish; what has no C is refused."""

import dataclasses
import errno
import json
import re
import shutil
import subprocess
import sys
import warnings

import casadi as ca
import embedded_parts as parts
import numpy as np
import pytest
from embedded_parts import needs_compiler
from online_models import levitated_ball

import hybrid_mpc as hm
import nn_export.files
from hybrid_mpc import OCP, ChannelLimit, CondensedController, InputError, WatchLimits, set_limits
from hybrid_mpc.embedded import export
from hybrid_mpc.embedded.export import OTHERS, TOLERANCE
from hybrid_mpc.embedded.generate import GENERATED, HEADERS, SOURCES, _config, make_sources
from hybrid_mpc.embedded.scalar import c_function, comment, scalar_code
from hybrid_mpc.embedded.watch import Watched
from hybrid_mpc.errors import StorageError
from hybrid_mpc.files import write_document
from hybrid_mpc.identify.prior_model import model_info, prior_programs
from hybrid_mpc.kit.assembly import make_controller
from hybrid_mpc.kit.parts import KIT, TASKS, loop_settings, read_parts, save_loop

STRICT = [
    "-std=c11",
    "-Wall",
    "-Wextra",
    "-Wconversion",
    "-Wdouble-promotion",
    "-Werror",
    "-ffp-contract=off",
]
SANITIZERS = ["-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-ffp-contract=off"]
MACHINES = {
    "coupled": parts.coupled, "tanks": parts.tanks, "delayed": parts.delayed, "heaters": parts.heaters,
    "bounded": parts.bounded, "band": parts.band, "cart": lambda: parts.cart([AWAY]),
    "curved": parts.curved, "priced": parts.priced, "priced outputs": parts.priced_outputs, "spare": parts.spare,
    "circle": parts.circle,
    "ways": lambda: several(*parts.ways_round()),
}  # fmt: skip


def several(model, ocp):
    """With two first plans beside the usual one."""
    return model, ocp.changed(starts=[np.full((ocp.horizon, 2), u) for u in (0.5, -0.5)])


AWAY = hm.HardBound("x", [-0.4, -1.0], [0.4, 1.0])
RUBBISH = """
#include <stdio.h>
#include "hmpc_math.h"
static hmpc_state s;
static uint32_t seed = 1;
static uint32_t draw(void) { seed = seed * 1664525u + 1013904223u; return seed >> 8; }
static real rubbish(real usual) {
  const real odd[] = {R(NAN), R(INFINITY), -R(INFINITY), HMPC_HUGE, R(-1e30), R(1e-30), R(0.0), R(1e6)};
  const uint32_t which = draw() % 24;
  return which < 8 ? odd[which] : usual * R(draw() % 1000) / R(500.0);
}
int main(int count, char **words) {
  real y[HMPC_NY], w[HMPC_DIM(HMPC_NW)], x[(HMPC_N + 1) * (HMPC_NX + HMPC_NY + HMPC_NP)], u[HMPC_NU];
  real weight[(HMPC_N + 1) * HMPC_NX];
  long periods = 0;
  int outside = 0, solved = 0;
  (void)count;
  sscanf(words[1], "%ld", &periods);
  for (long k = 0; k < periods; ++k) {
    for (int i = 0; i < HMPC_NY; ++i) y[i] = k % 50 < 25 ? R(0.1) : rubbish(R(0.3));
    for (int i = 0; i < HMPC_DIM(HMPC_NW); ++i) w[i] = rubbish(R(1e-4));
    for (int i = 0; i < (HMPC_N + 1) * (HMPC_NX + HMPC_NY + HMPC_NP); ++i)
      x[i] = k % 50 < 25 ? R(0.1) : rubbish(R(0.3));
    for (int i = 0; i < (HMPC_N + 1) * HMPC_NX; ++i) weight[i] = rubbish(R(1.0));
    for (int i = 0; i < HMPC_NU; ++i) u[i] = rubbish(s.u[i]);
    const real low[HMPC_NU] = {R(-0.1)}, high[HMPC_NU] = {R(0.1)};
    const hmpc_goal goal = {.x = x, .y = x, .p = k % 13 ? x : (real *)0, .rows = k % 3 ? 1 : HMPC_N + 1,
                            .weight = k % 11 ? (real *)0 : weight,
                            .u_min = k % 7 ? (real *)0 : low, .u_max = k % 7 ? (real *)0 : high,
                            .w = k % 10 ? (real *)0 : x, .w_rows = k % 4 ? HMPC_N : 1};
    if (k % 400 == 0) hmpc_start(&s, y, w, k % 800 ? u : (real *)0, &goal);
    else hmpc_step(&s, y, k % 2 ? w : (real *)0, k % 9 ? (real *)0 : u, &goal);
    if (k % 3) hmpc_finish(&s, k % 5 ? &goal : (hmpc_goal *)0);
    solved += s.status == HMPC_SOLVED;
    for (int i = 0; i < HMPC_NU; ++i) outside += !(s.u[i] >= u_min[i] && s.u[i] <= u_max[i]);
  }
  printf("%d %d\\n", outside, solved);
  return outside != 0;
}
"""


def written(folder, name, **options):
    model, ocp = MACHINES[name]()
    parts.export.write_controller(
        folder,
        model,
        ocp,
        estimator=parts.filters_of(model, ocp),
        fallback=model,
        safe_input=model.u0,
        **options,
    )
    return folder


@pytest.fixture(
    scope="module",
    params=["coupled", *(pytest.param(n, marks=pytest.mark.full) for n in MACHINES if n != "coupled")],
)
def folder(request, tmp_path_factory):
    return written(tmp_path_factory.mktemp(request.param) / "c", request.param)


def built(folder, *words, main="hmpc_test.c", out="test"):
    done = subprocess.run(
        ["cc", *words, *SOURCES, main, "-lm", "-o", out],
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return folder / out


@needs_compiler
def test_vectors_of_the_python_controller_and_no_warning(folder):
    program = built(folder, "-O2", *STRICT)
    done = subprocess.run([program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert {p.name for p in folder.iterdir()} == {
        *SOURCES, *HEADERS, *GENERATED, *OTHERS, "hmpc_vectors.h", "README.md", "test"
    }  # fmt: skip


@pytest.mark.full
@needs_compiler
@pytest.mark.parametrize("name", [n for n in MACHINES if n not in ("bounded", "band", "cart", "circle")])
def test_single_precision(tmp_path, name):
    """No warning either, and inputs within the tolerance that the README states."""
    program = built(written(tmp_path, name, single=True), "-O2", *STRICT)
    assert subprocess.run([program], check=False).returncode == 0
    assert f"agree with Python's to {TOLERANCE[True]} of their range" in (tmp_path / "README.md").read_text()


@pytest.mark.full
@pytest.mark.skipif(shutil.which("cppcheck") is None, reason="there is no cppcheck")
def test_cppcheck_finds_nothing(folder):
    """As the page says. Sizes are constants: ``% 1`` for one input, a comparison with a number of rows that is zero."""
    done = subprocess.run(
        ["cppcheck", "--enable=warning,style,performance,portability", "--inconclusive", "--std=c11", "--quiet",
         "--suppress=moduloofone", "--suppress=knownConditionTrueFalse", "--error-exitcode=1", *SOURCES],
        cwd=folder, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


@needs_compiler
def test_changed_vectors_are_noticed(folder, tmp_path):
    changed = shutil.copytree(folder, tmp_path / "c")
    text = (changed / "hmpc_vectors.h").read_text()
    found = re.search(r"(vector_u\[\d+\]\[\d+\] = \{\s*\{R\()([^)]+)", text)
    moved = f"{found[1]}{float(found[2]) * 1.0001 + 1e-12!r}"
    (changed / "hmpc_vectors.h").write_text(text[: found.start()] + moved + text[found.end() :])
    assert subprocess.run([built(changed, "-O0")], capture_output=True, check=False).returncode == 1


def rubbish(folder, periods):
    (folder / "rubbish.c").write_text(
        RUBBISH.replace('"hmpc_math.h"', '"hmpc_math.h"\n#include "hmpc_tables.h"')
    )
    try:
        program = built(folder, "-std=c11", *SANITIZERS, main="rubbish.c", out="rubbish")
    except AssertionError as error:
        pytest.skip(f"no sanitizers: {str(error)[-200:]}")
    done = subprocess.run([program, str(periods)], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr[-3000:]
    outside, solved = map(int, done.stdout.split())
    assert outside == 0
    assert periods / 20 < solved < periods  # it saw good times and bad


@pytest.mark.full
@needs_compiler
def test_rubbish(folder, tmp_path):
    rubbish(shutil.copytree(folder, tmp_path / "c"), 1500)


@needs_compiler
@pytest.mark.full
def test_rubbish_for_long(folder, tmp_path):
    short = (
        "OUTPUT_COST 1" in (folder / "hmpc_config.h").read_text()
    )  # it searches from everywhere in bad times
    rubbish(shutil.copytree(folder, tmp_path / "c"), 4_000 if short else 12_000)


def refused(model, ocp, match, **options):
    with pytest.raises(InputError, match=match):
        make_sources(model, ocp, **options)


def test_what_has_no_c_is_refused_by_name_all_at_once():
    model, ocp = parts.cart([AWAY])
    delayed = hm.DelayCompensation(parts.filters_of(model, ocp), input_delay=1)
    refused(model, ocp, "HM-EMBEDDED-011", single=True, estimator=delayed)
    x, table = ca.MX.sym("x"), ca.interpolant("table", "linear", [[0.0, 1.0, 2.0]], [0.0, 1.0, 4.0])
    read = ca.Function("y", model.output.mx_in(), [table(model.output.mx_in()[0][0])])
    with pytest.raises(InputError, match=r"OP_CALL.*HM-EMBEDDED-009"):
        make_sources(dataclasses.replace(model, output=read), ocp, estimator=parts.filters_of(model, ocp))
    many = ca.Function("many", [x], [sum(ca.sin(k * x) for k in range(1, 20_000))]).expand()
    s = ca.SX.sym("s")
    with pytest.raises(InputError, match=r"30000.*HM-EMBEDDED-008"):
        c_function("f", ["const real *x", "real *y"], {"x": s}, [("y[0]", many(s))])


def test_an_operation_without_c_is_named():
    m = ca.MX.sym("m", 2, 2)
    solved = ca.solve(m, ca.DM([1.0, 2.0]), "lapacklu")
    with pytest.raises(InputError, match=r"its step: .*HM-EMBEDDED-006"):
        scalar_code("its step", ca.Function("step", [m], [solved]))
    x = ca.SX.sym("x")
    with pytest.raises(InputError, match=r"OP_ERFINV.*HM-EMBEDDED-009"):
        c_function("f", ["const real *x", "real *y"], {"x": x}, [("y[0]", ca.erfinv(x))])


@needs_compiler
def test_every_operation_gives_what_casadi_gives(folder, tmp_path):
    """All functions with a form in C, at random points."""
    x = ca.SX.sym("x", 3)
    a, b, c = x[0], x[1], x[2]
    one = ca.if_else(a > b, ca.sin(a), ca.cos(b)) + ca.fmin(a, c) * ca.fmax(b, c) - ca.sign(a) * ca.fabs(b)
    values = [
        one, ca.tanh(3 * a), ca.exp(a - b), ca.log(1 + a * a), ca.sqrt(ca.fabs(c)), ca.tan(0.3 * a), a**2, 2 * b,
        1 / (2 + a * a), ca.logic_and(a > 0, b > 0), ca.logic_or(a > 0, b > 0), ca.logic_not(a > 0), a / (b**2 + 1),
        ca.atan2(a, b), ca.fabs(a) ** 1.7, ca.sinh(a), ca.cosh(a), ca.floor(3 * a), ca.hypot(a, b), a == b, a != b,
        ca.asin(0.1 * a), ca.acos(0.1 * a), ca.atan(a), ca.erf(a), ca.exp(-300 * a * a), ca.sin(1e3 * a),
    ]  # fmt: skip
    f = ca.Function("f", [x], [ca.vertcat(*values)])
    outs = [(f"y[{i}]", v) for i, v in enumerate(values)]
    text, _ = c_function("evaluate", ["const real *x", "real *y"], {"x": x}, outs)
    main = (
        f'#include <stdio.h>\n#include "hmpc_math.h"\n{text}int main(void) {{ real x[3], y[{len(values)}];\n'
    )
    main += 'while (scanf("%lf %lf %lf", x, x + 1, x + 2) == 3) { evaluate(x, y);'
    main += f'for (int i = 0; i < {len(values)}; ++i) printf("%.17g ", y[i]); }} return 0; }}\n'
    (tmp_path / "evaluate.c").write_text(main)
    program = tmp_path / "evaluate"
    words = ["cc", "-O2", "-std=c11", "-ffp-contract=off", "-I", folder, tmp_path / "evaluate.c", "-lm"]
    subprocess.run([*words, "-o", program], check=True)
    points = np.random.default_rng(0).normal(size=(200, 3))
    points[0] = 0.0
    given = "\n".join(" ".join(map(repr, row.tolist())) for row in points)
    told = subprocess.run([program], input=given, capture_output=True, text=True, check=True).stdout
    found = np.array(told.split(), dtype=float).reshape(len(points), -1)
    wanted = np.array([f(row).full().ravel() for row in points])
    # a few units in the last place of each function
    np.testing.assert_allclose(found, wanted, rtol=4e-15, atol=4e-15)


@needs_compiler
def test_from_a_run_to_c_and_loops_on_it(noisy_artifact, tmp_path, call):
    """``hybrid-mpc export c``, and the solver ``native`` of a kit beside ``rti``."""
    code, _, err = call("export", "c", noisy_artifact, "--out", tmp_path / "none")
    assert code == 2
    assert "HM-KIT-007" in err
    golf = hm.load_scenario("golf_robot")
    run = shutil.copytree(noisy_artifact, tmp_path / "model")
    save_loop(run, loop_settings(golf, read_parts(run).loop.process_noise))
    kit, folder = hm.load(run), tmp_path / "controller"
    with pytest.raises(InputError, match="HM-KIT-024"):
        hm.generate_controller(kit, run)
    code, _, err = call("export", "c", run, "--out", folder)  # the run has learned nothing to alarm by
    assert code == 2
    assert "--no-monitor" in err
    violation = ChannelLimit("violation", "W", 1, 0.2, 0.1)
    set_limits(run, {"hybrid": [WatchLimits("energy", 0.02, (violation,), (5e-3,), (0,))]})
    code, out, err = call("export", "c", run, "--out", folder)
    assert code == 0, err
    assert "not compiled or run" in out
    assert "Not measured" in (folder / "README.md").read_text()
    assert subprocess.run(["make", "-s", "-C", folder, "CFLAGS=-O1", "test"], check=False).returncode == 0
    task = golf.tasks[0]
    loops = [
        hm.simulate(
            golf.plant(), kit.observer(), kit.controller(solver=solver), task.reference, dt=0.02, duration=0.6,
            x0=np.array(task.x0), seed=3,
        )
        for solver in ("rti", "native")
    ]  # fmt: skip
    # rounding that a loop of 30 periods on a well damped arm does not let grow
    np.testing.assert_allclose(loops[1].u, loops[0].u, atol=1e-7)
    assert set(loops[1].source) == {"MPC"}


@needs_compiler
def test_the_check_compiles_runs_and_measures(tmp_path, monkeypatch):
    """Only where it is asked for; a test that fails leaves nothing behind."""
    model, ocp = parts.delayed()
    ran = []
    run = subprocess.run
    monkeypatch.setattr(
        export.subprocess, "run", lambda words, **more: ran.append(words) or run(words, **more)
    )
    export.write_controller(tmp_path / "a", model, ocp)
    assert not ran
    export.write_controller(tmp_path / "a", model, ocp, check=True)
    assert ran
    assert re.search(r"flash: code and tables \| [\d,]+", (tmp_path / "a" / "README.md").read_text())
    own = export._vectors
    monkeypatch.setattr(export, "_vectors", lambda *given: (1e-9, own(*given)[1].replace(
        "vector_u[25][1] = {\n  {R(", "vector_u[25][1] = {\n  {R(9")))  # fmt: skip
    with pytest.raises(InputError, match="HM-EMBEDDED-004"):
        export.write_controller(tmp_path / "b", model, ocp, check=True)
    assert [p.name for p in tmp_path.iterdir()] == ["a"]


@needs_compiler
def test_rounding_that_an_unstable_machine_amplifies_is_tolerated(tmp_path):
    model = levitated_ball()
    ocp = OCP(50, [0.3**-2, 0.0, 0.0], [0.0], [4.0**-2], [0.0], [24.0])
    export.write_controller(tmp_path / "ball", model, ocp, check=True)
    tolerance = float(
        re.search(r"VECTOR_TOLERANCE R\((.*)\)", (tmp_path / "ball/hmpc_vectors.h").read_text())[1]
    )
    assert 1e-9 <= tolerance < 1e-6
    assert f"{tolerance:.2g}" in (tmp_path / "ball/README.md").read_text()


HOSTILE = (
    "phi **//\nint evil(void) { return 1; }\n/*", "x */ int a; /*", "x\\", "a??/", "%n%s", "../../x", "a\x00b",
    "<script>", "$x$", "a`id`", "a;b", 'a"b', "a\u202eb", "", " ", ".hidden", "-rf", "x" * 200,
)  # fmt: skip


HARMLESS_UNITS = ("../../x", ".hidden", "-rf", "%n%s")
"""No file is called after a unit, and none is a format."""
PLACES = (
    *(
        (KIT, ("model", role, 0), key)
        for role in ("states", "inputs", "outputs", "parameters")
        for key in ("name", "unit")
    ),
    (KIT, ("model", "balances", 0), "name"), (KIT, ("model", "balances", 0), "rate_unit"), (KIT, ("models",), 0),
    (TASKS, ("tasks",), 0),
)  # fmt: skip


def test_no_artifact_carries_code_in_a_name(tmp_path):
    """Whatever it is the name of, and whoever wrote the folder: its hash is right."""
    kit, scenario = tmp_path / "kit", hm.load_scenario("golf_robot")
    prior = scenario.prior()
    info = model_info(prior, scenario.data.dt)
    hm.save_artifact(kit, {"prior": prior_programs(prior, info.dt)}, info, loop=loop_settings(scenario))
    for file, place, key in PLACES:
        path = kit / file
        whole = path.read_text()
        for name in HOSTILE:
            document = json.loads(whole)
            del document["sha256"]
            if file == TASKS:
                document["tasks"] = ["hold"]
            inner = document
            for step in place:
                inner = inner[step]
            inner[key] = name
            if "unit" in str(key) and name in HARMLESS_UNITS:
                continue
            write_document(path, document)
            with pytest.raises(InputError):
                hm.load(kit)
        path.write_text(whole)
    hm.load(kit)


def test_c_comments_hold_nothing_but_text():
    """What is no name comes into C through an expression's: neither closes the comment nor goes on in the next line."""
    for name in HOSTILE:
        text = comment(name)
        assert not {"*", "/", "\\", "?", "\n", "\x00"} & set(text)
        assert len(text) == len(name)
    sizes, watched = {"NX": 1}, Watched({}, {}, "", "", {})
    config = _config(sizes, False, [*HOSTILE, "level"], watched)
    inside = config.split("/* Hard bounds by their place in given_way:\n")[1].split("*/")[0]
    assert len(inside.splitlines()) == len([n for n in HOSTILE if n]) + 1
    assert "level" in inside


@pytest.mark.parametrize("there", [False, True])
def test_a_full_disk_leaves_no_half_of_a_controller(tmp_path, monkeypatch, there):
    model, ocp = parts.delayed()
    place = tmp_path / "controller"
    before = {}
    if there:
        export.write_controller(place, model, ocp)
        (place / "main.c").write_text("int main(void) { return 0; }")
        before = {p.name: p.read_bytes() for p in place.iterdir()}
    write = nn_export.files.os.fsync
    written = []

    def full(handle):
        written.append(handle)
        if len(written) > 12:
            raise OSError(errno.ENOSPC, "No space left on device")
        write(handle)

    with monkeypatch.context() as patch:
        patch.setattr(nn_export.files.os, "fsync", full)
        with pytest.raises(StorageError, match=r"No space left.*HM-FILES-001"):
            export.write_controller(place, model, ocp.changed(r=[2.0]))
    assert {p.name: p.read_bytes() for p in place.iterdir()} == before if there else not place.exists()
    assert [p.name for p in tmp_path.iterdir()] == ["controller"] * there  # nothing hidden either
    export.write_controller(place, model, ocp)  # the same place can be used again
    assert (place / "hmpc_expressions.h").read_text().endswith("#endif\n")
    assert (place / "main.c").exists() == there


def test_a_limit_on_files_is_a_full_disk_too(tmp_path):
    """A process of its own, whose files may have 4 KiB: the system itself cuts the writing off."""
    code = (
        "import resource, signal, sys\nfrom pathlib import Path\n"
        "from hybrid_mpc.errors import StorageError\nfrom hybrid_mpc.files import replacing_folder, write_text\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\nresource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))\n"
        "try:\n    with replacing_folder(Path(sys.argv[1])) as new:\n"
        "        write_text(new / 'a', 'x')\n        write_text(new / 'b', 'x' * 5000)\n"
        "except StorageError:\n    sys.exit(7)\n"
    )
    done = subprocess.run([sys.executable, "-c", code, tmp_path / "out"], check=False)
    assert done.returncode == 7
    assert not list(tmp_path.iterdir())


def test_without_a_compiler_python_solves(monkeypatch, tmp_path):
    model, ocp = parts.delayed()
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    with pytest.warns(RuntimeWarning, match=r"no C compiler found.*rti") as told:
        safe = make_controller(model, model, ocp, solver="native")
    assert isinstance(safe.controller, CondensedController)
    assert len(told) == 1


def test_nothing_is_compiled_by_default(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    model, ocp = parts.delayed()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        make_controller(model, model, ocp)


@needs_compiler
@pytest.mark.full
@pytest.mark.parametrize("single", [False, True], ids=["double", "float"])
def test_another_processor_gives_the_same_bits(tmp_path, single):
    """aarch64 under qemu: no multiply-add is fused, and elementary functions are the controller's own."""
    cross, qemu = shutil.which("aarch64-linux-gnu-gcc"), shutil.which("qemu-aarch64")
    if cross is None or qemu is None:
        pytest.skip("no aarch64-linux-gnu-gcc, or no qemu-aarch64")
    folder = written(tmp_path / "c", "delayed", single=single)
    here = subprocess.run([built(folder, "-O3", *STRICT)], capture_output=True, check=True).stdout
    words = [cross, "-O3", *STRICT, "-static", *SOURCES, "hmpc_test.c", "-lm", "-o", "other"]
    subprocess.run(words, cwd=folder, check=True)
    there = subprocess.run([qemu, folder / "other"], capture_output=True, check=True).stdout
    assert here == there
