"""Memory of a recurrent model: a contraction certificate over a box of inputs, and the Lyapunov exponent of a run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Literal

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import expit

from hybrid_mpc.analyze.linearize import linearize_along
from hybrid_mpc.errors import InputError
from hybrid_mpc.model.limits import vector
from hybrid_mpc.model.model import HybridModel
from nn_export import Node, Port, Program, build

Array = NDArray[np.float64]
Interval = tuple[float, float]
CELL = "aten.gru_cell.default"
BLOCKS = 10
"""Stretches of the run; their scatter gives the standard deviation of the exponent."""


def interval_bounds(f: ca.Function, lower: ArrayLike, upper: ArrayLike) -> tuple[Array, Array]:
    """Lower and upper bounds ``(m,)`` of a function's first output over a box of its first input ``(n,)``.

    The bounds hold up to rounding (about 1e-15 of the values), but they are often wide: a variable that appears twice
    is treated as two variables. An unsupported operation is an InputError.

    Source: Moore, Kearfott, Cloud, *Introduction to Interval Analysis*, 2009, chapter 2 and section 5.
    """
    low, high = _box(lower, upper, f.numel_in(0))
    scalar = f if f.is_a("SXFunction") else f.expand()
    work: list[Interval] = [(0.0, 0.0)] * scalar.sz_w()
    result = np.zeros((2, scalar.numel_out(0)))
    for k in range(scalar.n_instructions()):
        op, into, at = scalar.instruction_id(k), scalar.instruction_output(k), scalar.instruction_input(k)
        if op == ca.OP_INPUT:
            work[into[0]] = float(low[at[1]]), float(high[at[1]])
        elif op == ca.OP_CONST:
            value = float(scalar.instruction_constant(k))
            work[into[0]] = value, value
        elif op == ca.OP_OUTPUT:
            result[:, into[1]] = work[at[0]]
        elif op in _RULES:
            work[into[0]] = _RULES[op](*(work[i] for i in at))
        else:
            raise InputError(
                f"interval: operation {op} of CasADi (casadi.OP_...) is not supported. Rewrite the expression "
                "without it [HM-ANALYZE-039]"
            )
    return result[0], result[1]


def _box(lower: ArrayLike, upper: ArrayLike, n: int) -> tuple[Array, Array]:
    low, high = vector(lower, n, "lower bounds"), vector(upper, n, "upper bounds")
    if np.any(low > high):
        raise InputError(
            f"box: lower bounds {low.tolist()} lie above upper ones {high.tolist()} [HM-ANALYZE-040]"
        )
    return low, high


def _times(a: Interval, b: Interval) -> Interval:
    ends = [p * q for p in a for q in b]
    return min(ends), max(ends)


def _inverse(a: Interval) -> Interval:
    if a[0] <= 0 <= a[1]:
        raise InputError(
            f"interval: division by the range {a}, which contains zero. Use a smaller box [HM-ANALYZE-041]"
        )
    return 1 / a[1], 1 / a[0]


def _square(a: Interval) -> Interval:
    ends = a[0] ** 2, a[1] ** 2
    return (0.0 if a[0] <= 0 <= a[1] else min(ends)), max(ends)


def _size(a: Interval) -> Interval:
    ends = abs(a[0]), abs(a[1])
    return (0.0 if a[0] <= 0 <= a[1] else min(ends)), max(ends)


def _cosine(a: Interval) -> Interval:
    low, high = min(np.cos(a)), max(np.cos(a))
    if np.floor(a[1] / (2 * np.pi)) > np.floor(a[0] / (2 * np.pi)) or a[0] == 0:
        high = 1.0
    if np.floor((a[1] - np.pi) / (2 * np.pi)) > np.floor((a[0] - np.pi) / (2 * np.pi)):
        low = -1.0
    return float(low), float(high)


def _rising(f: Callable[[float], float]) -> Callable[[Interval], Interval]:
    return lambda a: (float(f(a[0])), float(f(a[1])))


_RULES: Mapping[int, Callable[..., Interval]] = MappingProxyType(
    {
        ca.OP_ASSIGN: lambda a: a,
        ca.OP_ADD: lambda a, b: (a[0] + b[0], a[1] + b[1]),
        ca.OP_SUB: lambda a, b: (a[0] - b[1], a[1] - b[0]),
        ca.OP_NEG: lambda a: (-a[1], -a[0]),
        ca.OP_MUL: _times,
        ca.OP_DIV: lambda a, b: _times(a, _inverse(b)),
        ca.OP_INV: _inverse,
        ca.OP_TWICE: lambda a: (2 * a[0], 2 * a[1]),
        ca.OP_SQ: _square,
        ca.OP_FABS: _size,
        ca.OP_COS: _cosine,
        ca.OP_SIN: lambda a: _cosine((a[0] - np.pi / 2, a[1] - np.pi / 2)),
        ca.OP_TANH: _rising(np.tanh),
        ca.OP_EXP: _rising(np.exp),
        ca.OP_SQRT: _rising(np.sqrt),
        ca.OP_ATAN: _rising(np.arctan),
        ca.OP_FMAX: lambda a, b: (max(a[0], b[0]), max(a[1], b[1])),
        ca.OP_FMIN: lambda a, b: (min(a[0], b[0]), min(a[1], b[1])),
    }
)


@dataclass(frozen=True)
class GruWeights:
    """Weights of a GRU cell in torch's form, gates in the order reset, update, new.

    ``r = sig(W_r s + b_ir + R_r h + b_hr)``, ``z = sig(W_z s + b_iz + R_z h + b_hz)``,
    ``n = tanh(W_n s + b_in + r (R_n h + b_hn))``, ``h+ = (1 - z) n + z h``.

    Args:
        w: Input weights ``(3 n_h, n_s)``.
        r: Recurrent weights ``(3 n_h, n_h)``.
        b_w: Input biases ``(3 n_h,)``.
        b_r: Recurrent biases ``(3 n_h,)``.
    """

    w: Array
    r: Array
    b_w: Array
    b_r: Array

    def __post_init__(self) -> None:
        n = self.r.shape[-1]
        shapes = self.w.shape[:1], self.r.shape, self.b_w.shape, self.b_r.shape
        if shapes != ((3 * n,), (3 * n, n), (3 * n,), (3 * n,)):
            raise InputError(
                f"GRU weights: shapes {shapes} do not belong to one cell of {n} hidden states"
                " [HM-ANALYZE-042]"
            )


@dataclass(frozen=True)
class Contraction:
    """Result of the contraction condition for a GRU whose inputs stay in a box.

    Args:
        certified: Whether the difference of any two hidden states with the same inputs decays, by at least the factor
            ``rate`` in each period, in a weighted maximum norm.
        index: Spectral radius of the bound matrix; certified if below 1.
        margin: ``1 - index``; certified if positive. Roughly, all recurrent weights could be ``1 / index`` times larger
            (the box of the gates depends on these weights too).
        rate: Contraction factor of one period; at least 1 if not certified.
        weights: Weights of the norm ``max_i |dh_i| / weights_i`` ``(n_h,)``.
        reach: Largest possible ``|h_i|`` ``(n_h,)`` after a start at zero.
    """

    certified: bool
    index: float
    margin: float
    rate: float
    weights: Array
    reach: Array


def gru_weights(program: Program) -> GruWeights:
    """Read the weights of the only GRU cell in an exported program (``"hybrid/step"`` of an artifact).

    Raises:
        InputError: If the program has no GRU cell, or several.

    Example:
        ``gru_weights(nn_export.load_programs(folder / "models")["hybrid/step"])``
    """
    found = []
    for argument in _cell(program).args[2:]:
        name = argument.get("weight") if isinstance(argument, dict) else None
        if name is None:
            raise InputError(
                "contraction: the cell's weights are computed in the program, but only stored weights are supported"
                " [HM-ANALYZE-043]"
            )
        found.append(np.asarray(program.weights[name], dtype=float))
    if len(found) != 4:
        raise InputError(
            "contraction: the GRU cell has no biases, but only cells with biases are supported [HM-ANALYZE-044]"
        )
    return GruWeights(*found)


def feature_box(program: Program, x: ArrayLike, u: ArrayLike) -> tuple[Array, Array]:
    """Bounds of the inputs of a program's GRU cell over a box of states and inputs, by interval arithmetic.

    Args:
        program: ``(x, h, u, ...) -> ...`` with one GRU cell whose inputs depend only on ``x`` and ``u``.
        x: Lower and upper bounds ``(n_x, 2)``.
        u: Lower and upper bounds ``(n_u, 2)``.

    Raises:
        InputError: If there is no such cell, its inputs depend on other arguments, or an operation before the cell is
            not supported.
    """
    cell = _cell(program)
    source = cell.args[0]
    shape = next(n.shapes[0] for n in program.nodes if n.name == source.get("node"))
    end = [n.name for n in program.nodes].index(cell.name)
    short = Program(program.inputs, (Port("s", shape, source),), program.nodes[:end], dict(program.weights))
    f = build(short, "features", plain=True)
    box = np.vstack([np.asarray(x, dtype=float), np.asarray(u, dtype=float)])
    n_x = f.numel_in(0)
    z = ca.MX.sym("z", n_x + f.numel_in(2))
    rest = [ca.MX.sym(f.name_in(i), f.numel_in(i)) for i in range(f.n_in()) if i not in (0, 2)]
    s = f.call([z[:n_x], rest[0], z[n_x:], *rest[1:]], True, False)[0]
    if ca.depends_on(s, ca.veccat(*rest)):
        raise InputError(
            "contraction: the GRU cell's inputs depend on more than x and u, so the box does not bound them "
            "[HM-ANALYZE-045]"
        )
    return interval_bounds(ca.Function("s", [z], [ca.vec(s)]), box[:, 0], box[:, 1])


def contraction(cell: GruWeights, lower: ArrayLike, upper: ArrayLike) -> Contraction:
    """Sufficient condition for a GRU to forget its initial hidden state, over a box of its inputs.

    The Jacobian of a step with respect to ``h`` is ``diag(z) + diag(1 - z) E`` with ``E = diag((h - n) z) R_z +
    diag((1 - n^2) (R_n h + b_hn) r (1 - r)) R_r + diag((1 - n^2) r) R_n``. The intervals of the gates over the box of
    inputs, and over the resulting box of hidden states, give an upper bound ``M`` of ``|E|``. Let ``index`` be the
    spectral radius of ``M``. If ``index < 1``, the difference of two hidden states shrinks in each step at least by
    ``max_i z_i + (1 - z_i) index < 1``, in the maximum norm weighted by the Perron vector of ``M``.

    This is the incremental input-to-state stability of Bonassi et al., for torch's cell (theirs resets the hidden state
    before the product) and with the best weights of their norm. Most trained networks forget although they fail the
    condition; see :func:`lyapunov_exponent`.

    Args:
        cell: The weights.
        lower: Lower bounds of the cell's inputs ``(n_s,)``.
        upper: Upper bounds ``(n_s,)``.

    Raises:
        InputError: If the box has the wrong size, is not finite, or is empty.

    Source: Bonassi, Farina, Scattolini, *On the stability properties of Gated Recurrent Units neural networks*,
    Systems & Control Letters 157 (2021) 105049.

    Example:
        >>> small = GruWeights(np.zeros((3, 1)), 0.1 * np.ones((3, 1)), np.zeros(3), np.zeros(3))
        >>> found = contraction(small, [-1.0], [1.0])
        >>> found.certified, round(found.index, 2)
        (True, 0.05)
    """
    low, high = _box(lower, upper, cell.w.shape[1])
    n = cell.r.shape[1]
    driven = _affine(cell.w, low, high, cell.b_w)
    h = -np.ones(n), np.ones(n)
    # iterations that narrow the box of hidden states; the box converges much earlier
    for _ in range(50):
        recurrent = _affine(cell.r, *h, cell.b_r)
        r, z = (tuple(expit(d[g] + e[g]) for d, e in zip(driven, recurrent, strict=True))
                for g in (slice(0, n), slice(n, 2 * n)))  # fmt: skip
        a = recurrent[0][2 * n :], recurrent[1][2 * n :]
        products = np.stack([p * q for p in r for q in a])
        new = np.tanh(driven[0][2 * n :] + products.min(0)), np.tanh(driven[1][2 * n :] + products.max(0))
        h = np.minimum(new[0], 0.0), np.maximum(new[1], 0.0)
    apart = np.maximum(h[1] - new[0], new[1] - h[0])
    slope = 1 - np.where((new[0] <= 0) & (new[1] >= 0), 0.0, np.minimum(np.abs(new[0]), np.abs(new[1]))) ** 2
    swing = np.maximum(np.abs(a[0]), np.abs(a[1])) * np.where(
        (r[0] <= 0.5) & (r[1] >= 0.5), 0.25, np.maximum(r[0] * (1 - r[0]), r[1] * (1 - r[1]))
    )
    by = np.abs(cell.r).reshape(3, n, n)
    bound = (
        (apart * z[1])[:, None] * by[1] + (slope * swing)[:, None] * by[0] + (slope * r[1])[:, None] * by[2]
    )
    index, weights = _perron(bound)
    rate = float(np.max(np.where(index < 1, z[1] + (1 - z[1]) * index, z[0] + (1 - z[0]) * index)))
    reach = np.maximum(-h[0], h[1])
    return Contraction(bool(index < 1 and rate < 1), index, 1 - index, rate, weights, reach)


def _cell(program: Program) -> Node:
    cells = [n for n in program.nodes if n.op == CELL]
    others = sorted({n.op for n in program.nodes if any(k in n.op for k in ("gru.", "lstm", "rnn_"))})
    if len(cells) != 1:
        raise InputError(
            f"contraction: the program has {len(cells)} GRU cells{' beside ' + ', '.join(others) if others else ''}; "
            "the condition needs exactly one [HM-ANALYZE-046]"
        )
    return cells[0]


def _affine(w: Array, low: Array, high: Array, b: Array) -> tuple[Array, Array]:
    middle, half = w @ (0.5 * (low + high)) + b, np.abs(w) @ (0.5 * (high - low))
    return middle - half, middle + half


def _perron(matrix: Array) -> tuple[float, Array]:
    """Spectral radius of a non-negative matrix (up to 1e-12), and weights whose maximum norm equals it (Perron)."""
    padded = matrix + 1e-12 * max(1.0, float(matrix.max(initial=0.0)))
    values, vectors = np.linalg.eig(padded)
    weights = np.abs(vectors[:, int(np.argmax(values.real))].real)
    return float(np.max(padded @ weights / weights)), weights / weights.max()


@dataclass(frozen=True)
class LyapunovExponent:
    """Largest Lyapunov exponent along a run.

    Args:
        value: Mean growth rate of the distance of neighbouring runs [1/s]; negative: the distance decays.
        deviation: Standard deviation of this mean, from ten stretches of the run [1/s].
        growth: Logarithm of the distance over the initial distance ``(n + 1,)``, for a plot.
    """

    value: float
    deviation: float
    growth: Array


def lyapunov_exponent(
    model: HybridModel, x: ArrayLike, u: ArrayLike, *, part: Literal["all", "hidden"] = "all"
) -> LyapunovExponent:
    """Compute the largest Lyapunov exponent along a free run or a measured trajectory, by its tangent map.

    The tangent vector follows ``v_{k+1} = A_k v_k``; the exponent is the mean of ``log(|v_{k+1}| / |v_k|) / dt``. With
    ``part="hidden"``, the states are given and only the block of the hidden state is used: a negative exponent means
    that the network forgets its initial hidden state along this trajectory. The result holds for this run only.

    Args:
        model: The model.
        x: Initial state ``(n_x,)`` of a free run, or a trajectory ``(n, n_x)``; a hidden state starts at zero.
        u: Inputs ``(n, n_u)``.
        part: ``"all"`` or ``"hidden"``. Default: ``"all"``.

    Raises:
        InputError: If the run is shorter than 50 periods or not finite, a shape does not fit, or there is no hidden
            state.

    Source: Benettin, Galgani, Giorgilli, Strelcyn, *Lyapunov characteristic exponents*, Meccanica 15 (1980).

    Example:
        >>> from hybrid_mpc.machine.signals import Signal
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "-"),)
        >>> model = HybridModel.of("lag", 0.1, level, (Signal("u", "-"),), level,
        ...     x=x, u=u, x_next=0.9 * x + u, xdot=u, y=x)
        >>> round(lyapunov_exponent(model, [1.0], np.zeros((100, 1))).value, 6)  # log(0.9) / 0.1
        -1.053605
    """
    maps = linearize_along(model, x, u).A
    if part == "hidden":
        if not model.n_h:
            raise InputError(
                f"model {model.name}: no hidden state; give a model with a network [HM-ANALYZE-047]"
            )
        maps = maps[:, model.n_x :, model.n_x :]
    n = len(maps)
    if n < 50:
        raise InputError(
            f"Lyapunov exponent: got {n} periods; give at least 50 for a mean over time [HM-ANALYZE-048]"
        )
    v: Array = np.asarray(np.random.default_rng(0).normal(size=maps.shape[1]), dtype=np.float64)
    v = np.asarray(v / np.linalg.norm(v))
    steps = np.empty(n)
    for k, a in enumerate(maps):
        v = np.asarray(a @ v)
        size = float(np.linalg.norm(v))
        if not size > 0:
            raise InputError(
                "Lyapunov exponent: minus infinity, because one step removes every deviation [HM-ANALYZE-049]"
            )
        steps[k] = np.log(size)
        v = np.asarray(v / size)
    # share of the run at its start in which the tangent vector aligns; it is not evaluated
    counted = steps[int(0.2 * n) :]
    means = np.array([b.mean() for b in np.array_split(counted, BLOCKS)]) / model.dt
    deviation = float(means.std(ddof=1) / np.sqrt(BLOCKS))
    return LyapunovExponent(float(counted.mean()) / model.dt, deviation, np.append(0.0, np.cumsum(steps)))
