"""CasADi functions as C: compiled and cached, or written out to be taken elsewhere. No torch in here."""

from __future__ import annotations

import atexit
import hashlib
import os
import platform
import re
import shlex
import shutil
import stat
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path

import casadi as ca
import numpy as np

from nn_export.c_names import refused_name
from nn_export.errors import CompileError, last_line
from nn_export.files import replacing

_SUFFIX = {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so")
_LINK = {"win32": ["-shared"], "darwin": ["-dynamiclib", "-fPIC"]}.get(
    sys.platform, ["-shared", "-fPIC", "-Wl,--no-undefined"]
)


def compile_function(
    function: ca.Function,
    *,
    derivatives: bool = False,
    folder: str | Path | None = None,
    compiler: str | None = None,
    flags: Sequence[str] = ("-O3",),
    timeout: float = 600.0,
) -> ca.Function:
    """The same function as compiled C.

    The library is cached under a hash of the C text, the compiler, its version and the flags; a cached file
    whose own hash does not fit, or that others own or may write, is made again. Any number of processes may compile at
    once: a library appears under its name complete or not at all.

    Args:
        function: Any function that CasADi can write as C.
        derivatives: True compiles its first derivatives too: Jacobian, forward and reverse. Without them
            the result cannot be differentiated. For second derivatives compile the function that
            has them as outputs.
        folder: Folder of the libraries, made if missing. Default: ``nn_export`` in the user's cache folder
            (``XDG_CACHE_HOME``, else ``~/.cache``). It holds code that will be run: share it with nobody. A default
            folder that is not this user's alone (another owner, rights of others, a link) is left alone: libraries
            then last as long as the process, and a ``RuntimeWarning`` says why.
        compiler: Command. Default: the variable ``CC``, else the first of ``cc``, ``gcc``, ``clang``.
        flags: Options of the compiler. Default: ``-O3``, which any machine of the same architecture can run;
            ``-march=native`` binds to this one.
        timeout: Longest time to compile [s].

    Returns:
        Function with the same name, inputs and outputs. The function as it is, with a ``RuntimeWarning``, if
        there is no compiler.

    Raises:
        CompileError: If CasADi cannot write the function as C, its name means something in C
            (:mod:`nn_export.c_names`), the compiler fails or takes too long, or the compiler named does not exist; if
            the folder named is another user's, a link, or others may write there.

    Example:
        >>> x = ca.MX.sym("x")
        >>> with tempfile.TemporaryDirectory() as cache:
        ...     compiled = compile_function(ca.Function("square", [x], [x * x]), folder=cache)
        >>> compiled(3)
        DM(9)
    """
    command = _compiler(compiler)
    if command is None:
        warnings.warn(
            f"no C compiler found (cc, gcc, clang or the variable CC): {function.name()} stays in CasADi's machine, "
            "which gives the same results; install one to make it faster",
            RuntimeWarning,
            stacklevel=2,
        )
        return function
    functions = [function]
    if derivatives:
        functions += [function.jacobian(), function.forward(1), function.reverse(1)]
    library = _library(_source(functions), command, flags, folder, timeout)
    try:
        return ca.external(function.name(), str(library.resolve()))
    except RuntimeError as error:
        raise CompileError(
            f"{library} cannot be loaded: {last_line(error)}; remove it or choose another folder [NN-005]"
        ) from error


def compile_library(
    source: str,
    flags: Sequence[str] = ("-O3",),
    *,
    folder: str | Path | None = None,
    compiler: str | None = None,
    timeout: float = 600.0,
) -> Path:
    """Any C text as a shared library, cached as :func:`compile_function` says; arguments as there.

    Raises:
        CompileError: If there is no compiler, it fails or takes too long; if the folder named is another user's.

    Example:
        >>> with tempfile.TemporaryDirectory() as cache:
        ...     library = compile_library("int one(void) { return 1; }", folder=cache)
        >>> library.suffix == _SUFFIX
        True
    """
    command = _compiler(compiler)
    if command is None:
        raise CompileError("no C compiler found (cc, gcc, clang or the variable CC); install one [NN-006]")
    return _library(source, command, flags, folder, timeout).resolve()


def _library(
    source: str, command: list[str], flags: Sequence[str], folder: str | Path | None, timeout: float
) -> Path:
    key = _key(source, command, flags)
    place = _cache_folder() if folder is None else _named_folder(Path(folder))
    return _cached(place, key) or _build(source, place, key, [*command, *flags], timeout)


@dataclass(frozen=True)
class CFiles:
    """What :func:`generate_c` wrote.

    Args:
        source: ``<name>.c``: the function, standard C with ``math.h`` alone.
        header: ``<name>.h``: its declarations.
        test: ``<name>_test.c``: a main program that evaluates it where the right results are known.
    """

    source: Path
    header: Path
    test: Path


def generate_c(
    function: ca.Function,
    folder: str | Path,
    *,
    points: Sequence[Sequence[np.ndarray | float]] | None = None,
    seed: int = 0,
) -> CFiles:
    """Write a function as self-contained C with a header and a test program, and return their paths.

    ``cc <name>.c <name>_test.c -lm && ./a.out`` prints one line a sample (all outputs, column by column) and
    ends with status 0 if all agree with CasADi to 1e-9 relative to the largest output (``-DTOLERANCE=...``
    changes that).

    Args:
        function: Any function that CasADi can write as C.
        folder: Folder, made if missing.
        points: Samples for the test program: for each one value for each input. Default: three samples of
            normal random numbers.
        seed: Seed of the random samples.

    Raises:
        CompileError: If CasADi cannot write the function as C, or its name means something in C: keywords, names of
            the C library, reserved ones (:mod:`nn_export.c_names`).
        OSError: If the files cannot be written; each is then the one from before, or none.

    Example:
        >>> x = ca.MX.sym("x")
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     files = generate_c(ca.Function("square", [x], [x * x]), folder)
        ...     print(files.source.name, files.header.name, files.test.name)
        square.c square.h square_test.c
    """
    name, path = function.name(), Path(folder)
    _source([function])  # raises what there is to raise
    generator = ca.CodeGenerator(name, {"with_header": True})
    generator.add(function)
    with tempfile.TemporaryDirectory() as work:
        generator.generate(f"{Path(work).resolve()}{os.sep}")
        texts = {end: (Path(work) / f"{name}{end}").read_bytes() for end in (".c", ".h")}
    if points is None:
        rng = np.random.default_rng(seed)
        points = [
            [rng.standard_normal(function.size_in(i)) for i in range(function.n_in())] for _ in range(3)
        ]
    files = CFiles(path / f"{name}.c", path / f"{name}.h", path / f"{name}_test.c")
    for file, content in (
        (files.header, texts[".h"]), (files.test, main_program(function, points).encode()), (files.source, texts[".c"])
    ):  # fmt: skip
        with replacing(file) as open_file:
            open_file.write(content)
    return files


def _compiler(given: str | None) -> list[str] | None:
    named = given or os.environ.get("CC")
    for candidate in [named] if named else ["cc", "gcc", "clang"]:
        words = shlex.split(candidate)
        if words and shutil.which(words[0]):
            return words
    if given:
        raise CompileError(
            f"compiler {given!r}: no such command; install the compiler, or omit the argument [NN-007]"
        )
    return None


def _source(functions: list[ca.Function]) -> str:
    name = functions[0].name()
    if reason := refused_name(name, _OWN_NAMES):
        raise CompileError(
            f"a function named {name!r} cannot be written as C: the name {reason}; give it another, as in "
            'ca.Function("f", ...) [NN-008]'
        )
    for f in (one for own in functions for one in (own, *own.find_functions())):
        # CasADi writes the names of arguments into comments as they are
        if strange := [n for n in (*f.name_in(), *f.name_out()) if not re.fullmatch(r"\w+", n, re.ASCII)]:
            raise CompileError(
                f"{name} cannot be written as C: an argument of {f.name()} is called {strange[0]!r:.80}; a name has "
                "letters, digits and _ [NN-009]"
            )
    try:
        generator = ca.CodeGenerator("compiled")
        for f in functions:
            generator.add(f)
        text: str = generator.dump()
    except RuntimeError as error:
        raise CompileError(
            f"{functions[0].name()} cannot be written as C: {last_line(error)} [NN-010]"
        ) from error
    if kinds := sorted(set(re.findall("#error Code generation not supported for (.*)", text))):
        raise CompileError(
            f"{functions[0].name()} cannot be written as C: CasADi cannot generate C for {', '.join(kinds)}; keep "
            "callbacks and solvers outside the function [NN-011]"
        )
    return text


def _key(source: str, command: list[str], flags: Sequence[str]) -> str:
    compiler = subprocess.run([*command, "--version"], capture_output=True, text=True, check=False)
    parts = [source, *command, compiler.stdout, *flags, platform.machine(), sys.platform, version("casadi")]
    if any("native" in flag for flag in flags):  # runs on this processor alone
        parts.append(platform.node())
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:32]


