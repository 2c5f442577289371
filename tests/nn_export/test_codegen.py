"""C code: the same numbers, cached by content, safe with damaged files and many processes."""

import errno
import multiprocessing
import os
import re
import shutil
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from export_parts import traced_cell

import nn_export.files
from nn_export import build, codegen, compile_function, generate_c, unroll, with_jacobian
from nn_export.c_names import refused_name
from nn_export.errors import CompileError

needs_compiler = pytest.mark.skipif(not shutil.which("cc"), reason="no C compiler on this machine")
POINT = [np.array([0.3, -0.5]), np.linspace(-1, 1, 4), np.array([0.2])]


@pytest.fixture(scope="module")
def program():
    return traced_cell(4)


def flat(values):
    return np.concatenate([v.full().ravel(order="F") for v in values])


@needs_compiler
def test_compiled_functions_give_the_same_numbers(program, tmp_path):
    step = build(program, "step")
    for function, point in (
        (step, POINT),
        (with_jacobian(program, name="derived"), POINT),
        (unroll(step, 5), [*POINT[:2], np.ones((1, 5))]),
    ):
        compiled = compile_function(function, folder=tmp_path, flags=["-O1"])
        assert compiled.is_a("External")
        assert (compiled.name_in(), compiled.name_out()) == (function.name_in(), function.name_out())
        # The same operations; compilers may contract a product and a sum.
        assert np.abs(flat(compiled(*point)) - flat(function(*point))).max() < 1e-14


@needs_compiler
def test_compiled_derivatives(program, tmp_path):
    step = build(program, "step")
    compiled = compile_function(step, derivatives=True, folder=tmp_path, flags=["-O0"])
    x = ca.MX.sym("x", 2)
    both = []
    for f in (step, compiled):
        y = ca.vertcat(*f(x, *POINT[1:]))
        both.append(ca.Function("d", [x], [ca.jacobian(y, x), ca.gradient(ca.sumsqr(y), x)])(POINT[0]))
    assert np.abs(flat(both[0]) - flat(both[1])).max() < 1e-14
    plain = compile_function(step, folder=tmp_path, flags=["-O0"])
    with pytest.raises(RuntimeError, match=r"[Dd]erivatives"):
        plain.jacobian()


@needs_compiler
def test_cache_by_content(program, tmp_path):
    step = build(program, "step")
    compile_function(step, folder=tmp_path / "a", flags=["-O0"])
    (library,) = (tmp_path / "a").iterdir()
    before = library.stat().st_mtime_ns
    compile_function(build(program, "step"), folder=tmp_path / "a", flags=["-O0"])
    assert [p.stat().st_mtime_ns for p in (tmp_path / "a").iterdir()] == [before]
    compile_function(step, folder=tmp_path / "a", flags=["-O1"])
    assert len(list((tmp_path / "a").iterdir())) == 2


