"""The generated C with the interface of the Python controller: compiled once, cached, and called with ctypes."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from time import perf_counter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.control.ocp import OCP, Limits
from hybrid_mpc.control.problem import Problem, Solution, SplitController, Status
from hybrid_mpc.embedded.generate import SOURCES, Sources, bound_names, make_sources, template
from hybrid_mpc.estimate.kalman import Estimate
from hybrid_mpc.model.equilibrium import WAIT, Steady
from hybrid_mpc.model.model import HybridModel
from nn_export.codegen import compile_library

Array = NDArray[np.float64]
FLAGS = ("-std=c11", "-O3", "-march=native", "-ffp-contract=off")
"""Options of the compiler. -march=native binds the library to this processor. Without -ffp-contract=off, a fused
multiply-add would give other rounding errors than the generated C on other processors."""
STATUS = (
    Status.INITIAL, Status.SOLVED, Status.NOT_FINITE, Status.INFEASIBLE, Status.INACCURATE, Status.DIVERGED,
)  # fmt: skip
"""Results of a solve in the order of ``hmpc_status``."""
_BRIDGE = """
#include "hmpc.h"
#include <stddef.h>
#include <stdlib.h>
#define PLACE(field) offsetof(hmpc_state, field)
const size_t hmpc_places[] = {
  sizeof(hmpc_state), PLACE(x), PLACE(h), PLACE(d), PLACE(w), PLACE(plan.u), PLACE(plan.z), PLACE(plan.w),
  PLACE(plan.cost), PLACE(plan.excess), PLACE(working.kkt), PLACE(linear.largest_defect), PLACE(u), PLACE(status),
  PLACE(source), PLACE(age), PLACE(working.iterations), PLACE(steady.x), PLACE(steady.h), PLACE(steady.u),
  PLACE(steady.y), PLACE(steady.reached), PLACE(steady.steady), PLACE(plan.given_way),
  PLACE(steady.goal), PLACE(steady.age), PLACE(plan.multiplier)
};
"""
"""C that exports the offsets of the state's fields."""
FIELDS = (
    "x", "h", "d", "w", "plan_u", "plan_z", "plan_w", "cost", "excess", "kkt", "defect", "u", "status", "source", "age",
    "iterations", "steady_x", "steady_h", "steady_u", "steady_y", "reached", "steady", "given_way",
    "steady_goal", "steady_age", "multiplier",
)  # fmt: skip
WHOLE = ("status", "source", "age", "iterations", "reached", "steady", "steady_age")


class Goal(ctypes.Structure):
    """``hmpc_goal``."""

    _fields_ = (
        ("x", ctypes.c_void_p), ("y", ctypes.c_void_p), ("p", ctypes.c_void_p), ("rows", ctypes.c_int),
        ("weight", ctypes.c_void_p), ("u_min", ctypes.c_void_p), ("u_max", ctypes.c_void_p),
        ("w", ctypes.c_void_p), ("w_rows", ctypes.c_int),
    )  # fmt: skip


@dataclass(frozen=True)
class Prepared:
    """Arguments of :meth:`NativeController.prepare`; ``ticket`` shows whether the C state still holds its result."""

    previous: Solution
    weight: Array | None
    ticket: int
    milliseconds: float