def _named_folder(folder: Path) -> Path:
    """A folder that the user named, made if missing."""
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    except OSError as error:
        raise CompileError(
            f"{folder} cannot be created: {error.strerror}; choose another folder [NN-012]"
        ) from error
    if reason := _distrust(folder, stat.S_ISDIR, 0o022):
        raise CompileError(
            f"{folder}: {reason}, so code of another user could run; choose a folder that only you can write (chmod "
            "700) [NN-013]"
        )
    return folder


def _cache_folder() -> Path:
    """The user's cache folder, made if missing; one of this process if that is not the user's alone."""
    given = Path(os.environ.get("XDG_CACHE_HOME") or os.environ.get("LOCALAPPDATA") or "")
    try:
        folder = (given if given.is_absolute() else Path.home() / ".cache") / "nn_export"
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        reason = _distrust(folder, stat.S_ISDIR, 0o077)
    except (OSError, RuntimeError) as error:  # no home, or one that cannot be written
        reason = str(error)
    if not reason:
        return folder
    first = _process_folder.cache_info().currsize == 0
    folder = _process_folder()
    if first:
        warnings.warn(
            f"no cache of compiled functions: {reason}; they are kept in {folder} as long as this process lasts. Make "
            "the folder yours alone (chmod 700), or name another",
            RuntimeWarning,
            stacklevel=3,  # the caller of compile_function
        )
    return folder


