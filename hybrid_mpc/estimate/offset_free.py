"""Rank tests for offset-free control: of a disturbance model, and of the targets."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.model.equilibrium import hidden_fixed_point
from hybrid_mpc.model.limits import vector
from hybrid_mpc.model.model import HybridModel, output_with_jacobian
from hybrid_mpc.model.riccati import remedy_for_unmoved, unmoved_states

Array = NDArray[np.float64]
RANK = 1e-9
"""Singular values below this share of the largest count as zero, after scaling of rows and columns."""


@dataclass(frozen=True)
class OffsetFree:
    """Ranks at one point, with ``z = (x, h)``.

    Args:
        n_d: Number of unmeasured disturbances.
        n_y: Number of outputs.
        rank: Rank of ``[[A - I, B_d], [C, C_d]]``.
        needed: ``n_z + n_d``: with less, the outputs cannot distinguish disturbances and states.
        target_rank: Rank of ``[[A - I, B], [C_c, D_c]]``, ``c`` the controlled outputs.
        target_needed: ``n_z + n_c``: with less, not every set-point has a steady state.
        unmoved: If the targets' rank is too low: states that no input affects and that do not return to rest
            (:func:`~hybrid_mpc.model.riccati.unmoved_states`).
    """

    n_d: int
    n_y: int
    rank: int
    needed: int
    target_rank: int
    target_needed: int
    unmoved: tuple[str, ...] = ()

    @property
    def detectable(self) -> bool:
        """Whether the disturbances are detectable by a filter."""
        return self.rank == self.needed

    @property
    def promised(self) -> bool:
        """Whether the rank conditions hold for offset-free control of the controlled outputs under constant
        disturbances, as long as no limit is active. The run of a kit tests its loop for offsets
        (:attr:`~hybrid_mpc.kit.artifact.Kit.promises`).
        """
        return not self.why

    @property
    def reachable(self) -> bool:
        """Whether the inputs can hold the controlled outputs at every set-point nearby."""
        return self.target_rank == self.target_needed

    @property
    def why(self) -> str:
        """The violated conditions; empty if all hold."""
        few = f"{self.n_d} disturbances for {self.n_y} outputs: both numbers must be equal"
        parts = (self.why_undetectable, few * (self.n_d != self.n_y), self.why_unreachable)
        return "; ".join(part for part in parts if part)

    @property
    def why_undetectable(self) -> str:
        """Reason why a filter cannot detect the disturbances; empty if it can."""
        ranks = f"(rank {self.rank}, needed {self.needed})"
        return f"the outputs cannot distinguish disturbances and states {ranks}" * (not self.detectable)

    @property
    def why_unreachable(self) -> str:
        """Reason why the inputs cannot hold the outputs at their set-points; empty if they can."""
        if self.reachable:
            return ""
        ranks = f"(rank of the targets {self.target_rank}, needed {self.target_needed})"
        why = remedy_for_unmoved(self.unmoved) or "Weight other outputs in q_y"
        return f"the inputs cannot hold the controlled outputs at arbitrary set-points {ranks}. {why}"


def offset_free(
    model: HybridModel,
    controlled: Sequence[int | str] | None = None,
    *,
    x: ArrayLike | None = None,
    u: ArrayLike | None = None,
    w: ArrayLike | None = None,
) -> OffsetFree:
    """The rank test of a model's disturbance model at a point: the operating point, or a set-point's steady state.

    Args:
        model: The model, with its ``disturbance_model``.
        controlled: Controlled outputs by name or index, e.g. those with a weight ``q_y``. Default: all.
        x: State ``(n_x,)``. Default: the operating point's.
        u: Input ``(n_u,)``. Default: likewise.
        w: Measured disturbances ``(n_w,)``. Default: likewise.

    Raises:
        InputError: If a size does not fit, or the model has no such output.

    Source: Pannocchia and Rawlings, *Disturbance models for offset-free model-predictive control*, AIChE J. 49 (2003);
    Maeder, Borrelli, Morari, *Linear offset-free model predictive control*, Automatica 45 (2009).

    Example:
        >>> import casadi as ca
        >>> from hybrid_mpc.machine.signals import Signal
        >>> from hybrid_mpc.model.disturbance import Disturbance
        >>> x, u, level = ca.MX.sym("x"), ca.MX.sym("u"), (Signal("x", "-"),)
        >>> model = HybridModel.of("sum", 1.0, level, (Signal("u", "-"),), level, x=x, u=u, x_next=x + u, xdot=u, y=x,
        ...     disturbance_model=(Disturbance("output", "x", 1.0),))
        >>> offset_free(model).why  # a sensor's offset and the level cannot be distinguished
        'the outputs cannot distinguish disturbances and states (rank 1, needed 2)'
    """
    x = model.x0 if x is None else vector(x, model.n_x, "x")
    u = model.u0 if u is None else vector(u, model.n_u, "u")
    w = model.w if w is None else vector(w, model.n_w, "w")
    detects, still, b, c, by_u = steady_matrices(model, x, hidden_fixed_point(model, x, u, w=w), u, w)
    names = [signal.name for signal in model.outputs]
    wanted = list(range(model.n_y)) if controlled is None else list(controlled)
    chosen = [names.index(one) if one in names else one for one in wanted]
    if any(isinstance(i, str) or not 0 <= i < model.n_y for i in chosen):
        raise InputError(
            f"controlled: must be names or indices of the outputs {', '.join(names)}, got {wanted} [HM-ESTIMATE-010]"
        )
    rows = [int(i) for i in chosen]
    target_rank, n_z = _rank(np.block([[still, b], [c[rows], by_u[rows]]])), len(still)
    return OffsetFree(
        model.n_d, model.n_y, _rank(detects), n_z + model.n_d, target_rank, n_z + len(rows),
        unmoved_states(model, still + np.eye(n_z), b) if target_rank < n_z + len(rows) else (),
    )  # fmt: skip


def steady_matrices(
    model: HybridModel, x: Array, h: Array, u: Array, w: Array
) -> tuple[Array, Array, Array, Array, Array]:
    """``[[A - I, B_d], [C, C_d]]``, ``A - I``, ``B``, ``C`` and ``D`` at a point, with ``z = (x, h)``."""
    a, b = (m.full() for m in model.with_jacobian(x, h, u, w, model.p)[2:])
    _, by_x, by_u = (m.full() for m in output_with_jacobian(model)(x, u, w))
    on_u, on_x, on_y = model.disturbed
    still, c = a - np.eye(len(a)), np.hstack([by_x, np.zeros((model.n_y, model.n_h))])
    b_d = b @ on_u
    b_d[: model.n_x] += on_x
    return np.block([[still, b_d], [c, by_u @ on_u + on_y]]), still, b, c, by_u


def distinguishable(model: HybridModel, sizes: ArrayLike | None = None) -> OffsetFree:
    """The rank test at the operating point, or at points around it if the disturbances are only detectable in motion.

    At rest the bristle of a friction model compensates a load, so the two cannot be distinguished; in motion they can.

    Args:
        model: The model.
        sizes: Sizes of the states ``(n_x,)``, which are moved by a tenth of them. Default: the spread in recordings, or
            half the signals' ranges; a state without either stays.
    """
    around = _sizes(model) if sizes is None else 0.1 * vector(sizes, model.n_x, "sizes")
    found = offset_free(model)
    rng = np.random.default_rng(0)
    # points around the operating point
    for _ in range(5):
        if found.detectable:
            break
        other = offset_free(model, x=model.x0 + rng.uniform(-1.0, 1.0, model.n_x) * around)
        found = other if other.detectable else found
    return found


def _sizes(model: HybridModel) -> Array:
    """Distances around the operating point: a tenth of a state's spread, or of half its range."""
    half = np.array([0.5 * (s.upper - s.lower) for s in model.states])
    half = np.where(np.isfinite(half), half, 0.0)
    return 0.1 * (
        np.where(np.array(model.state_spread) > 0, model.state_spread, half) if model.state_spread else half
    )


def _rank(matrix: Array) -> int:
    """Rank of a matrix whose rows and columns have their own units.

    A model with non-finite values has full rank here: the monitor reports it, and the loop falls back.
    """
    if not np.all(np.isfinite(matrix)):
        return min(matrix.shape)
    m = matrix.copy()
    for _ in range(5):
        for axis in (0, 1):
            size = np.sqrt(np.max(np.abs(m), axis=axis, keepdims=True))
            m = m / np.where(size > 0, size, 1.0)
    sizes = np.linalg.svd(m, compute_uv=False)
    return int(np.sum(sizes > RANK * sizes[0])) if sizes.size and sizes[0] > 0 else 0
