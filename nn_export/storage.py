"""Programs on disk: readable JSON beside one safetensors file of weights."""

from __future__ import annotations

import hashlib
import json
import math
import os
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nn_export.errors import ProgramError
from nn_export.program import Program, dumps, from_json, shape_of, to_json

FORMAT = "nn_export programs"
SCHEMA = 2
PROGRAMS, WEIGHTS = "programs.json", "weights.safetensors"
MAX_JSON = 64 * 2**20  # bytes
MAX_WEIGHTS = 2**30  # bytes
MAX_DEPTH = 40  # of nested JSON: arguments are lists of lists at most


def save_programs(folder: str | Path, programs: Mapping[str, Program]) -> None:
    """Write named programs with one shared weights file; other files of the folder are left alone.

    Equal arrays are stored once. Each file is replaced in one step; the JSON carries the hash of the
    weights and one of its own content, so that damage, or a pair which does not belong together, is noticed
    on loading.

    Args:
        folder: Folder, made if missing.
        programs: Programs by name.

    Raises:
        ProgramError: If a program cannot be written as JSON.

    Example:
        >>> import tempfile
        >>> from nn_export import Port
        >>> identity = Program((Port("x", (2,)),), (Port("y", (2,), {"input": "x"}),), ())
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_programs(folder, {"identity": identity})
        ...     print(list(load_programs(folder)))
        ['identity']
    """
    from safetensors.numpy import save

    tensors: dict[str, np.ndarray] = {}
    keys: dict[tuple[Any, ...], str] = {}
    entries = {}
    for name, program in programs.items():
        table = {}
        for weight, array in program.weights.items():
            data = np.array(array, dtype=np.float64, order="C")
            key = keys.setdefault((data.shape, data.tobytes()), f"{name}/{weight}")
            tensors.setdefault(key, data)
            table[weight] = {"tensor": key, "shape": list(data.shape)}
        entries[name] = {"program": to_json(program), "weights": table}
    blob = save(tensors)
    document = {
        "format": FORMAT,
        "schema": SCHEMA,
        "weights": {"file": WEIGHTS, "sha256": hashlib.sha256(blob).hexdigest()},
        "programs": entries,
    }
    try:
        document["sha256"] = _content_hash(document)
        text = dumps(document)
    except (TypeError, ValueError, RecursionError) as error:
        raise ProgramError(f"a program holds something that JSON has no form for: {error}") from error
    path = Path(folder)
    path.mkdir(parents=True, exist_ok=True)
    _write(path / WEIGHTS, blob)
    _write(path / PROGRAMS, text.encode())


def load_programs(folder: str | Path) -> dict[str, Program]:
    """Read what :func:`save_programs` wrote. Nothing in the files is executed.

    Args:
        folder: Folder with ``programs.json`` and ``weights.safetensors``.

    Returns:
        Programs by name.

    Raises:
        ProgramError: If a file is missing, damaged, foreign, larger than 64 MiB (JSON) or 1 GiB
            (weights), of another schema version, or changed since it was saved.

    Example:
        >>> load_programs("/nowhere")
        Traceback (most recent call last):
        ...
        nn_export.errors.ProgramError: /nowhere/programs.json: no such file; save the programs there first
    """
    path = Path(folder)
    document = _document(path / PROGRAMS)
    tensors = _tensors(path / WEIGHTS, str(document["weights"]["sha256"]))
    result = {}
    for name, entry in document["programs"].items():
        where = f"{path / PROGRAMS}: programs.{name}"
        if not isinstance(entry, dict) or set(entry) != {"program", "weights"}:
            raise ProgramError(f"{where}: expected the fields program and weights; save it again")
        weights = _weights(entry["weights"], tensors, f"{where}.weights")
        result[name] = from_json(entry["program"], weights, where)
    given = document.pop("sha256", None)
    if given != _content_hash(document):
        raise ProgramError(
            f"{path / PROGRAMS}: its content is not what was saved (field sha256): damaged or changed by hand; "
            "save the programs again"
        )
    return result