@cache
def _process_folder() -> Path:
    """A folder that nobody else may enter, removed with the process that makes it."""
    folder, owner = Path(tempfile.mkdtemp(prefix="nn_export-")), os.getpid()
    atexit.register(lambda: shutil.rmtree(folder, ignore_errors=True) if os.getpid() == owner else None)
    return folder


def _distrust(path: Path, kind: Callable[[int], bool], rights: int) -> str:
    """Why others could have put code into a file or folder; empty if they could not.

    ``rights`` are those of group and others that are too many.
    """
    if os.name != "posix":
        return ""
    found = path.lstat()
    if not kind(found.st_mode):
        return f"{path} is a link" if stat.S_ISLNK(found.st_mode) else f"{path} is not what it should be"
    if found.st_uid != os.geteuid():
        return f"{path} belongs to another user (number {found.st_uid})"
    if found.st_mode & rights:
        who = "anyone" if found.st_mode & rights & 0o007 else "its group"
        return f"{who} may {'write' if found.st_mode & 0o022 else 'look'} there ({path})"
    return ""


def _cached(folder: Path, key: str) -> Path | None:
    """The library of a key, if the user has one there whose name carries its own hash."""
    for path in folder.glob(f"{key}-*{_SUFFIX}"):
        if _distrust(path, stat.S_ISREG, 0o022):
            continue
        if path.stem == f"{key}-{hashlib.sha256(path.read_bytes()).hexdigest()[:16]}":
            return path
    return None


def _build(source: str, folder: Path, key: str, command: list[str], timeout: float) -> Path:
    with tempfile.TemporaryDirectory(dir=folder, prefix=".build-") as work:
        text, library = Path(work) / "compiled.c", Path(work) / f"library{_SUFFIX}"
        text.write_text(source)
        words = [*command, *_LINK, "-o", str(library), str(text), "-lm"]
        try:
            done = subprocess.run(words, capture_output=True, text=True, timeout=timeout, check=False)
        except subprocess.TimeoutExpired as error:
            raise CompileError(
                f"the C compiler took more than {timeout:g} s; use -O0 or -O1, a matrix (MX) graph instead of a scalar "
                "one, or a longer timeout [NN-014]"
            ) from error
        if done.returncode or not library.is_file():
            raise CompileError(f"{shlex.join(words)} failed:\n{done.stderr[-2000:]} [NN-015]")
        with library.open("rb+") as file:
            digest = hashlib.sha256(file.read()).hexdigest()[:16]
            os.fsync(file.fileno())
        library.chmod(0o700)  # whatever the umask: others are to have no part in it
        final = folder / f"{key}-{digest}{_SUFFIX}"
        os.replace(library, final)
    return final