class NativeController(SplitController):
    """The real-time iteration as compiled C, with the results of :class:`~hybrid_mpc.control.rti.CondensedController`.

    The constructor compiles the library unless the cache folder holds it. Not thread-safe.

    Args:
        model: The deployed model.
        ocp: The control problem.
        flags: Options of the compiler. Default: :data:`FLAGS`.

    Raises:
        InputError: If a part of model or problem cannot be exported as C.
        CompileError: If there is no compiler, or the compilation fails.
    """

    converges = False

    def __init__(self, model: HybridModel, ocp: OCP, *, flags: Sequence[str] = FLAGS) -> None:
        self.problem = Problem(model, ocp)
        self._library = load_library(make_sources(model, ocp), flags)
        self._state = State(self._library)
        self._names = bound_names(self.problem.soft, ocp.horizon)
        self._ticket = 0

    def prepare(self, previous: Solution, weight: Array | None = None) -> Prepared:
        """See :meth:`~hybrid_mpc.control.rti.CondensedController.prepare`."""
        start = perf_counter()
        weight = None if weight is None else np.ascontiguousarray(self.problem.weights(weight))
        self._load(previous)
        goal = goal_of(weight=weight)
        self._library.c.hmpc_prepare(self._state.at, ctypes.byref(goal))
        self._ticket += 1
        return Prepared(previous, weight, self._ticket, (perf_counter() - start) * 1e3)

    def finish(
        self, prepared: Prepared, estimate: Estimate, reference: Array, limits: Limits | None = None,
        w: Array | None = None,
    ) -> Solution:  # fmt: skip
        """See :meth:`~hybrid_mpc.control.rti.CondensedController.feedback`."""
        if prepared.ticket != self._ticket:  # the C state holds another preparation
            prepared = self.prepare(prepared.previous, prepared.weight)
        start = perf_counter()
        self._ticket += 1
        view, m, problem = self._state.view, self.model, self.problem
        rows = np.ascontiguousarray(np.asarray(reference, dtype=np.float64))
        if rows.ndim != 2 or len(rows) < 1 or rows.shape[1] != self.ocp.columns:
            problem.target(reference)  # raises the InputError that explains the wrong shape
        columns = self.ocp.columns - self.ocp.n_p
        followed, p = np.ascontiguousarray(rows[:, :columns]), np.ascontiguousarray(rows[:, columns:])
        x, y = (None, followed) if self.ocp.n_y else (followed, None)
        view["x"][:], view["h"][:], view["d"][:] = estimate.x, estimate.h, estimate.d
        if m.n_w:
            view["w"][:] = estimate.w
        ahead = np.ascontiguousarray(problem.forecast(w, estimate)) if m.n_w else None
        bounds = (None, None) if limits is None else (limits.u_min, limits.u_max)
        goal = goal_of(x, prepared.weight, *bounds, y=y, p=p)
        status = STATUS[
            self._library.c.hmpc_feedback(
                self._state.at,
                ctypes.byref(goal),
                None if ahead is None else ahead.ctypes.data,
                self.ocp.horizon,
            )
        ]
        spent = (perf_counter() - start) * 1e3
        self._library.c.hmpc_complete(self._state.at)
        z, plan, n_x = view["plan_z"][:, : m.n_x + m.n_h].copy(), view["plan_u"].copy(), m.n_x
        n_w, d = m.n_w, estimate.d if status.ok else prepared.previous.d
        return Solution(
            u=plan,
            x=z[:, :n_x],
            h=z[:, n_x:],
            d=d,
            cost=float(view["cost"][0]),
            status=status,
            kkt=float(view["kkt"][0]),
            defect=float(view["defect"][0]),
            timing={"prepare": prepared.milliseconds, "feedback": spent},
            excess=float(view["excess"][0]),
            w=view["plan_w"][:, :n_w].copy(),
            steady=self._steady() if status.ok else prepared.previous.steady,
            given_way=self._given_way(),
            multipliers=self._multipliers() if status.ok else None,
        )

    def _load(self, plan: Solution) -> None:
        m = self.model
        z = np.hstack([plan.x, plan.h])
        w = plan.w if len(plan.w) else self.problem.forecast(None, None)
        given = [
            np.ascontiguousarray(v, dtype=np.float64)
            for v in (plan.u, z, plan.d, w if m.n_w else np.zeros(1))
        ]
        self._library.c.hmpc_load_plan(self._state.at, *(v.ctypes.data for v in given))
        view, steady = self._state.view, plan.steady
        view["steady"][0], view["steady_age"][0] = steady is not None and steady.steady, WAIT
        if plan.multipliers is not None and self.problem.soft.curved:
            view["multiplier"][:] = self.problem.soft.by_period(plan.multipliers)
        if steady is not None:
            view["steady_goal"][:], view["steady_age"][0] = steady.goal, steady.age
            view["steady_x"][:], view["steady_h"][:], view["steady_u"][:] = steady.x, steady.h, steady.u

    def _given_way(self) -> dict[str, float]:
        """Largest violation of each relaxed hard bound, by name."""
        found: dict[str, float] = {}
        for name, value in zip(self._names, self._state.view["given_way"].tolist(), strict=False):
            if name and value > 0:
                found[name] = max(found.get(name, 0.0), value)
        return found

    def _multipliers(self) -> Array | None:
        soft = self.problem.soft
        return soft.by_row(self._state.view["multiplier"]) if soft.curved else None

    def _steady(self) -> Steady | None:
        """Steady state of the last solve for the first row of the outputs' reference; None without such a reference."""
        if not self.ocp.n_y:
            return None
        view = self._state.view
        x, h, u, y, goal = (view[f"steady_{name}"].copy() for name in ("x", "h", "u", "y", "goal"))
        reached, steady, age = (int(view[name][0]) for name in ("reached", "steady", "steady_age"))
        return Steady(x, h, u, y, bool(reached), bool(steady), goal, age)


