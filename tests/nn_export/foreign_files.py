"""Programs that somebody else wrote: small files that ask for gigabytes or minutes, and how they fare.

As a script (``python foreign_files.py FOLDER``) it loads every program in the folders of a folder, with little memory,
builds those that load, and prints a line of JSON for each.
"""

import hashlib
import json
import sys
import time
from pathlib import Path

import numpy as np
from safetensors.numpy import save

from nn_export import budget, storage
from nn_export.operators import OPERATORS

MEMORY = 3 * 2**29
"""Bytes of address space that the process has: 1.5 GiB."""
LARGE = [
    10**4, 10**6, 10**9, 2**31 - 1, 2**40, 10**18, -1, -(10**9), 0, 1, 2, 3, 7, True, None, 0.5, 1e300, "3.0", [],
]  # fmt: skip
"""What numbers are replaced by."""
X, H = {"input": "x"}, {"input": "h"}
GRU = [{"weight": name} for name in "abcd"]
TABLE = {"a": ("matrix", (3, 1)), "b": ("matrix", (3, 1)), "c": ("vector", (3,)), "d": ("vector", (3,))}
TENSORS = {"matrix": np.ones((3, 1)), "vector": np.ones(3)}


def signed(document):
    """A foreign file may well carry a right hash."""
    document.pop("sha256", None)
    document["sha256"] = storage._content_hash(document)
    return json.dumps(document).encode()


def files(programs, table=None, tensors=None):
    """The two files of some programs, which share a table of weights."""
    blob = save(tensors or {})
    weights = {name: {"tensor": key, "shape": list(shape)} for name, (key, shape) in (table or {}).items()}
    document = {
        "format": storage.FORMAT,
        "schema": storage.SCHEMA,
        "weights": {"file": storage.WEIGHTS, "sha256": hashlib.sha256(blob).hexdigest()},
        "programs": {name: {"program": program, "weights": weights} for name, program in programs.items()},
    }
    return {storage.PROGRAMS: signed(document), storage.WEIGHTS: blob}


def node(name, op, args, *shapes, **kwargs):
    return {"name": name, "op": f"aten.{op}" if op != "getitem" else op, "args": args, "kwargs": kwargs,
            "shapes": [list(s) for s in shapes], "line": ""}  # fmt: skip


def program(nodes, source, shape, **inputs):
    """A program with one output."""
    ports = [{"name": name, "shape": list(given)} for name, given in inputs.items()]
    return {"inputs": ports, "outputs": [{"name": "y", "shape": list(shape), "source": source}], "nodes": nodes,
            "metadata": {}}  # fmt: skip


def one(op, args, shape=(2,), **inputs):
    """A program of one operator, and the shape that it declares."""
    return files(
        {"p": program([node("n", op, args, shape)], {"node": "n"}, shape, **(inputs or {"x": (2,)}))}
    )


def chain(op, count, sizes, args=lambda before: [before, before], **inputs):
    """Operators each of which takes the result before it."""
    nodes, source = [], X
    for k, size in zip(range(count), sizes, strict=False):
        nodes.append(node(f"n{k}", op, args(source), (size,)))
        source = {"node": f"n{k}"}
    shape = nodes[-1]["shapes"][0]
    return files({"p": program(nodes, source, shape, **(inputs or {"x": (2,)}))})


def gru(steps, layers=1, params=None):
    args = [X, H, GRU * layers if params is None else params, True, layers, 0.0, False, False, False]
    last = node("i", "getitem", [{"node": "g"}, 1], (layers, 1, 1))
    nodes = [node("g", "gru.input", args, (steps, 1, 1), (layers, 1, 1)), last]
    whole = program(nodes, {"node": "i"}, (layers, 1, 1), x=(steps, 1, 1), h=(layers, 1, 1))
    return files({"p": whole}, TABLE, TENSORS)


def constants(count, use):
    """A chain of constants, worked out again for each of the operators that take it as positions."""
    nodes = [node("c0", "arange.start_step", [0, 4], (4,))]
    nodes += [node(f"c{k}", "mul.Tensor", [{"node": f"c{k - 1}"}, 1], (4,)) for k in range(1, count)]
    last = {"node": f"c{count - 1}"}
    nodes += [node(f"s{k}", "index_select.default", [X, 0, last], (4,)) for k in range(use)]
    return files({"p": program(nodes, {"node": "s0"}, (4,), x=(4,))})


def shaped(shape):
    """A program whose input and output have a shape that may be none."""
    whole = program([], X, [], x=[])
    whole["inputs"][0]["shape"] = whole["outputs"][0]["shape"] = shape
    return files({"p": whole})


def crafted():
    """Files that must be refused, by name."""
    big, doubling = 10**9, [2 ** (k + 2) for k in range(40)]
    expression = [
        node(f"e{k}", "sin.default", [X if k == 0 else {"node": f"e{k - 1}"}], (1, 1)) for k in range(2000)
    ]
    cells = [node(f"g{k}", "gru_cell.default", [{"node": "e1999"}, H, *GRU], (1, 1)) for k in range(200)]
    selects = [node(f"n{k}", "select.int", [X, 0, 0], ()) for k in range(200)]
    indexed = [
        node(f"i{k}", "index.Tensor", [{"node": f"i{k - 1}"}, [{"node": f"i{k - 1}"}]], (10**5,))
        for k in range(1, 99)
    ]
    multiplied = [
        node(f"i{k}", "mm.default", [{"node": f"i{k - 1}"}] * 2, (10**3, 10**3)) for k in range(1, 40)
    ]
    return {
        "arange": one("arange.start_step", [0, big], (big,)),
        "arange of another shape": one("arange.start_step", [0, big]),
        "arange in small steps": one("arange.start_step", [0, 1, 1e-9]),
        "arange of no length": one("arange.start_step", [0, {"float": "nan"}]),
        "pad": one("constant_pad_nd.default", [X, [big, 0]]),
        "pad of two axes": one("constant_pad_nd.default", [X, [10**4, 0, 10**4, 0]], x=(2, 2)),
        "repeat": one("repeat.default", [X, [big]]),
        "repeat of a million factors": one("repeat.default", [X, [10**18] * 10**5]),
        "expand": one("expand.default", [X, [big, 2]]),
        "expand to nothing": one("expand.default", [X, [0, big, 2]], (0, big, 2)),
        "full": one("full.default", [[3 * 10**4, 3 * 10**4], 1.0]),
        "full of nothing": one("full.default", [[0, big], 1.0], (0, big)),
        "empty": one("empty.memory_format", [[10**12]]),
        "broadcast": one("add.Tensor", [X, H], (60_000, 60_000), x=(60_000, 1), h=(1, 60_000)),
        "broadcast of another shape": one("add.Tensor", [X, H], x=(60_000, 1), h=(1, 60_000)),
        "outer product": one("mm.default", [X, H], x=(60_000, 1), h=(1, 60_000)),
        "large product": one("mm.default", [X, X], (2000, 2000), x=(2000, 2000)),
        "three axes": one("_trilinear.default", [X, X, X, [1, 2], [0, 2], [0, 1], []], x=(2000,)),
        "windows": one("unfold.default", [X, 0, 20_000, 1], x=(40_000,)),
        "gather": one("gather.default", [X, 0, H], x=(1, 60_000), h=(60_000,)),
        "embedding": one("embedding.default", [X, H], x=(1, 60_000), h=(60_000,)),
        "view of nothing": one("view.default", [X, [10**6, 0, 10**6]], (10**6, 0, 10**6), x=(0,)),
        "groups of nothing": one("native_group_norm.default", [X, None, None, 10**6, 0, 1, 10**6, 1e-5], x=(0,)),
        "running sum": one("cumsum.default", [X, 0], (10**6,), x=(10**6,)),
        "running product": one("cumprod.default", [X, 0], (10**5,), x=(10**5,)),
        "product of all": one("prod.default", [X], (), x=(10**6,)),
        "largest of all": one("max.default", [X], (), x=(10**6,)),
        "softmax": one("_softmax.default", [X, 0, False], (10**6,), x=(10**6,)),
        "pieces of negative size": one("split_with_sizes.default", [X, [2, -2] * 20_000 + [2]]),
        "a list for a position": one("select.int", [X, 0, [0] * 10**5], x=(2, 20_000)),
        "a list for a number": one("hardtanh.default", [X, [0.0] * 10**5, 1.0], x=(2000,)),
        "a list for a factor": one("elu.default", [X, [1.0] * 10**6]),
        "200000 steps": gru(200_000),
        "10000 layers": gru(1, 10**4),
        "1e9 layers of none": gru(1, 10**9, GRU),
        "no layers": gru(1, 0, GRU),
        "cat of itself": chain("cat.default", 30, doubling, lambda x: [[x, x], 0]),
        "cat of itself, of another shape": chain("cat.default", 30, [2] * 30, lambda x: [[x, x], 0]),
        "outer sums of itself": chain("add.Tensor", 100, [4 * 10**6] * 100, x=(4 * 10**6,)),
        "constants once more": constants(1000, 500),
        "positions of positions": files({"p": program(
            [node("i0", "arange.start_step", [0, 10**5], (10**5,)), *indexed], X, (2,), x=(2,))}),
        "products of constants": files({"p": program(
            [node("i0", "full.default", [[10**3, 10**3], 0.0], (10**3, 10**3)), *multiplied,
             node("s", "index_select.default", [X, 0, {"node": "i39"}], (10**6,))], {"node": "s"}, (10**6,), x=(2,))}),
        "an expression for many cells": files(
            {"p": program([*expression, *cells], {"node": "g0"}, (1, 1), x=(1, 1), h=(1, 1))}, TABLE, TENSORS),
        "parts of a large input": files({"p": program(selects, {"node": "n0"}, (), x=(4 * 10**6,))}),
        "many operators": chain("t.default", 90_000, [2] * 90_000, lambda x: [x]),
        "many programs": files({f"m{k}/step": program([], X, (2,), x=(2,)) for k in range(2500)}),
        "many inputs": files({"p": program([], {"input": "x0"}, (), **{f"x{k}": () for k in range(10**5)})}),
        "many names of a weight": files(
            {"p": program([], X, (2,), x=(2,))}, {f"w{k}": ("t", (1000, 1000)) for k in range(5000)},
            {"t": np.zeros((1000, 1000))}),
        "a weight that is not there": files({"p": program([], X, (2,), x=(2,))}, {"w": ("t", (2,))}),
        "a weight of 2**62 numbers": files(
            {"p": program([], X, (2,), x=(2,))}, {"w": ("t", (2**31 - 1, 2**31 - 1))}, {"t": np.zeros(2)}),
        "a weight of nothing": files(
            {"p": program([], X, (2,), x=(2,))}, {"w": ("t", (0, big))}, {"t": np.zeros((0, big))}),
        **{f"shape {shape}": shaped(shape) for shape in (
            [big], [0, 10**12], [0, big], [-1], [True], ["3.0"], [3.0], [10**19], [1] * 17, [2**30] * 2, None, [[]])},
    }  # fmt: skip


