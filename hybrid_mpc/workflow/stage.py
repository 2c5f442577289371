"""A stage of a job: its inputs, its computation, and its typed result on disk.

A stage runs again only if one of its inputs has changed: a setting, a part of the scenario, the result of an earlier
stage. An input that cannot be checked counts as changed.
"""

from __future__ import annotations

import ast
import functools
import hashlib
import inspect
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError, StorageError, no_exit
from hybrid_mpc.files import (
    digest,
    read_document,
    read_document_arrays,
    read_object,
    write_document,
    write_text,
)
from hybrid_mpc.records import plain, record

if TYPE_CHECKING:
    from hybrid_mpc.workflow.context import Context

Array = NDArray[Any]
R = TypeVar("R")
UNKNOWN = object()
"""Value of an input whose change cannot be detected: the stage always runs again."""
LIBRARY = ("hybrid_mpc", "nn_export")
"""Packages whose modules belong to the digest of a stage that imports them, see :func:`sources`."""
CONTEXT = "hybrid_mpc.workflow.context"
"""This module imports for all stages: its own source belongs to every digest, its imports do not."""


@dataclass(frozen=True)
class Absent:
    """A stage without a result: it failed, the scenario does not allow it, or the user left it out.

    Args:
        reason: Why there is no result.
        failed: Whether the stage failed. Default: False.
    """

    reason: str
    failed: bool = False


@dataclass(frozen=True)
class Stage(Generic[R]):
    """A stage of a job.

    Args:
        name: Name of the stage and of its file.
        title: Text for the terminal.
        result: Frozen dataclass of the result. A field ``arrays`` (:func:`~hybrid_mpc.records.beside`) holds arrays by
            name, all other fields plain data.
        compute: Computes the result, or says why there is none.
        reads: Inputs besides other stages, by name. ``UNKNOWN`` counts as changed.
        needs: Stages whose results it reads. Default: none.
        optional: Whether model and report are possible without this stage. Default: False.
        restore: Called with an up-to-date result; restores what the stage writes outside its own file, or returns why
            the stage must run again (empty: it need not). Default: nothing to restore.
    """

    name: str
    title: str
    result: type[R]
    compute: Callable[[Context], R | Absent]
    reads: Callable[[Context], Mapping[str, object]]
    needs: tuple[Stage[Any], ...] = ()
    optional: bool = False
    restore: Callable[[Context, R], str] = lambda context, result: ""

    def keys(self, context: Context) -> dict[str, str]:
        """Digest of each input of the stage; empty for an unknown input."""
        code = sources(self.compute.__module__)
        read = dict(self.reads(context)) | {"library": context.versions, "the program": code}
        read |= {f"result of {stage.name}": context.digest_of(stage) for stage in self.needs}
        return {name: "" if value is UNKNOWN else digest(value) for name, value in read.items()}


@functools.cache
def sources(module: str) -> str:
    """Digest of the source of a module of :data:`LIBRARY` and of all modules that it imports there, also indirectly.

    Imports within functions count, imports for type checkers do not. C sources and templates count with their room.

    Example:
        >>> len(sources("hybrid_mpc.workflow.stages.choose"))
        64
    """
    found: dict[str, Path] = {}
    ahead = [module] if _file(module) else []
    while ahead:
        name = ahead.pop()
        if name not in found:
            found[name], own = _module(name)
            ahead += [] if name == CONTEXT else own
    rooms = {path.parent for path in found.values()} - set(_PACKAGES.values())
    data = {
        path for room in rooms for path in room.rglob("*") if path.suffix in (".c", ".h", ".html", ".css")
    }
    content = hashlib.sha256()
    for package, folder in _PACKAGES.items():
        for path in sorted(p for p in {*found.values(), *data} if p.is_relative_to(folder)):
            name = f"{package}/{path.relative_to(folder).as_posix()}"
            content.update(f"{name}\0".encode() + path.read_bytes() + b"\0")
    return content.hexdigest()


_PACKAGES = {name: Path(str(find_spec(name).origin)).parent for name in LIBRARY}  # type: ignore[union-attr]


def _file(name: str) -> Path | None:
    """Source of a module of :data:`LIBRARY`; None of anything else, and of the table of public names."""
    package, _, rest = name.partition(".")
    if package not in LIBRARY or name == "hybrid_mpc":
        return None
    path = _PACKAGES[package].joinpath(*rest.split(".")) if rest else _PACKAGES[package]
    return next((p for p in (path.with_suffix(".py"), path / "__init__.py") if p.is_file()), None)