def goal_of(
    x: Array | None = None, weight: Array | None = None, u_min: Array | None = None, u_max: Array | None = None,
    *, y: Array | None = None, p: Array | None = None, w: Array | None = None,
) -> Goal:  # fmt: skip
    """Fill a ``hmpc_goal``; the arrays (row-major) must outlive it."""

    def at(array: Array | None) -> int | None:
        return None if array is None else array.ctypes.data

    rows = x if y is None else y
    limits, ahead = (at(u_min), at(u_max)), (at(w), 0 if w is None else len(w))
    return Goal(at(x), at(y), at(p), 1 if rows is None else len(rows), at(weight), *limits, *ahead)


@dataclass(frozen=True)
class Library:
    """A loaded library, its sizes, and the size of the state and offsets of its fields [bytes]."""

    c: Any
    sizes: Mapping[str, int]
    places: tuple[int, ...]


class State:
    """A cleared ``hmpc_state`` in double precision; ``at`` is its address, ``view`` holds arrays on some fields."""

    def __init__(self, library: Library) -> None:
        n = library.sizes
        n_z, n_w = n["NX"] + n["NH"], n["NW"]
        shapes: dict[str, tuple[int, ...]] = {
            "x": (n["NX"],), "h": (n["NH"],), "d": (n["ND"],), "w": (n_w,), "plan_u": (n["N"], n["NU"]),
            "plan_z": (n["N"] + 1, -(-n_z // 8) * 8), "plan_w": (n["N"], max(1, n_w)), "u": (n["NU"],),
            "steady_x": (n["NX"],), "steady_h": (n["NH"],), "steady_u": (n["NU"],), "steady_y": (n["NY"],),
            "steady_goal": (n["NY"],),
            "given_way": (max(1, n["SOFT_X"] + n["SOFT_E"]),),
            "multiplier": (max(1, n["BENT"] * n["N"]), max(1, n["SOFT_E"])),
        }  # fmt: skip
        size, *places = library.places
        memory = np.zeros(size + 64, dtype=np.uint8)
        start = -memory.ctypes.data % 64
        self.at = ctypes.c_void_p(memory.ctypes.data + start)
        self.view: dict[str, NDArray[Any]] = {}
        for name, place in zip(FIELDS, places, strict=True):
            kind = np.dtype(np.int32 if name in WHOLE else np.float64)
            shape = shapes.get(name, (1,))
            field = memory[start + place :][: kind.itemsize * int(np.prod(shape))]
            self.view[name] = field.view(kind).reshape(shape)
        library.c.hmpc_clear(self.at)


def load_library(sources: Sources, flags: Sequence[str] = FLAGS) -> Library:
    """Compile the C, unless the cache holds the library, and load the library."""
    path = compile_library(one_file(sources.texts), flags)
    c = ctypes.CDLL(str(path))
    state, pointer = ctypes.c_void_p, ctypes.c_void_p
    signatures: dict[str, tuple[Any, ...]] = {
        "clear": (state,), "prepare": (state, pointer), "complete": (state,),
        "load_plan": (state, pointer, pointer, pointer, pointer), "feedback": (state, pointer, pointer, ctypes.c_int),
        "decide": (state, pointer, pointer), "begin": (state, pointer, pointer),
    }  # fmt: skip
    if sources.sizes["MODES"]:
        signatures |= dict.fromkeys(("start", "step"), (state, pointer, pointer, pointer, pointer))
        signatures |= {"estimate_start": (state, pointer, pointer), "finish": (state, pointer)}
        signatures |= {"estimate_update": (state, pointer, pointer, pointer)}
    for name, given in signatures.items():
        f = getattr(c, f"hmpc_{name}")
        f.argtypes, f.restype = given, ctypes.c_int if name == "feedback" else None
    places = (ctypes.c_size_t * (len(FIELDS) + 1)).in_dll(c, "hmpc_places")
    return Library(c, sources.sizes, tuple(places))


def one_file(texts: Mapping[str, str]) -> str:
    """Join all sources to one text; each header is inserted once."""
    own = {name: template(name) for name in ("hmpc.h", "hmpc_math.h", *SOURCES)} | dict(texts)
    seen: set[str] = set()

    def written(text: str) -> str:
        lines = []
        for line in text.splitlines():
            name = line.split('"')[1] if line.startswith('#include "') else ""
            if not name:
                lines.append(line)
            elif name in own and name not in seen:  # the backup's headers are not among them
                seen.add(name)
                lines.append(written(own[name]))
        return "\n".join(lines)

    parts = [written(own[name]) for name in SOURCES]
    return "\n".join([*parts, written(_BRIDGE)]) + "\n"