_TEST = """/* Evaluates {name} at {samples} samples and compares with what CasADi gave.
   cc {name}.c {name}_test.c -lm */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include "{name}.h"

#ifndef TOLERANCE
#define TOLERANCE 1e-9 /* of the largest output */
#endif

static const double inputs[{samples}][{n_in}] = {{
{inputs}
}};
static const double expected[{samples}][{n_out}] = {{
{expected}
}};

int main(void) {{
  casadi_int n_arg, n_res, n_iw, n_w, first_in[] = {{{first_in}}}, first_out[] = {{{first_out}}}, i, k;
  const casadi_real **arg;
  casadi_real **res, *w, results[{n_out}];
  casadi_int *iw;
  int wrong = 0;
  if ({name}_work(&n_arg, &n_res, &n_iw, &n_w)) return 2;
  arg = (const casadi_real **)calloc((size_t)n_arg + 1, sizeof(*arg));
  res = (casadi_real **)calloc((size_t)n_res + 1, sizeof(*res));
  iw = (casadi_int *)calloc((size_t)n_iw + 1, sizeof(*iw));
  w = (casadi_real *)calloc((size_t)n_w + 1, sizeof(*w));
  if (!arg || !res || !iw || !w) return 2;
  for (k = 0; k < {samples}; ++k) {{
    double size = 1e-300;
    for (i = 0; i < {name}_n_in(); ++i) arg[i] = inputs[k] + first_in[i];
    for (i = 0; i < {name}_n_out(); ++i) res[i] = results + first_out[i];
    if ({name}(arg, res, iw, w, 0)) return 2;
    for (i = 0; i < {used}; ++i)
      if (isfinite(expected[k][i])) size = fmax(size, fabs(expected[k][i]));
    for (i = 0; i < {used}; ++i) {{
      printf("%.17g ", results[i]);
      if (isfinite(expected[k][i]) ? !(fabs(results[i] - expected[k][i]) <= TOLERANCE * size) : isfinite(results[i]))
        wrong = 1;
    }}
    printf("\\n");
  }}
  fprintf(stderr, wrong ? "{name}: differs\\n" : "{name}: all agree\\n");
  free(arg); free(res); free(iw); free(w);
  return wrong;
}}
"""

_OWN_NAMES = frozenset(
    re.findall(r"[A-Za-z]\w*", re.sub(r'/\*.*?\*/|"[^"]*"|\{\w+\}\w*|#[^\n]*', " ", _TEST, flags=re.DOTALL))
)
"""Names that the test program takes: of its variables, which would hide the function, and of what it calls."""


def main_program(f: ca.Function, points: Sequence[Sequence[np.ndarray | float]]) -> str:
    """C text of a main program that evaluates ``f`` at the points and compares with CasADi."""
    inputs, expected = [], []
    for point in points:
        held = [ca.DM(ca.project(ca.DM(v), f.sparsity_in(i))) for i, v in enumerate(point)]
        inputs.append([x for v in held for x in v.nonzeros()])
        expected.append([y for v in f.call(held) for y in v.nonzeros()])
    first_in = np.cumsum([0] + [f.nnz_in(i) for i in range(f.n_in())])
    first_out = np.cumsum([0] + [f.nnz_out(i) for i in range(f.n_out())])
    rows = {"inputs": inputs, "expected": expected}
    texts = {
        key: ",\n".join(f"  {{{', '.join(map(_literal, row or [0.0]))}}}" for row in values)
        for key, values in rows.items()
    }
    return _TEST.format(
        name=f.name(),
        samples=len(points),
        n_in=max(1, int(first_in[-1])),
        n_out=max(1, int(first_out[-1])),
        used=int(first_out[-1]),
        first_in=", ".join(map(str, first_in)),
        first_out=", ".join(map(str, first_out)),
        **texts,
    )


def _literal(x: float) -> str:
    return repr(x) if np.isfinite(x) else "NAN" if np.isnan(x) else "INFINITY" if x > 0 else "-INFINITY"
