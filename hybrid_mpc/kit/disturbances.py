"""The default disturbance model of a scenario that declares none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.control.ocp import OCP
from hybrid_mpc.control.sizes import Sizes, disturbance_sizes
from hybrid_mpc.estimate.offset_free import RANK, distinguishable, offset_free, steady_matrices
from hybrid_mpc.model.disturbance import Disturbance
from hybrid_mpc.model.equilibrium import hidden_fixed_point
from hybrid_mpc.model.model import HybridModel, kinematics, output_with_jacobian

Array = NDArray[np.float64]
OFF = 0.2
"""Relative error of each parameter: that of the wrong models with which a kit's promises are examined."""
CARRIES = 1.0
"""Largest disturbance, over its size, that errors of the parameters may require. An input that needs more has so little
effect at steady state that a load there explains no error: its estimate would drift away."""
QUARTER, RUN, STILL = 0.25, 5000, 1e-6
"""Step of an input as a share of its range; longest run to steady state [periods]; change a period, over a state's
size, that counts as steady."""


def default_disturbances(model: HybridModel, control: OCP) -> tuple[Disturbance, ...] | None:
    """Default disturbance model; None: one disturbance at each input.

    Disturbances of controlled outputs act at the inputs, and an output without weight has a disturbance of its own if
    errors of the parameters move it in a way that no load at an input explains; otherwise the controlled outputs would
    have an offset. If errors of the parameters require disturbances larger than the inputs' ranges, they act instead on
    the rates of the states that the outputs measure, or only of those of the controlled outputs if not every output
    measures a state of its own. There are never more disturbances than outputs, since more are not observable. A
    problem with references of states has one disturbance at each input.

    Args:
        model: The fitted prior.
        control: The control problem.

    Source: Pannocchia and Rawlings, *Disturbance models for offset-free model-predictive control*, AIChE J. 49 (2003).

    Example:
        >>> import casadi as ca
        >>> from hybrid_mpc.machine.signals import Signal
        >>> from hybrid_mpc.machine.signals import Parameter
        >>> x, u, p = ca.MX.sym("x", 2), ca.MX.sym("u"), ca.MX.sym("p")
        >>> level, flow = Signal("level", "m", 0.0, 2.0), Signal("flow", "l/s", 0.0, 5.0)
        >>> tank = HybridModel.of("tank", 1.0, (level, flow), (Signal("valve", "-"),), (level, flow), x=x, u=u, y=x,
        ...     p=p, parameters=(Parameter("share", 0.1, "-", 0.01, 1.0),), nominal_x=(1.0, 1.0), nominal_u=(0.5,),
        ...     x_next=ca.vertcat(0.9 * x[0] + p * x[1], 0.5 * x[1] + u), xdot=x)
        >>> problem = OCP(10, [0.0, 0.0], [0.0], [1.0], [0.0], [1.0], q_y=[4.0, 0.0])
        >>> [(d.at, d.signal) for d in default_disturbances(tank, problem)]
        [('input', 'valve'), ('output', 'flow')]
    """
    if control.n_y != model.n_y or not control.n_y:
        return None
    held = np.flatnonzero(control.q_y > 0).tolist()
    n_in, sizes = min(model.n_u, model.n_y), Sizes(model, control)
    free = [i for i in range(model.n_y) if i not in held]
    own = [
        Disturbance("output", model.outputs[i].name, float(sizes.outputs[i]))
        for i in [*free, *held][: model.n_y - n_in]
    ]
    # largest deviation of an output, over its size, that does not count as an offset
    if own and unexplained(replace(model, disturbance_model=None), control) <= 0.01:
        own = []
    at_inputs = [_with_inputs(model, way, own) for way in combinations(range(model.n_u), n_in)]
    found = [one for one in at_inputs if distinguishable(one, sizes.states).detectable]
    best = min(found, key=lambda one: needed(one, control), default=None)
    if best is not None and needed(best, control) <= CARRIES:
        return _plain(best)
    others = rates_of_outputs(model, control) or _rates(model, control, held)
    if others is not None:
        return others
    return None if best is None else _plain(best)


def rates_of_outputs(model: HybridModel, control: OCP) -> tuple[Disturbance, ...] | None:
    """A disturbance at the rate of the state that each output measures; None if outputs measure no states of their own,
    or if they do not distinguish the disturbances from the states.

    Its size is the effect of parameter errors of :data:`OFF`, or what moves the state by its size within half a
    horizon if that is more. Example: ``replace(model, disturbance_model=rates_of_outputs(model, control))``.
    """
    return _rates(model, control, range(model.n_y))


def loads_by_parameters(model: HybridModel, control: OCP) -> Array:
    """Load at the rate of each state ``(n_x,)`` [unit/s] at the operating point: the largest effect that an error of
    :data:`OFF` in one parameter has there; zero without free parameters.
    """
    found = _off_rates(model, control)
    if not found:
        return np.zeros(model.n_x)
    return np.asarray(np.max(np.abs(found[0]), axis=1) / model.dt)


def _off_rates(model: HybridModel, control: OCP) -> list[Array]:
    """What errors of the parameters add to the states in a period ``(n_x, n_free)``, by point of :func:`_rests`."""
    return [off[: model.n_x] for _, off in _errors(model, control)]


def _plain(model: HybridModel) -> tuple[Disturbance, ...] | None:
    """The disturbance model of a model; None if it is one at each input."""
    each = tuple(Disturbance("input", s.name) for s in model.inputs)
    return None if model.disturbance_model == each else model.disturbance_model


def _with_inputs(model: HybridModel, places: tuple[int, ...], own: list[Disturbance]) -> HybridModel:
    chosen = (*(Disturbance("input", model.inputs[j].name) for j in places), *own)
    return replace(model, disturbance_model=chosen)