@functools.cache
def _module(name: str) -> tuple[Path, tuple[str, ...]]:
    """Source of a module of :data:`LIBRARY`, and the names of those that it imports."""
    path = _file(name)
    assert path is not None, name
    ahead: list[ast.AST] = [ast.parse(path.read_text(encoding="utf-8"))]
    names: set[str] = set()
    while ahead:
        node = ahead.pop()
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.dump(node.test):
            continue
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            below = {alias.name: f"{node.module}.{alias.name}" for alias in node.names}
            names.update(full if _file(full) else node.module for full in below.values())
        elif not isinstance(node, ast.expr):
            ahead.extend(ast.iter_child_nodes(node))
    return path, tuple(sorted(one for one in names if _file(one)))


@dataclass(frozen=True)
class Stored(Generic[R]):
    """Content of a stage's file: digests of its inputs, the result, and the result's digest.

    ``unfit`` says why the file cannot be used: another version wrote it. Empty if it can be used.
    """

    keys: Mapping[str, str]
    result: R | Absent
    content: str
    unfit: str = ""


@dataclass(frozen=True)
class _File:
    keys: Mapping[str, str] = field(default_factory=dict)
    absent: Absent | None = None
    result: Mapping[str, Any] = field(default_factory=dict)
    content: str = ""


def write_stage(path: Path, stage: Stage[R], keys: Mapping[str, str], result: R | Absent) -> Stored[R]:
    """Write a stage's result, its arrays first: if the file exists, the stage is finished."""
    if isinstance(result, Absent):
        content = digest(result)
        write_document(path, plain(_File(keys, result, {}, content)))
        return Stored(keys, result, content)
    arrays = dict(getattr(result, "arrays", {})) if _has_arrays(stage) else None
    values = plain(result)
    content = digest([values, {name: _digest_of_array(a) for name, a in sorted((arrays or {}).items())}])
    write_document(path, plain(_File(keys, None, values, content)), arrays)
    return Stored(keys, result, content)


def read_stage(path: Path, stage: Stage[R], remedy: str) -> Stored[R]:
    """Read a stage's result; for a file of another version, ``unfit`` says so.

    Raises:
        InputError: If the file is missing or damaged; the message ends with ``remedy``.
    """
    document = read_document(path, remedy)
    try:
        held = record(_File, document, path.name)
    except InputError as error:
        return _unfit(error)
    if held.absent is not None:
        return Stored(held.keys, held.absent, held.content)
    try:
        result = record(stage.result, held.result, path.name)
    except InputError as error:
        return _unfit(error)
    if _has_arrays(stage):
        result = replace(result, arrays=read_document_arrays(path, remedy))  # type: ignore[type-var]
    return Stored(held.keys, result, held.content)


def _unfit(error: InputError) -> Stored[Any]:
    why = f"another version wrote its result ({error})"
    return Stored({}, Absent(why, failed=True), "", why)


def _has_arrays(stage: Stage[Any]) -> bool:
    return any(f.name == "arrays" for f in fields(stage.result))


def read_as(kind: type[R], version: int, path: Path, command: str) -> R:
    """Read a ``results.json`` of this kind and version; ``command`` writes it.

    Raises:
        InputError: If the file is missing, damaged, or of another version.
    """
    document = read_object(path)
    if (found := document.get("schema_version")) != version:
        raise InputError(
            f"{path}: schema_version is {str(found)[:20]}, but this version reads {version}. Write the file again: "
            f"repeat the command of {command} (of a run with --resume) [HM-WORKFLOW-040]"
        )
    return record(kind, document, str(path))


def differing(before: Mapping[str, str], now: Mapping[str, str]) -> str:
    """Text that names the changed inputs of a stage; empty if none has changed."""
    differ = [name for name, key in now.items() if key and key != before.get(name)]
    differ += [name for name in before if name not in now]
    return f"changed: {', '.join(differ)}" if differ else ""


def changed(before: Mapping[str, str], now: Mapping[str, str]) -> str:
    """Text that names the changed inputs of a stage, and those that cannot be checked; empty if there are none."""
    unknown = [name for name, key in now.items() if not key]
    words = [found] if (found := differing(before, now)) else []
    if unknown:
        words.append(f"{', '.join(unknown)} may have changed: a change cannot be detected")
    return "; ".join(words)


def bring_up_to_date(context: Context, stage: Stage[Any], skip: bool = False) -> str:
    """Run a stage unless its stored result is up to date; returns a text for the terminal.

    With ``skip`` a stage without an up-to-date result is skipped.

    Raises:
        InputError: If a required stage cannot run.
    """
    stored, keys = context.stored(stage), stage.keys(context)
    why = ""
    if stored is not None:
        why = stored.unfit or changed(stored.keys, keys)
        if not why and isinstance(stored.result, Absent):
            why = "it did not run before" if stored.result.failed else ""
        elif not why:
            why = stage.restore(context, stored.result)
        if not why:
            return "up to date"
    if skip:
        context.leave_out(stage, f"stage {stage.name} was skipped")
        return "skipped"
    if why:
        context.progress.warn(f"stage {stage.name} runs again: {why}")
    result = _computed(context, stage)
    context.keep(stage, keys, result)
    return f"could not run: {result.reason}" if isinstance(result, Absent) and result.failed else ""


def _computed(context: Context, stage: Stage[Any]) -> Any:
    """The stage's result, or the reason why an optional stage failed."""
    if not stage.optional:
        return stage.compute(context)
    try:
        with no_exit():
            return stage.compute(context)
    except StorageError:
        raise
    except InputError as error:
        context.progress.warn(f"stage {stage.name} could not run: {error}")
        return Absent(str(error), failed=True)
    except Exception as error:  # an optional stage must not stop the run: keep the traceback and continue
        path = context.out / "checkpoints" / f"{stage.name}.error.txt"
        write_text(path, traceback.format_exc())
        reason = f"{type(error).__name__}: {error} (where: {path.relative_to(context.out)})"
        context.progress.warn(f"stage {stage.name} failed: {reason}")
        return Absent(reason, failed=True)


def _digest_of_array(array: Any) -> str:
    values = np.ascontiguousarray(array)
    return digest([values.dtype.str, list(values.shape), hashlib.sha256(values.tobytes()).hexdigest()])


def source_of(made: object) -> object:
    """Code of a function or class of a scenario: by module, that of its own module and of the modules that it imports.

    Comments, docstrings and the statement ``scenario = ...`` do not count; the scenario's fields are compared
    separately. Installed packages do not count either. ``UNKNOWN`` without a source file; None for None.
    """
    if made is None:
        return None
    while isinstance(made, functools.partial):
        made = made.func
    module = inspect.getmodule(made)
    if module is None or not getattr(module, "__file__", None) or not _is_own_source(made):
        return UNKNOWN
    found: dict[str, str] = {}
    _collect(module, _home(module), found)
    return found


def _is_own_source(made: object) -> bool:
    """Whether the code of ``made`` stands in its module's file; code of ``eval`` or of a console has no file."""
    code = getattr(inspect.unwrap(made) if callable(made) else made, "__code__", None)
    return code is None or Path(code.co_filename).is_file()


def _home(module: ModuleType) -> Path:
    """Folder of the scenario's package; for a single module its file."""
    path = Path(str(module.__file__)).resolve()
    parent = path.parent
    return parent if (parent / "__init__.py").is_file() else path


def _collect(module: ModuleType, home: Path, found: dict[str, str]) -> None:
    path = Path(str(module.__file__)).resolve()
    if path.suffix != ".py":  # compiled: its bytes are its code
        found[module.__name__] = hashlib.sha256(path.read_bytes()).hexdigest()
        return
    tree = ast.parse(path.read_text(encoding="utf-8"))
    found[module.__name__] = _code(tree)
    for name in _imported(tree):
        top = name.partition(".")[0]
        if name in found or top in LIBRARY or top in sys.stdlib_module_names:
            continue
        other = sys.modules.get(name)
        where = getattr(other, "__file__", None)
        if other is None or not where or "site-packages" in where or "dist-packages" in where:
            continue
        _collect(other, home, found)


def _imported(tree: ast.Module) -> Iterator[str]:
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def _code(tree: ast.Module) -> str:
    """The code without docstrings, comments and the statement ``scenario = ...``."""
    own = ["scenario"]
    body = [
        n for n in tree.body if not (isinstance(n, ast.Assign) and list(map(ast.unparse, n.targets)) == own)
    ]
    bare = ast.Module(body, [])
    for node in ast.walk(bare):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            kept = [
                n for n in node.body if not (isinstance(n, ast.Expr) and isinstance(n.value, ast.Constant))
            ]
            node.body = kept or [ast.Pass()]
    return ast.dump(bare)
