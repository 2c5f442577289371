"""Cut of a model's step at its network: scalar code, weights of a GRU or of layers, scalar code."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.embedded.layers import Layer, split, written_out
from hybrid_mpc.embedded.scalar import scalar_code
from hybrid_mpc.model.model import HybridModel, inlined

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Cell:
    """Weights of a GRU in torch's form, gates r, z, n one below the other, and index of its first state in ``h``."""

    input_weight: Array
    hidden_weight: Array
    input_bias: Array
    hidden_bias: Array
    first: int

    @property
    def units(self) -> int:
        """Number of units."""
        return int(self.hidden_weight.shape[1])

    def same(self, other: Cell | None) -> bool:
        """Whether both cells have the same weights and states."""
        names = ("input_weight", "hidden_weight", "input_bias", "hidden_bias")
        return (
            other is not None
            and self.first == other.first
            and all(np.array_equal(getattr(self, name), getattr(other, name)) for name in names)
        )


@dataclass(frozen=True)
class Cut:
    """A step, or rates, as scalar code and network.

    Args:
        before: ``(x, h, u, w) -> features`` of a network that is one GRU; else None.
        cell: Weights of that GRU; else None.
        after: ``(x, h, u, w, units) -> z_next``; ``units`` is the cell's new state, or the products of all layers.
        layers: Layers of any other network. Default: none.
    """

    before: ca.Function | None
    cell: Cell | None
    after: ca.Function
    layers: tuple[Layer, ...] = ()


def cut(model: HybridModel, of: str = "step", *, layered: bool = False) -> Cut:
    """Cut the step of a model, or its rates (``of="xdot"``), with constant parameters; ``layered``: a GRU as layers.

    Raises:
        InputError: If the part between the layers cannot be written as scalar code.

    Example:
        >>> from hybrid_mpc.machine.signals import Signal
        >>> x, u, level = ca.SX.sym("x"), ca.SX.sym("u"), (Signal("x", "m"),)
        >>> tank = HybridModel.of("tank", 1.0, level, (Signal("u", "m/s"),), level, x=x, u=u, x_next=x + u, xdot=u, y=x)
        >>> cut(tank).cell is None
        True
    """
    sizes = model.n_x, model.n_h, model.n_u, model.n_w
    point = [ca.MX.sym(name, n) for name, n in zip("xhuw", sizes, strict=True)]
    z_next: Any = ca.vertcat(*inlined(getattr(model, of), [*point, ca.MX(ca.DM(model.p))]))
    z_next = written_out(point, z_next, but="_cell")
    whole = ca.Function(of, point, [z_next])
    calls = [
        whole.instruction_MX(k)
        for k in range(whole.n_instructions())
        if whole.instruction_id(k) == ca.OP_CALL
    ]
    cells = [c for c in calls if c.which_function().name().endswith("_cell")]
    names = [c.which_function().name() for c in cells]
    if names == ["gru_cell"] and not layered:
        found = _gru(model, of, point, z_next, cells[0])
        if found is not None:
            return found
    layers, after = split(point, z_next, f"model {model.name}: its {of}")
    return Cut(None, None, after, layers)


def _gru(model: HybridModel, of: str, point: list[ca.MX], z_next: ca.MX, call: ca.MX) -> Cut | None:
    """Cut a step at its only GRU cell.

    None if this is not possible: the cell's previous state is not a part of the model's hidden state, or the scalar
    code is too large.
    """
    seen: ca.MX = call.dep(0)
    hidden, new = call.dep(1), call.get_output(0)
    units = ca.MX.sym("units", new.shape[0])
    (behind,) = ca.graph_substitute([z_next], [new], [units])
    first = _place(model, point, hidden)
    if first is None:
        return None
    before = ca.Function("features", point, [ca.densify(seen)])
    after = ca.Function(of, [*point, units], [ca.densify(behind)])
    what = f"model {model.name}: its"
    found = Cut(
        scalar_code(f"{what} features", before),
        Cell(*_weights(call.which_function()), first),
        scalar_code(f"{what} {of}", after),
    )
    parts = (found.before, found.after)
    # maximum scalar operations before or behind a GRU cell; with more, all networks are exported as layers
    if max(f.n_instructions() for f in parts if f is not None) > 10_000:
        return None
    kept = of == "xdot" or _kept(model, found)
    return found if kept else None


def _kept(model: HybridModel, found: Cut) -> bool:
    """Whether the cell's new state is the next hidden state without changes, unit by unit."""
    point = [ca.SX.sym(n, found.after.numel_in(i)) for i, n in enumerate(("x", "h", "u", "w", "units"))]
    z_next, g = found.after(*point), point[-1]
    own = next_places(z_next, g)
    first = min(own, default=0)
    return [own.get(first + k) for k in range(g.numel())] == list(range(g.numel()))


def next_places(z_next: ca.SX, units: ca.SX) -> dict[int, int]:
    """Entries of a step that equal a unit of the cell: number of the unit by index of the entry."""
    pairs = ((i, k) for i in range(z_next.numel()) for k in range(units.numel()))
    return {i: k for i, k in pairs if ca.is_equal(z_next[i], units[k], 0)}


def _place(model: HybridModel, point: list[ca.MX], hidden: ca.MX) -> int | None:
    """Index in ``h`` of the cell's first previous state; None if the previous state is not a part of ``h``."""
    h = point[1]
    slope = ca.Function("slope", point, [ca.densify(ca.jacobian(hidden, h)), hidden])
    rng = np.random.default_rng(0)
    given = [rng.standard_normal(s.numel()) for s in point]
    rows, value = (v.full() for v in slope(*given))
    if not rows.size:
        return None
    first = int(np.argmax(rows[0]))
    wanted = np.eye(hidden.shape[0], model.n_h, first)
    if not np.array_equal(rows, wanted):
        return None
    return first if np.array_equal(value[:, 0], given[1][first : first + len(rows)]) else None


def _weights(cell: ca.Function) -> tuple[Array, Array, Array, Array]:
    """Read weights and biases of the input and of the hidden state from the cell's two products."""
    found = {}
    for k in range(cell.n_instructions()):
        if cell.instruction_id(k) == ca.OP_MTIMES:
            product = cell.instruction_MX(k)
            bias, weight, by = (product.dep(i) for i in range(3))
            found[by.name()] = weight.to_DM().full(), bias.to_DM().full().ravel()
    (w, b), (r, c) = found["x"], found["h"]
    rng = np.random.default_rng(0)
    x, h = rng.standard_normal(w.shape[1]), rng.standard_normal(r.shape[1])
    from_x, from_h = np.split(w @ x + b, 3), np.split(r @ h + c, 3)
    reset, update = (0.5 + 0.5 * np.tanh(0.5 * (from_x[i] + from_h[i])) for i in range(2))
    n = np.tanh(from_x[2] + reset * from_h[2])
    wanted = cell(x, h).full().ravel()
    assert np.allclose(
        n + update * (h - n), wanted, rtol=1e-12, atol=1e-12
    )  # else nn_export writes cells otherwise
    return w, r, b, c


def reduced(
    parts: Cut, model: HybridModel, rest: list[int], z: ca.SX, u: ca.SX, w: ca.SX
) -> tuple[Array, ca.SX, ca.SX]:
    """Reduce the cell's new state to the linear combinations that the rest of the step depends on.

    A linear layer with k outputs behind the cell passes on k combinations: the row space of the Jacobian, which is the
    same at all points. Scalar code for all units instead would grow with the network.

    Returns:
        ``head`` ``(k, units)``, symbols of the k combinations, and the step as a function of these combinations.
    """
    assert parts.cell is not None
    units, n_x = parts.cell.units, model.n_x
    g = ca.SX.sym("g", units)
    step = parts.after(z[:n_x], z[n_x:], u, w, g)
    slope = ca.Function("slope", [z, u, w, g], [ca.densify(ca.jacobian(step[rest], g))])
    value = ca.Function("value", [z, u, w, g], [step[rest]])
    rng = np.random.default_rng(0)

    def point() -> list[Array]:
        z_k = np.concatenate([model.x0, np.zeros(model.n_h)])
        near = [v + 0.3 * (np.abs(v) + 1.0) * rng.uniform(-1, 1, v.size) for v in (z_k, model.u0)]
        return [*near, model.w, rng.uniform(-1, 1, units)]

    found = np.vstack([slope(*point()).full() for _ in range(8)])
    found = found[np.all(np.isfinite(found), axis=1)]
    sizes, basis = np.linalg.svd(found)[1:] if len(found) else (np.zeros(0), np.zeros((0, units)))
    rank = int(np.sum(sizes > 1e-10 * max(1e-300, float(np.max(sizes, initial=0.0)))))
    pivots = _pivots(basis[:rank])
    head = np.linalg.solve(basis[:rank][:, pivots], basis[:rank]) if rank else np.zeros((0, units))
    out, chosen = ca.SX.sym("out", rank), ca.SX.zeros(units)
    for k, place in enumerate(pivots):
        chosen[place] = out[k]
    reduced = parts.after(z[:n_x], z[n_x:], u, w, chosen)
    again = ca.Function("again", [z, u, w, out], [reduced[rest]])
    for _ in range(4):
        *given, units_k = point()
        wanted, got = value(*given, units_k).full(), again(*given, head @ units_k).full()
        if not np.allclose(got, wanted, rtol=1e-11, atol=1e-11 * float(np.max(np.abs(wanted), initial=1e-9))):
            return np.eye(units), g, step
    return head, out, reduced


def _pivots(rows: Array) -> list[int]:
    """Indices of k linearly independent columns of a matrix ``(k, n)`` of rank k."""
    left, chosen = rows.copy(), []
    for _ in range(len(rows)):
        sizes = np.linalg.norm(left, axis=0)
        chosen.append(int(np.argmax(sizes)))
        direction = left[:, chosen[-1]] / sizes[chosen[-1]]
        left = left - np.outer(direction, direction @ left)
    return chosen
