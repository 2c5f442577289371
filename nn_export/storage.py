"""Programs on disk: readable JSON beside one safetensors file of weights."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from nn_export.budget import NUMBER, Budget, Limits
from nn_export.errors import ProgramError
from nn_export.files import parse_json, read_bytes, write_bytes
from nn_export.operators.value import size_of
from nn_export.program import Program, Shape, dumps, from_json, shape_of, to_json

FORMAT = "nn_export programs"
SCHEMA = 2
PROGRAMS, WEIGHTS = "programs.json", "weights.safetensors"
# bytes of a weights file beside the numbers, and beside the name of each array
HEADER, HEADER_EACH = 4096, 400


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
        raise ProgramError(
            f"a program contains a value that JSON cannot represent: {error} [NN-084]"
        ) from error
    path = Path(folder)
    write_bytes(path / WEIGHTS, blob)
    write_bytes(path / PROGRAMS, text.encode())


def load_programs(folder: str | Path, limits: Limits | None = None) -> dict[str, Program]:
    """Read what :func:`save_programs` wrote, programs by name. Nothing in the files is executed.

    What the programs would cost is settled from the JSON alone: a small file may ask for any amount of memory and time.

    Args:
        folder: Folder with ``programs.json`` and ``weights.safetensors``.
        limits: What all programs together may cost; the same are to be given to :func:`nn_export.build`. Default:
            :class:`nn_export.Limits`.

    Raises:
        ProgramError: If a file is missing, damaged, foreign, of another schema version, or changed since it was saved;
            if the programs would cost more than the limits.

    Example:
        >>> load_programs("/nowhere")
        Traceback (most recent call last):
        ...
        nn_export.errors.ProgramError: /nowhere/programs.json: no such file; save the programs there first
    """
    path, budget = Path(folder), Budget(limits)
    document = _document(path / PROGRAMS, budget.limits.json_bytes)
    result: dict[str, Program] = {}
    tables: dict[str, dict[str, str]] = {}
    shapes: dict[str, Shape] = {}
    budget.check_count(_operators(document["programs"]), f"{path / PROGRAMS}: ")
    for name, entry in document["programs"].items():
        where = f"{path / PROGRAMS}: programs.{name:.80}"
        if not isinstance(entry, dict) or set(entry) != {"program", "weights"}:
            raise ProgramError(f"{where}: expected the fields program and weights; save it again [NN-085]")
        tables[name], stand_ins = _weights(entry["weights"], shapes, f"{where}.weights", budget)
        result[name] = from_json(entry["program"], stand_ins, where)
        budget.add(result[name], f"{where}: ")
    given = document.pop("sha256", None)
    if given != _content_hash(document):
        raise ProgramError(
            f"{path / PROGRAMS}: its content is not what was saved (field sha256): damaged or changed by hand; "
            "save the programs again [NN-086]"
        )
    tensors = _tensors(path / WEIGHTS, document["weights"]["sha256"], shapes)
    for name, program in result.items():
        program.weights.update({weight: tensors[key] for weight, key in tables[name].items()})
    return result


def _content_hash(document: Mapping[str, Any]) -> str:
    """Hash of what the JSON says, whatever its spaces and line ends."""
    text = json.dumps(document, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def _document(path: Path, limit: int) -> dict[str, Any]:
    remedy = "save the programs again or restore the file"
    try:
        document = parse_json(_content(path, limit))
    except ProgramError:
        raise
    except ValueError as error:
        raise ProgramError(f"{path}: not readable as JSON ({error!s:.80}); {remedy} [NN-087]") from error
    if not isinstance(document, dict) or document.get("format") != FORMAT:
        raise ProgramError(
            f"{path}: field format is not {FORMAT!r}; this file was not written by nn_export [NN-088]"
        )
    if document.get("schema") != SCHEMA:
        raise ProgramError(
            f"{path}: schema {document.get('schema')!r:.40}, this version of nn_export reads {SCHEMA}; "
            "update nn_export or export again [NN-089]"
        )
    weights, programs = document.get("weights"), document.get("programs")
    sha256 = weights.get("sha256") if isinstance(weights, dict) else None
    if not isinstance(sha256, str) or not isinstance(programs, dict):
        raise ProgramError(f"{path}: field weights.sha256 or programs is missing; {remedy} [NN-090]")
    return document


def _operators(programs: Mapping[str, Any]) -> int:
    """How many operators there are, as far as can be seen without reading them."""
    inner = [entry.get("program") for entry in programs.values() if isinstance(entry, dict)]
    nodes = [program.get("nodes") for program in inner if isinstance(program, dict)]
    return sum(len(n) for n in nodes if isinstance(n, list))


def _weights(
    table: Any, shapes: dict[str, Shape], where: str, budget: Budget
) -> tuple[dict[str, str], dict[str, np.ndarray]]:
    """The arrays' names in the file, and stand-ins of their shapes that take no memory.

    ``shapes`` collects the shapes by the arrays' names.
    """
    if not isinstance(table, dict):
        raise ProgramError(f"{where}: expected a table; save the programs again [NN-091]")
    keys, stand_ins = {}, {}
    for name, entry in table.items():
        place = f"{where}.{name:.80}"
        if not isinstance(entry, dict) or set(entry) != {"tensor", "shape"}:
            raise ProgramError(f"{place}: expected the fields tensor and shape; save it again [NN-092]")
        key, shape = entry["tensor"], shape_of(entry["shape"], f"{place}.shape")
        budget.spend(place, elements=size_of(shape))
        if not isinstance(key, str) or shapes.setdefault(key, shape) != shape:
            raise ProgramError(f"{place}: {WEIGHTS} has no such array; save the programs again [NN-093]")
        keys[name], stand_ins[name] = key, np.broadcast_to(np.float64(0.0), shape)
    return keys, stand_ins


def _tensors(path: Path, sha256: str, shapes: Mapping[str, Shape]) -> dict[str, np.ndarray]:
    """The arrays of the weights file, which is not read if it holds more than these and their names."""
    from safetensors import SafetensorError
    from safetensors.numpy import load

    # at most six bytes a character: "\u1234"
    names = HEADER + sum(HEADER_EACH + 6 * len(key) for key in shapes)
    blob = _content(path, sum(NUMBER * size_of(shape) for shape in shapes.values()) + names)
    if hashlib.sha256(blob).hexdigest() != sha256:
        raise ProgramError(
            f"{path}: its hash is not the one in {PROGRAMS} (field weights.sha256): damaged, truncated or of "
            "another model; save the programs again [NN-094]"
        )
    try:
        tensors: dict[str, np.ndarray] = load(blob)
    except (SafetensorError, ValueError, KeyError) as error:
        raise ProgramError(
            f"{path}: no safetensors file ({error}); save the programs again [NN-095]"
        ) from error
    for key, shape in shapes.items():
        if key not in tensors or tensors[key].shape != shape:
            raise ProgramError(
                f"{path}: no array {key:.80} of shape {shape}; save the programs again [NN-096]"
            )
    for name, array in tensors.items():
        if array.dtype != np.float64:
            raise ProgramError(
                f"{path}: {name} is {array.dtype}, float64 is needed; save the programs again [NN-097]"
            )
    return tensors


def _content(path: Path, limit: int) -> bytes:
    try:
        return read_bytes(path, limit)
    except FileNotFoundError as error:
        raise ProgramError(f"{path}: no such file; save the programs there first [NN-098]") from error
    except OSError as error:
        raise ProgramError(f"cannot read {path}: {error.strerror or error} [NN-099]") from error