def _content_hash(document: Mapping[str, Any]) -> str:
    """Hash of what the JSON says, whatever its spaces and line ends."""
    text = json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _weights(table: Any, tensors: dict[str, np.ndarray], where: str) -> dict[str, np.ndarray]:
    if not isinstance(table, dict):
        raise ProgramError(f"{where}: expected a table; save the programs again")
    weights = {}
    for name, entry in table.items():
        if not isinstance(entry, dict) or set(entry) != {"tensor", "shape"}:
            raise ProgramError(f"{where}.{name}: expected the fields tensor and shape; save it again")
        array = tensors.get(entry["tensor"]) if isinstance(entry["tensor"], str) else None
        if array is None or array.shape != shape_of(entry["shape"], f"{where}.{name}.shape"):
            raise ProgramError(f"{where}.{name}: {WEIGHTS} has no such array; save the programs again")
        weights[name] = array
    return weights


def _document(path: Path) -> dict[str, Any]:
    remedy = "save the programs again or restore the file"
    try:
        document = json.loads(_read(path, MAX_JSON), parse_constant=_refuse, parse_float=_finite)
    except (ValueError, RecursionError) as error:
        if isinstance(error, ProgramError):
            raise
        raise ProgramError(f"{path}: not readable as JSON ({error!s:.80}); {remedy}") from error
    if _too_deep(document):
        raise ProgramError(f"{path}: nested deeper than {MAX_DEPTH} levels; {remedy}")
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise ProgramError(f"{path}: field format is not {FORMAT!r}; this file was not written by nn_export")
    if document.get("schema") != SCHEMA:
        raise ProgramError(
            f"{path}: schema {document.get('schema')!r:.40}, this version of nn_export reads {SCHEMA}; "
            "update nn_export or export again"
        )
    weights, programs = document.get("weights"), document.get("programs")
    if not isinstance(weights, dict) or "sha256" not in weights or not isinstance(programs, dict):
        raise ProgramError(f"{path}: field weights.sha256 or programs is missing; {remedy}")
    return document


def _tensors(path: Path, sha256: str) -> dict[str, np.ndarray]:
    from safetensors import SafetensorError
    from safetensors.numpy import load

    blob = _read(path, MAX_WEIGHTS)
    if hashlib.sha256(blob).hexdigest() != sha256:
        raise ProgramError(
            f"{path}: its hash is not the one in {PROGRAMS} (field weights.sha256): damaged, truncated or of "
            "another model; save the programs again"
        )
    try:
        tensors: dict[str, np.ndarray] = load(blob)
    except (SafetensorError, ValueError, KeyError) as error:
        raise ProgramError(f"{path}: no safetensors file ({error}); save the programs again") from error
    for name, array in tensors.items():
        if array.dtype != np.float64:
            raise ProgramError(f"{path}: {name} is {array.dtype}, float64 is needed; save the programs again")
    return tensors


def _refuse(name: str) -> Any:
    raise ValueError(f"{name} is not JSON")


def _finite(text: str) -> float:
    if math.isinf(value := float(text)):
        raise ValueError(f"{text:.20} is too large")
    return value


def _too_deep(data: Any) -> bool:
    level = [data]
    for _ in range(MAX_DEPTH):
        inner = [v.values() if isinstance(v, dict) else v for v in level if isinstance(v, dict | list)]
        level = [v for values in inner for v in values]
        if not level:
            return False
    return True


def _read(path: Path, limit: int) -> bytes:
    if not path.is_file():
        raise ProgramError(f"{path}: no such file; save the programs there first")
    size = path.stat().st_size
    if size > limit:
        raise ProgramError(f"{path}: {size} bytes, at most {limit} are read; it is no file of nn_export")
    try:
        return path.read_bytes()
    except OSError as error:
        raise ProgramError(f"{path}: cannot be read ({error}); check its permissions") from error


def _write(path: Path, data: bytes) -> None:
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(name, 0o644)
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise
