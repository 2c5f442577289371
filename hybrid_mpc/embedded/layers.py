"""Networks of a model as products with constant matrices and scalar code between them, for all of nn_export's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.embedded.scalar import SMALL, c_function, scalar_code, table

Array = NDArray[np.float64]


Entry = tuple[int, int, ca.SX]
"""Row, column and expression of a derivative."""
Owner = tuple[int, int, int, tuple[int, ...]]
"""For a layer: index of its first product, number of products, offset of its derivatives, and their columns."""


@dataclass(frozen=True)
class Layer:
    """The product of ``weight`` ``(n, k)`` with ``seen`` ``(x, h, u, w, products of the layers before) -> (k,)``."""

    weight: Array
    seen: ca.Function


def split(point: Sequence[ca.MX], value: ca.MX, what: str) -> tuple[tuple[Layer, ...], ca.Function]:
    """Split an expression at ``point`` into its layers, in order, and ``(*point, all products) -> value``.

    Raises:
        InputError: If the part between the layers cannot be written as scalar code.
    """
    whole = written_out(point, value)
    products = _products(point, whole)
    given: list[ca.MX] = []
    weights: list[Array] = []
    seen: list[ca.MX] = []
    old: list[ca.MX] = []
    new: list[ca.MX] = []
    for node in products:
        bias, left, right = (node.dep(i) for i in range(3))
        turned = bool(ca.symvar(left))  # X W', with samples in rows
        weight = ca.evalf(right.T if turned else left).full()
        samples, addend = ca.graph_substitute([left.T if turned else right, bias], old, new)
        columns = []
        for column in ca.horzsplit(samples):
            given.append(ca.MX.sym(f"m{len(given)}", len(weight)))
            weights.append(weight)
            seen.append(column)
            columns.append(given[-1])
        product = ca.horzcat(*columns)
        old.append(node)
        new.append(addend + (product.T if turned else product))
    (after,) = ca.graph_substitute([whole], old, new)
    layers, m = [], ca.MX.sym("m", sum(v.numel() for v in given))
    ends = np.cumsum([0, *(v.numel() for v in given)])
    parts = [m[int(a) : int(b)] for a, b in pairwise(ends)]
    results = ca.graph_substitute([*seen, after], given, parts) if given else [after]
    for weight, own in zip(weights, results[:-1], strict=True):
        layers.append(Layer(weight, scalar_code(what, ca.Function("layer", [*point, m], [ca.densify(own)]))))
    last = ca.Function("after", [*point, m], [ca.densify(results[-1])])
    return tuple(layers), scalar_code(what, last)


def written_out(point: Sequence[ca.MX], value: ca.MX, but: str = "\0") -> ca.MX:
    """Inline the calls of graphs in an expression, except functions whose names end with ``but``."""
    while True:
        whole = ca.Function("whole", list(point), [value])
        for k in range(whole.n_instructions()):
            call = whole.instruction_MX(k)
            if whole.instruction_id(k) != ca.OP_CALL:
                continue
            f = call.which_function()
            if f.is_a("MXFunction") and not f.name().endswith(but):
                break
        else:
            return value
        inner = ca.graph_substitute(_results(f), f.mx_in(), [call.dep(i) for i in range(f.n_in())])
        (value,) = ca.graph_substitute([value], [call.get_output(i) for i in range(f.n_out())], inner)


def _products(point: Sequence[ca.MX], value: ca.MX) -> list[ca.MX]:
    """Products of an expression with large constant matrices, in order."""
    whole = ca.Function("whole", list(point), [value])
    nodes = [(whole.instruction_id(k), whole.instruction_MX(k)) for k in range(whole.n_instructions())]
    return [n for code, n in nodes if code == ca.OP_MTIMES and _large(n)]


def _large(product: ca.MX) -> bool:
    constant = [not ca.symvar(product.dep(i)) for i in (1, 2)]
    return any(c and product.dep(i + 1).numel() > SMALL for i, c in enumerate(constant)) and not all(constant)


def _results(f: ca.Function) -> list[ca.MX]:
    """Results of a graph as expressions of its own symbols, with the calls of other functions kept."""
    slots: dict[int, Any] = {}
    found: list[list[ca.MX]] = [[] for _ in range(f.n_out())]
    inputs = [ca.vec(v) for v in f.mx_in()]
    for k in range(f.n_instructions()):
        code, taken, made = f.instruction_id(k), f.instruction_input(k), f.instruction_output(k)
        node = f.instruction_MX(k)
        if code == ca.OP_OUTPUT:  # the pieces of an output come in order
            found[made[0]].append(ca.vec(slots[taken[0]]))
        elif code == ca.OP_INPUT:
            first = int(node.info()["offset"])
            piece = inputs[taken[0]][first : first + node.numel()]
            slots[made[0]] = ca.reshape(piece, *node.shape)
        else:
            for i, place in enumerate(made):
                if place >= 0:
                    slots[place] = node.get_output(i) if node.has_output() else node
    return [ca.reshape(ca.vertcat(*pieces), *f.size_out(i)) for i, pieces in enumerate(found)]


@dataclass(frozen=True)
class LayerCode:
    """C of layers.

    Args:
        text: Tables and functions.
        products: Number of products.
        through: Number of reals that the derivatives need.
        operations: Scalar operations by function.
        owners: Indices of each layer.
    """

    text: str
    products: int
    through: int
    operations: dict[str, int]
    owners: tuple[Owner, ...]


def layer_code(
    name: str, layers: Sequence[Layer], symbols: Sequence[ca.SX], by: ca.SX | None = None, places: Sequence[int] = (),
    *, known: Mapping[bytes, str] | None = None,
) -> LayerCode:  # fmt: skip
    """Write the functions ``{name}(z, u, w, m)`` and, with ``by``, ``{name}_slope(z, u, w, m, through)``.

    Args:
        name: Prefix of all names.
        layers: The layers, in order.
        symbols: ``z, u, w`` of the model, as scalars.
        by: Those of these symbols with respect to which derivatives are written. Default: no derivatives.
        places: Column in the Jacobian of each entry of ``by``.
        known: Names of existing tables by the content of their weights (:func:`tables_of`). Default: none.

    Raises:
        InputError: If an operation cannot be written as C, or there are too many operations.
    """
    z, u, w = symbols
    sizes = [len(layer.weight) for layer in layers]
    first = np.cumsum([0, *sizes])
    m = ca.SX.sym("m", int(first[-1]))
    read = {"z": z, "u": u, "w": w, "m": m}
    arguments = [f"const real *{key}" for key in read]
    n_x = layers[0].seen.numel_in(0) if layers else 0
    texts, operations, shared = [], dict[str, int](), dict(known or {})
    owners: list[Owner] = []
    forward, backward, through = [], [], 0
    for i, layer in enumerate(layers):
        own, (rows, columns) = f"{name}{i}", layer.weight.shape
        seen = layer.seen(z[:n_x], z[n_x:], u, w, m)
        outs = [(f"seen[{k}]", seen[k]) for k in range(columns)]
        text, operations[f"{own}_seen"] = c_function(f"{own}_seen", [*arguments, "real *seen"], read, outs)
        key = _key(layer)
        if key not in shared:
            shared[key] = f"{own}_weight"
            texts.append(table(shared[key], layer.weight))
        weight = f"{shared[key]}[0], {rows}, {columns}"
        at = f"m + {first[i]}"
        texts.append(text)
        forward.append(
            f"  {{\n    real seen[{columns}];\n    {own}_seen(z, u, w, m, seen);\n"
            f"    hmpc_layer({weight}, seen, {at});\n  }}\n"
        )
        if by is None:
            continue
        by_v, by_m = ca.jacobian(seen, by), ca.jacobian(seen, m)
        passed = _passed(by_m, owners)
        active = sorted(
            {places[c] for c in by_v.sparsity().get_triplet()[1]} | {c for k in passed for c in owners[k][3]}
        )
        where = {c: k for k, c in enumerate(active)}
        n, entries = max(1, len(active)), _entries(by_v)
        pattern = np.zeros((columns, n), dtype=bool)
        for r, c, _ in entries:
            pattern[r, where[places[c]]] = True
        slope_outs = [(f"by_v[{k}]", value) for k, (*_, value) in enumerate(entries)]
        steps, count = [], len(entries)
        texts.append(table(f"{own}_row", [r for r, *_ in entries], "int"))
        texts.append(table(f"{own}_column", [where[places[c]] for _, c, _ in entries], "int"))
        for k, chosen in passed.items():
            text, step = _pass(
                f"{own}_{k}", owners[k], chosen, [where[c] for c in owners[k][3]], count, "g[0]", n
            )
            texts.append(text)
            steps.append(step)
            slope_outs += [(f"by_v[{count + j}]", value) for j, (*_, value) in enumerate(chosen)]
            count += len(chosen)
            for r, *_ in chosen:
                pattern[r, [where[c] for c in owners[k][3]]] = True
        # maximum number of derivatives of an element of a layer's argument that are multiplied one by one
        full = np.flatnonzero(pattern.sum(axis=1) > 4)
        pattern[full] = False
        rest = np.argwhere(pattern)
        texts += [
            table(f"{own}_few", rest[:, 0], "int"), table(f"{own}_by", rest[:, 1], "int"),
            table(f"{own}_full", full, "int"),
        ]  # fmt: skip
        text, operations[f"{own}_slopes"] = c_function(
            f"{own}_slopes", [*arguments, "real *seen", "real *by_v"], read, outs + slope_outs
        )
        texts.append(text)
        backward.append(
            f"  {{\n    real seen[{columns}], by_v[{max(1, count)}], g[{columns}][{n}];\n"
            f"    {own}_slopes(z, u, w, m, seen, by_v);\n    memset(g, 0, sizeof g);\n"
            f"    for (int e = 0; e < {len(entries)}; ++e) g[{own}_row[e]][{own}_column[e]] = by_v[e];\n"
            f"{''.join(steps)}    hmpc_layer({weight}, seen, {at});\n"
            f"    hmpc_layer_slope({weight}, g[0], {n}, {own}_few, {own}_by, {len(rest)}, {own}_full, {full.size}, "
            f"through + {through});\n  }}\n"
        )
        operations[f"{own}_products"] = 2 * rows * (len(rest) + full.size * n) + 2 * rows * columns
        owners.append((int(first[i]), rows, through, tuple(active)))
        through += rows * n
    unused = "".join(f"  (void){key};\n" for key in read)
    texts.append(
        f"static inline void {name}(const real *z, const real *u, const real *w, real *m) {{\n{unused}"
    )
    texts.append("".join(forward) + "}\n")
    if by is not None:
        texts.append(
            f"static inline void {name}_slope(const real *z, const real *u, const real *w, real *m, real *through) {{\n"
            f"{unused}  (void)through;\n{''.join(backward)}}}\n"
        )
    return LayerCode("".join(texts), int(first[-1]), through, operations, tuple(owners))


def tables_of(name: str, layers: Sequence[Layer]) -> dict[bytes, str]:
    """Names of the tables that :func:`layer_code` writes, by the content of their weights."""
    found: dict[bytes, str] = {}
    for i, layer in enumerate(layers):
        found.setdefault(_key(layer), f"{name}{i}_weight")
    return found


def _key(layer: Layer) -> bytes:
    return layer.weight.tobytes() + str(layer.weight.shape).encode()


def _entries(matrix: ca.SX) -> list[Entry]:
    """Row, column and expression of the structural nonzeros of a matrix."""
    rows, columns = matrix.sparsity().get_triplet()
    return [(r, c, matrix[r, c]) for r, c in zip(rows, columns, strict=True)]


def _passed(by_m: ca.SX, owners: Sequence[Owner]) -> dict[int, list[Entry]]:
    """Derivatives with respect to the products, by layer of the product."""
    found: dict[int, list[Entry]] = {}
    ends = [first + n for first, n, *_ in owners]
    for r, c, value in _entries(by_m):
        k = int(np.searchsorted(ends, c, side="right"))
        found.setdefault(k, []).append((r, c, value))
    return found


def _pass(
    name: str, owner: Owner, chosen: Sequence[Entry], onto: Sequence[int],
    at: int, to: str, stride: int | str,
) -> tuple[str, str]:  # fmt: skip
    """Tables, and a statement of the chain rule that adds a layer's derivatives times the ``chosen`` ones to others."""
    first, _, through, active = owner
    text = table(f"{name}_at", [r for r, *_ in chosen], "int")
    text += table(f"{name}_from", [c - first for _, c, _ in chosen], "int") + table(
        f"{name}_onto", onto, "int"
    )
    n = max(1, len(active))
    return text, (
        f"    hmpc_layer_pass({name}_at, {name}_from, by_v + {at}, {len(chosen)}, through + {through}, {n}, "
        f"{name}_onto, {len(active)}, {to}, {stride});\n"
    )


def after_code(
    name: str, value: ca.SX, m: ca.SX, code: LayerCode
) -> tuple[str, list[tuple[str, ca.SX]], list[int]]:
    """Write a function ``{name}(by_v, through, slope)`` that adds the effect of the layers to a Jacobian.

    Returns:
        The function, the derivatives with respect to products that it reads, and the rows that it changes.
    """
    texts, steps, rows = [], [], set[int]()
    outs: list[tuple[str, ca.SX]] = []
    for k, chosen in _passed(ca.jacobian(value, m), code.owners).items():
        text, step = _pass(
            f"{name}_{k}", code.owners[k], chosen, code.owners[k][3], len(outs), "slope", "HMPC_LJ"
        )
        texts.append(text)
        steps.append(step)
        outs += [(f"by_out[{len(outs) + j}]", v) for j, (*_, v) in enumerate(chosen)]
        rows |= {r for r, *_ in chosen}
    texts.append(
        f"static inline void {name}(const real *by_v, const real *through, real *slope) {{\n"
        f"  (void)by_v;\n  (void)through;\n  (void)slope;\n{''.join(steps)}}}\n"
    )
    return "".join(texts), outs, sorted(rows)
