"""Many steps of a model as one function. No torch in here.

A step function maps states and inputs to next states, e.g. ``(x, h, u) -> (x_next, h_next)``. An input is a
*state* if an output carries its next value (``x`` and ``x_next``), it is *held* if named so (a parameter: one
value for all steps), and a *sequence* otherwise (``u``: one value a step).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate

import casadi as ca

from nn_export.errors import SignatureError

BASE = 8
"""Calls in one level of :func:`fold`: 3 levels are 512 steps."""


def unroll(
    step: ca.Function,
    n: int,
    *,
    states: Mapping[str, str] | None = None,
    held: Sequence[str] = (),
    name: str | None = None,
) -> ca.Function:
    """``n`` steps in a row, with all values on the way.

    The graph calls the one step function ``n`` times, so memory and build time grow linearly with ``n``. A
    step that also gives its Jacobians (:func:`nn_export.with_jacobian`) gives those of all steps.

    Args:
        step: Step function with named inputs and outputs.
        n: Number of steps, at least 1.
        states: Name of the output that is the next value of each state. Default: ``{s: s + "_next"}`` for
            every input ``s`` with such an output.
        held: Inputs with one value for all steps. Default: none.
        name: Name of the function. Default: ``"unroll"``.

    Returns:
        Function with the names of ``step``. A sequence of r x c matrices is r x (n c), side by side; so is
        every output: the block ``k`` of ``x_next`` is the state after ``k + 1`` steps. States and held
        inputs have the size they have in ``step``.

    Raises:
        SignatureError: If names or sizes do not fit, no input is a state, or ``n < 1``.

    Example:
        >>> x, u = ca.MX.sym("x"), ca.MX.sym("u")
        >>> step = ca.Function("step", [x, u], [0.5 * x + u], ["x", "u"], ["x_next"])
        >>> print(unroll(step, 3)(8, ca.DM([[0, 1, 1]])))
        [[4, 3, 2.5]]
    """
    roles = _roles(step, n, states, held)
    # Flat: CasADi's mapaccum nests its calls, and derivatives then run through the steps once a level.
    return _chain([(step, 1)] * n, step, roles, name or "unroll", every=True)


def fold(
    step: ca.Function,
    n: int,
    *,
    states: Mapping[str, str] | None = None,
    held: Sequence[str] = (),
    name: str | None = None,
) -> ca.Function:
    """``n`` steps in a row, with the last states alone: for long free runs.

    The function is nested (a function of 8 calls of a function of 8 calls ...): its graph and the memory of
    its evaluation and of its gradient grow with the logarithm of ``n``, but for the sequences themselves.
    A gradient runs the steps again on each level, so it takes longer than that of :func:`unroll`.

    Args:
        step: As in :func:`unroll`.
        n: Number of steps, at least 1.
        states: As in :func:`unroll`.
        held: As in :func:`unroll`.
        name: Name of the function. Default: ``"fold"``.

    Returns:
        Function with the inputs of :func:`unroll` and the next values of the states as outputs, after the
        last step. Other outputs of ``step`` are left out.

    Raises:
        SignatureError: As :func:`unroll`.

    Example:
        >>> x, u = ca.MX.sym("x"), ca.MX.sym("u")
        >>> step = ca.Function("step", [x, u], [0.5 * x + u], ["x", "u"], ["x_next"])
        >>> fold(step, 3)(8, ca.DM([[0, 1, 1]]))
        DM(2.5)
    """
    roles = _roles(step, n, states, held)
    symbols = [step.mx_in(i) for i in range(step.n_in())]
    outputs = step.call(symbols)
    last = [outputs[step.index_out(s)] for s in roles.states.values()]
    blocks = [ca.Function(step.name(), symbols, last, step.name_in(), list(roles.states.values()))]
    while BASE ** len(blocks) < n:
        size = BASE ** len(blocks)
        blocks.append(_chain([(blocks[-1], size // BASE)] * BASE, step, roles, f"{step.name()}_{size}"))
    pieces, rest = [], n
    for level in reversed(range(len(blocks))):
        count, rest = divmod(rest, BASE**level)
        pieces += [(blocks[level], BASE**level)] * count
    return _chain(pieces, step, roles, name or "fold")


@dataclass(frozen=True)
class _Roles:
    """What the inputs of a step are; all others are sequences."""

    states: dict[str, str]
    held: frozenset[str]


def _roles(step: ca.Function, n: int, states: Mapping[str, str] | None, held: Sequence[str]) -> _Roles:
    inputs, outputs = step.name_in(), step.name_out()
    given = f"{step.name()}: inputs {', '.join(inputs)}, outputs {', '.join(outputs)}"
    if type(n) is not int or n < 1:
        raise SignatureError(f"n = {n!r}: give a whole number of steps, at least 1 [NN-044]")
    if states is None:
        states = {s: f"{s}_next" for s in inputs if f"{s}_next" in outputs}
    if not states:
        raise SignatureError(
            f"{given}: no output is named like an input with _next; give states={{'x': 'output_0'}} [NN-045]"
        )
    if unknown := sorted((set(states) | set(held)) - set(inputs)) + sorted(
        set(states.values()) - set(outputs)
    ):
        raise SignatureError(f"{given}: it has no {', '.join(unknown)}; choose among these [NN-046]")
    if both := sorted(set(states) & set(held)):
        raise SignatureError(
            f"{given}: {', '.join(both)} cannot be both a state and held; remove it from one of the two [NN-047]"
        )
    if len(set(states.values())) < len(states):
        raise SignatureError(
            f"{given}: two states have the same next value; give each its own output [NN-048]"
        )
    for state, after in states.items():
        sizes = step.size_in(state), step.size_out(after)
        if sizes[0] != sizes[1]:
            raise SignatureError(
                f"{given}: {state} is {sizes[0]}, its next value {after} is {sizes[1]}; make them equal [NN-049]"
            )
    return _Roles(dict(states), frozenset(held))


def _chain(
    pieces: list[tuple[ca.Function, int]], step: ca.Function, roles: _Roles, name: str, *, every: bool = False
) -> ca.Function:
    """Functions of several steps each, one after the other: last states, or every output of every piece."""
    edges = list(accumulate((count for _, count in pieces), initial=0))
    symbols, parts = [], []
    for i, s in enumerate(step.name_in()):
        if s in roles.states or s in roles.held:
            symbols.append(ca.MX.sym(s, step.sparsity_in(i)))
            parts.append([symbols[-1]] * len(pieces))
        else:
            symbols.append(ca.MX.sym(s, ca.repmat(step.sparsity_in(i), 1, edges[-1])))
            parts.append(ca.horzsplit(symbols[-1], [step.size2_in(i) * e for e in edges]))
    current = {s: symbols[step.index_in(s)] for s in roles.states}
    outputs, columns = [], []
    for k, (block, _) in enumerate(pieces):
        arguments = [current.get(s, parts[i][k]) for i, s in enumerate(step.name_in())]
        outputs = block.call(arguments)
        columns.append(outputs)
        current = {s: outputs[block.index_out(after)] for s, after in roles.states.items()}
    results = [ca.horzcat(*values) for values in zip(*columns, strict=True)] if every else outputs
    return ca.Function(name, symbols, results, step.name_in(), block.name_out())