def mutated(document, rng):
    """The document of some programs with a few numbers, references or operators changed, and signed."""
    from nn_export.operators import OPERATORS

    document = json.loads(json.dumps(document))
    wanted = {
        "number": lambda key, value: type(value) in (int, float),
        "value": lambda key, value: True,
        "swap": lambda key, value: True,
        "operator": lambda key, value: key == "op",
        "repeat": lambda key, value: isinstance(value, list) and value and len(json.dumps(value)) < 200,
    }
    for _ in range(rng.randint(1, 2)):
        found = places(document["programs"])
        kind = rng.choice(["number", "number", *wanted])
        fitting = [(holder, key) for holder, key in found if wanted[kind](key, holder[key])]
        if not fitting:
            continue
        holder, key = rng.choice(fitting)
        if kind == "repeat":
            holder[key] = holder[key] * rng.choice([2, 100, 10_000])
        elif kind == "operator":
            holder[key] = rng.choice(sorted(OPERATORS))
        else:
            other, from_ = rng.choice(found)
            holder[key] = json.loads(json.dumps(other[from_])) if kind == "swap" else rng.choice(LARGE)
    return signed(document)


def places(data):
    """All containers of a JSON document with their keys."""
    items = data.items() if isinstance(data, dict) else enumerate(data) if isinstance(data, list) else ()
    return [place for key, value in items for place in [(data, key), *places(value)]]


def write(folder, cases):
    """Each case, a mapping of files, into a folder of its own under its number; the names in order."""
    for k, case in enumerate(cases.values()):
        (folder / f"{k:05}").mkdir()
        for name, content in case.items():
            (folder / f"{k:05}" / name).write_bytes(content)
    return list(cases)


def judge(folder, then=("load",)):
    """Load, and by request build, the program in a folder: what came of it, and what it took."""
    from nn_export import ExportError, SideBySide, build, load_programs, with_jacobian

    steps = {"build": build, "with_jacobian": with_jacobian, "side_by_side": lambda p: SideBySide(p, 3)}
    outcome = {"refused": None, "seconds": {}}
    programs = {}
    for step in then:
        start = time.process_time()
        try:
            if step == "load":
                programs = load_programs(folder)
            else:
                for loaded in programs.values():
                    steps[step](loaded)
        except ExportError as error:
            outcome["refused"] = f"{step}: {error!s:.1000}"
        outcome["seconds"][step] = time.process_time() - start
    return outcome


def main():
    import resource
    import traceback

    folder, *then = sys.argv[1:]
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    cases = sorted(Path(folder).iterdir())
    judge(cases[0], then)  # now all modules are there
    for op in OPERATORS:  # annotations of the package's own operators are evaluated once: no code of a file
        budget._signature(op)
    seen = set()
    sys.addaudithook(lambda event, args: seen.add(event))
    for case in cases:
        seen.clear()
        try:
            outcome = judge(case, then)
        except BaseException:
            outcome = {"error": traceback.format_exc()[-2000:]}
        outcome["events"] = sorted(seen)
        status = Path("/proc/self/status").read_text()  # getrusage counts the process before this one, too
        outcome["peak"] = 1024 * int(status.split("VmHWM:")[1].split()[0])
        print(json.dumps(outcome), flush=True)


if __name__ == "__main__":
    main()