def _rates(model: HybridModel, control: OCP, held: Sequence[int]) -> tuple[Disturbance, ...] | None:
    """Disturbances of the rates of the states that outputs ``held`` measure (for positions: of their speeds), and of
    the other outputs; None if they are not detectable, or if one of ``held`` depends on several states.
    """
    rows = output_with_jacobian(model)(model.x0, model.u0, model.w)[1].full()
    sizes = Sizes(model, control)
    # a disturbance of a rate moves the state by the state's size within half a horizon, or as errors of parameters do
    speeds, found = kinematics(model), [sizes.states / (0.5 * control.horizon * model.dt)]
    found += [np.sqrt(np.sum(off**2, axis=1)) / model.dt for off in _off_rates(model, control)]
    rates = np.max(found, axis=0)
    chosen: list[Disturbance] = []
    for i, signal in enumerate(model.outputs):
        if i not in held:
            chosen.append(Disturbance("output", signal.name, float(sizes.outputs[i])))
            continue
        shown = np.flatnonzero(rows[i])
        if shown.size != 1:
            return None
        place = speeds.get(int(shown[0]), int(shown[0]))
        chosen.append(Disturbance("rate", model.states[place].name, float(rates[place])))
    if len({(d.at, d.signal) for d in chosen}) < len(chosen):
        return None
    disturbed = replace(model, disturbance_model=tuple(chosen))
    return disturbed.disturbance_model if offset_free(disturbed).detectable else None


def needed(model: HybridModel, control: OCP) -> float:
    """Largest disturbance at an input, over its size, that compensates parameter errors of :data:`OFF` at the outputs.

    The maximum is taken over the operating point and steady states at other inputs. Zero for a model without free
    parameters or without disturbances at inputs.
    """
    at_inputs = np.any(model.disturbed[0] != 0, axis=0)
    sizes, found = disturbance_sizes(model, control), [0.0]
    for matrix, off in _errors(model, control) if at_inputs.any() else ():
        d = np.linalg.lstsq(matrix, off, rcond=None)[0][model.n_x + model.n_h :]
        found.append(float(np.max((np.sqrt(np.sum(d**2, axis=1)) / sizes)[at_inputs])))
    return max(found)


def unexplained(model: HybridModel, control: OCP) -> float:
    """Largest deviation of an output, over its size, that remains after the disturbances have compensated parameter
    errors of :data:`OFF` as far as possible; over the same points.
    """
    sizes, n_z, found = Sizes(model, control).outputs, model.n_x + model.n_h, [0.0]
    for matrix, off in _errors(model, control):
        # eliminate the steady-state equations (first n_z rows) exactly, then fit the outputs
        _, values, rows = np.linalg.svd(matrix[:n_z])
        rank = int(np.sum(values > RANK * values[0]))
        rest = np.linalg.lstsq(matrix[:n_z], off[:n_z], rcond=RANK)[0]
        free = matrix[n_z:] @ rows[rank:].T / sizes[:, None]
        left = (off[n_z:] - matrix[n_z:] @ rest) / sizes[:, None]
        left = left - free @ np.linalg.lstsq(free, left, rcond=RANK)[0]
        found.append(float(np.max(np.sqrt(np.sum(left**2, axis=1)))))
    return max(found)


def _errors(model: HybridModel, control: OCP) -> list[tuple[Array, Array]]:
    """At each point of :func:`_rests`: ``[[A - I, B_d], [C, C_d]]``, and what errors of the parameters add to states
    and outputs ``(n_z + n_y, n_free)``; none of a model without free parameters.
    """
    free = [i for i, one in enumerate(model.parameters) if not one.fixed]
    if not free:
        return []
    theta = ca.SX.sym("p", model.n_p)
    x, h, u = (ca.SX.sym(k, n) for k, n in zip("xhu", (model.n_x, model.n_h, model.n_u), strict=True))
    values = ca.vertcat(*model.step(x, h, u, model.w, theta)), model.output(x, u, model.w, theta)
    slopes = ca.Function("slopes", [x, h, u, theta], [ca.densify(ca.jacobian(v, theta)) for v in values])
    found = []
    for point in _rests(model, control):
        off = np.vstack([m.full()[:, free] for m in slopes(*point, model.p)]) * (OFF * np.abs(model.p[free]))
        matrix = steady_matrices(model, *point, model.w)[0]
        if np.all(np.isfinite(matrix)) and np.all(np.isfinite(off)):
            found.append((matrix, off))
    return found


def _rests(model: HybridModel, control: OCP) -> list[tuple[Array, Array, Array]]:
    """The operating point, and the steady states after a step of each input by a quarter of its range, if they are
    reached within the ranges of the states.
    """
    u0 = np.clip(model.u0, control.u_min, control.u_max)
    found = [(model.x0, hidden_fixed_point(model, model.x0, u0), u0)]
    sizes = Sizes(model, control).states
    low, high = np.array([(s.lower, s.upper) for s in model.states]).T
    for step in (QUARTER * row for one in np.diag(control.input_range) for row in (one, -one)):
        u = np.clip(u0 + step, control.u_min, control.u_max)
        x, h = model.x0, found[0][1]
        for _ in range(RUN):
            after, h = (m.full().ravel() for m in model.step(x, h, u, model.w, model.p))
            moved, x = np.abs(after - x) / sizes, after
            if not np.all((x >= low) & (x <= high)) or np.all(moved < STILL):
                break
        if np.all((x >= low) & (x <= high)) and np.all(moved < STILL):
            found.append((x, h, u))
    return found