@needs_compiler
def test_a_damaged_library_is_made_again(tmp_path):
    x = ca.MX.sym("x")
    square = ca.Function("square", [x], [x * x])
    compile_function(square, folder=tmp_path, flags=["-O0"])
    (library,) = tmp_path.iterdir()
    data = library.read_bytes()
    library.unlink()  # not in place: it is loaded in this process
    library.write_bytes(data[: len(data) // 2])
    code = (
        "import casadi as ca, sys; from nn_export import compile_function\n"
        "x = ca.MX.sym('x'); f = ca.Function('square', [x], [x * x])\n"
        "print(compile_function(f, folder=sys.argv[1], flags=['-O0'])(3))"
    )
    root = str(Path(__file__).parents[2])
    done = subprocess.run(
        [sys.executable, "-c", code, str(tmp_path)], capture_output=True, text=True, cwd=root
    )
    assert done.stdout.strip() == "9", done.stderr
    assert library.read_bytes() == data


def _compile_and_call(folder):
    x = ca.MX.sym("x")
    return float(compile_function(ca.Function("cube", [x], [x**3]), folder=folder, flags=["-O0"])(2))


@needs_compiler
@pytest.mark.full
def test_many_processes_at_once(tmp_path):
    with multiprocessing.get_context("spawn").Pool(3) as pool:
        assert pool.map(_compile_and_call, [str(tmp_path)] * 6) == [8.0] * 6
    assert [p.suffix for p in tmp_path.iterdir()] == [".so"]  # one library, and no scratch left


def test_without_a_compiler_the_function_comes_back_with_one_warning(program, monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("CC", raising=False)
    step = build(program)
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        assert compile_function(step, folder=tmp_path / "c") is step
    assert len(seen) == 1
    assert "no C compiler" in str(seen[0].message)
    assert not (tmp_path / "c").exists()


def test_the_cache_lies_in_the_users_folder(program, monkeypatch, tmp_path):
    if not shutil.which("cc"):
        pytest.skip("no C compiler on this machine")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    x = ca.MX.sym("x")
    compile_function(ca.Function("f", [x], [x]), flags=["-O0"])
    assert len(list((tmp_path / "nn_export").iterdir())) == 1
    if os.name == "posix":
        assert (tmp_path / "nn_export").stat().st_mode & 0o077 == 0  # nobody else may put code there


def square(folder=None):
    """A compiled function of three, with the warnings of it."""
    x = ca.MX.sym("x")
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        compiled = compile_function(ca.Function("square", [x], [x * x]), folder=folder, flags=["-O0"])
    return float(compiled(3)), [str(w.message) for w in seen]


@pytest.fixture
def cache(monkeypatch, tmp_path):
    """The user's cache folder, and a process that has made none of its own yet."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    codegen._process_folder.cache_clear()
    yield tmp_path / "nn_export"
    codegen._process_folder.cache_clear()


def of_another(path):
    """As if somebody else had made it."""
    if os.geteuid():
        pytest.skip("only root can give files away")
    os.chown(path, 65534, 65534)


def linked(path):
    elsewhere = path.with_name("elsewhere")
    path.rename(elsewhere)
    path.symlink_to(elsewhere)


ALTERED = [
    (of_another, "belongs to another user"),
    (linked, "is a link"),
    (lambda path: path.chmod(0o777), "anyone may write there"),
    (lambda path: path.chmod(0o770), "its group may write there"),
]
IDS = ["owner", "link", "open to all", "open to the group"]


@needs_compiler
@pytest.mark.skipif(os.name != "posix", reason="rights are POSIX's here")
@pytest.mark.parametrize(("alter", "reason"), [*ALTERED, (lambda path: path.chmod(0o755), "anyone may look there")],
                         ids=[*IDS, "readable"])  # fmt: skip
def test_a_cache_that_is_not_the_users_alone_is_left_alone(cache, alter, reason):
    cache.mkdir()
    alter(cache)
    before = sorted(os.listdir(cache))
    value, seen = square()
    assert value == 9
    (text,) = seen
    assert reason in text
    assert square() == (9, [])  # one warning, not one each time
    assert sorted(os.listdir(cache)) == before
    (own,) = cache.parent.glob("nn_export-*")
    assert own.stat().st_mode & 0o777 == 0o700
    assert str(own) in text
    assert len(list(own.glob("*.so"))) == 1


@needs_compiler
@pytest.mark.skipif(os.name != "posix", reason="rights are POSIX's here")
@pytest.mark.parametrize(("alter", "reason"), ALTERED, ids=IDS)
def test_a_folder_that_is_named_must_be_the_users(tmp_path, alter, reason):
    (tmp_path / "named").mkdir(mode=0o700)
    alter(tmp_path / "named")
    with pytest.raises(CompileError, match=reason):
        square(tmp_path / "named")
    assert not list((tmp_path / "named").iterdir())


@needs_compiler
@pytest.mark.skipif(os.name != "posix", reason="rights are POSIX's here")
@pytest.mark.parametrize(("alter", "reason"), ALTERED, ids=IDS)
def test_a_library_that_others_could_have_written_is_not_loaded(tmp_path, alter, reason):
    square(tmp_path)
    (library,) = tmp_path.glob("*.so")
    assert library.stat().st_mode & 0o777 == 0o700
    made = library.stat().st_mtime_ns
    alter(library)
    assert square(tmp_path)[0] == 9
    now = library.lstat()
    assert now.st_mtime_ns > made
    assert (now.st_uid, now.st_mode & 0o777) == (os.geteuid(), 0o700)
    assert not library.is_symlink()


@needs_compiler
@pytest.mark.skipif(os.name != "posix", reason="pipes are POSIX's here")
def test_a_pipe_in_the_cache_is_not_waited_for(tmp_path):
    square(tmp_path)
    (library,) = tmp_path.glob("*.so")
    library.unlink()
    os.mkfifo(library)
    assert square(tmp_path)[0] == 9


@pytest.mark.full
@needs_compiler
def test_without_a_home_libraries_last_as_long_as_the_process(cache, monkeypatch):
    cache.write_text("a file where the folder should be")
    value, seen = square()
    assert (value, len(seen)) == (9, 1)
    code = "from test_codegen import square; from nn_export import codegen; square(); print(codegen._process_folder())"
    paths = f"{Path(__file__).parents[2]}:{Path(__file__).parent}"
    environment = {**os.environ, "PYTHONPATH": paths}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    folder = Path(done.stdout.strip())
    assert folder.name.startswith("nn_export-")
    assert not folder.exists()


class Callback(ca.Callback):
    def __init__(self):
        super().__init__()
        self.construct("callback", {})

    def eval(self, arguments):
        return arguments


@needs_compiler
def test_named_errors(tmp_path):
    x = ca.MX.sym("x")
    f = ca.Function("f", [x], [x])
    with pytest.raises(CompileError, match="NN-007"):
        compile_function(f, folder=tmp_path, compiler="no-such-compiler")
    with pytest.raises(CompileError, match=r"(?s)unrecognized.*NN-015"):
        compile_function(f, folder=tmp_path, flags=["-fno-such-flag"])
    (tmp_path / "open").mkdir()
    (tmp_path / "open").chmod(0o777)
    with pytest.raises(CompileError, match="NN-013"):
        compile_function(f, folder=tmp_path / "open")
    with pytest.raises(CompileError, match="NN-014"):
        compile_function(f, folder=tmp_path, timeout=1e-4)
    callback = Callback()
    for write in (compile_function, generate_c):
        with pytest.raises(CompileError, match=r"CallbackInternal.*NN-011"):
            write(callback, folder=tmp_path)
    inner = compile_function(f, folder=tmp_path, flags=["-O0"])
    with pytest.raises(CompileError, match=r"(?s)undefined reference.*NN-015"):
        compile_function(ca.Function("outer", [x], [inner(x) + 1]), folder=tmp_path, flags=["-O0"])
    assert len(list(tmp_path.glob("*.so"))) == 1
    assert not list(tmp_path.glob(".build*"))


@needs_compiler
def test_generated_c_stands_alone(program, tmp_path):
    function = with_jacobian(program, {"A": ("x", "h"), "B": ("u",)}, "step")
    rng = np.random.default_rng(0)
    points = [[rng.standard_normal(p.shape) for p in POINT] for _ in range(2)]
    files = generate_c(function, tmp_path / "with space", points=points)
    assert {p.name for p in files.source.parent.iterdir()} == {"step.c", "step.h", "step_test.c"}
    # An empty include path beyond the compiler's own, standard C, and the mathematics library alone.
    command = ["cc", "-std=c99", "-pedantic", "-Wall", "-Werror", "-O1", "-o", str(tmp_path / "main")]
    subprocess.run([*command, str(files.source), str(files.test), "-lm"], check=True, cwd=tmp_path)
    done = subprocess.run([str(tmp_path / "main")], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "step: all agree\n")
    printed = [np.array(line.split(), float) for line in done.stdout.splitlines()]
    for point, row in zip(points, printed, strict=True):
        assert np.abs(row - flat(function(*point))).max() < 1e-14


@needs_compiler
def test_the_test_program_sees_a_difference(tmp_path):
    x = ca.MX.sym("x")
    files = generate_c(ca.Function("f", [x], [ca.sqrt(x)]), tmp_path, points=[[4.0], [-1.0]])
    right = files.source.read_text()
    for text, status in (
        (right, 0),
        (right.replace("sqrt(", "1e-6+sqrt("), 1),
        (right.replace("sqrt(", "fabs("), 1),
    ):
        files.source.write_text(text)
        command = ["cc", "-o", str(tmp_path / "main"), str(files.source), str(files.test), "-lm"]
        subprocess.run(command, check=True, capture_output=True)
        assert subprocess.run([str(tmp_path / "main")], capture_output=True).returncode == status


HEADERS = ("math", "stdio", "stdlib", "string")


@pytest.mark.parametrize(
    "name", ["double", "int", "main", "sin", "free", "class", "and", "read", "y0", "EOF", "k", "f_t"]
)
def test_names_that_mean_something_in_c_are_refused(tmp_path, name):
    x = ca.MX.sym("x")
    for write in (compile_function, generate_c):
        with pytest.raises(CompileError, match=repr(name)):
            write(ca.Function(name, [x], [x * x]), folder=tmp_path / "there")
    assert not list(tmp_path.glob("there/*.c"))


def test_names_of_machines_are_not_refused():
    assert not [
        n for n in ("step", "xdot", "output", "torque", "stress", "f", "K", "square") if refused_name(n)
    ]


@needs_compiler
@pytest.mark.parametrize("given", [["-std=c11"], ["-std=gnu17", "-D_GNU_SOURCE"]])
def test_no_function_of_this_machine_s_headers_is_missing(given):
    """Whatever the generated code's headers declare here: of a library that is not glibc, too."""
    source = "".join(f"#include <{name}.h>\n" for name in HEADERS)
    text = subprocess.run(
        ["cc", "-E", "-P", *given, "-"], input=source, capture_output=True, text=True, check=True
    ).stdout
    declared = set(re.findall(r"\b([A-Za-z]\w*)\s*\((?!\()", text))
    assert len(declared) > 200
    assert not [name for name in declared if not refused_name(name)]


def test_names_of_arguments_carry_no_code(tmp_path):
    """CasADi writes them into comments as they are."""
    x = ca.MX.sym("x")
    inner = ca.Function("inner", [x], [x * x], ["a*/b"], ["c"], {"never_inline": True})
    for f in (inner, ca.Function("outer", [x], [inner(x)])):
        for write in (compile_function, generate_c):
            with pytest.raises(CompileError, match=r"inner.*NN-009"):
                write(f, folder=tmp_path / "there")


def test_a_full_disk_leaves_no_half_of_a_file(tmp_path, monkeypatch):
    x = ca.MX.sym("x")

    def full(handle):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(nn_export.files.os, "fsync", full)
        with pytest.raises(OSError, match="No space left"):
            generate_c(ca.Function("f", [x], [x * x]), tmp_path)
    assert not list(tmp_path.iterdir())
    assert generate_c(ca.Function("f", [x], [x * x]), tmp_path).test.is_file()
