"""The guard: on an alarm, the loop switches to tighter limits, a backup or the safe input, and back without a bump."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.control.ocp import Limits
from hybrid_mpc.control.problem import Controller, Status
from hybrid_mpc.control.safeguard import Decision, SafeController, Source
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate.kalman import Estimate, Estimator

Array = NDArray[np.float64]
TINY = 1e-9
"""Tolerance [s] of comparisons between times: far below any period, above rounding."""
USED_UP = 10**6
"""Age of a plan that no :class:`SafeController` uses any more, so that its fallback gives the input."""


class Mode(IntEnum):
    """Mode of the loop; a larger number is more cautious."""

    NORMAL = 0
    """The normal controller."""
    LIMITED = 1
    """The normal controller within the guard's limits."""
    BACKUP = 2
    """Another controller with its own estimator, usually the MPC of the fitted prior with observer."""
    FALLBACK = 3
    """The stabilizing feedback of the safeguards."""
    REST = 4
    """The safe input, if a sensor cannot be trusted. The machine must be safe with this input."""


@dataclass(frozen=True)
class Switch:
    """A change of mode with its reason ``why``; ``t`` [s] is the first period of the new mode."""

    t: float
    before: Mode
    after: Mode
    why: str


@dataclass(frozen=True)
class Guard:
    """Reaction of a loop to alarms of its monitor.

    A reading takes effect in the next period. The guard switches to a more cautious mode at once, and back when the
    alarm has been off for ``quiet`` and the mode has lasted for ``dwell``. Switching is bumpless: the input stays
    within ``du_max`` of the last one, the new controller starts from the plan of the old one, and both estimators
    always run. Without an alarm, the loop is the same as without a guard.

    A frozen sensor cannot be distinguished from a machine at rest: the guard stays in ``REST`` until the sensor
    changes. A blind monitor (``reading.blind``: no valid reading for longer than its windows) causes ``on_model``, too.

    Args:
        on_model: Mode if the model does not describe the machine, or the monitor is blind. Default: ``BACKUP`` if there
            is a backup, else ``LIMITED`` if there are limits, else ``FALLBACK``.
        on_sensor: Mode if a sensor is frozen (``reading.frozen``). Default: ``REST``.
        limits: Bounds of the inputs in every mode except ``NORMAL``. Default: those of the problem.
        backup: Controller of ``BACKUP``; a bare controller has no fallback. Default: none.
        backup_estimator: Estimator of the backup. Default: none.
        dwell: Shortest time [s] in a mode before switching back. Default: 0.5.
        quiet: Time [s] without alarm before switching back. Default: 1.
        patience: Time [s] that an alarm of the model must last before ``on_model``; alarms less than ``quiet`` apart
            count as one alarm. The normal controller's observer handles a short push better than a backup. A frozen
            sensor always takes effect at once. Default: 0.

    Raises:
        InputError: If a mode lacks its parts, a time is negative, or ``patience`` is given with ``quiet=0``.

    Example:
        >>> Guard(limits=Limits([-0.2], [0.2])).on_model.name, Guard().on_model.name
        ('LIMITED', 'FALLBACK')
    """

    on_model: Mode
    on_sensor: Mode
    limits: Limits | None
    backup: SafeController | None
    backup_estimator: Estimator | None
    dwell: float
    quiet: float
    patience: float

    def __init__(
        self,
        on_model: Mode | None = None,
        on_sensor: Mode = Mode.REST,
        *,
        limits: Limits | None = None,
        backup: SafeController | Controller | None = None,
        backup_estimator: Estimator | None = None,
        dwell: float = 0.5,
        quiet: float = 1.0,
        patience: float = 0.0,
    ) -> None:
        if (backup is None) != (backup_estimator is None):
            raise InputError(
                "guard: backup needs backup_estimator and vice versa; give both or neither [HM-LOOP-010]"
            )
        guarded = backup if backup is None or isinstance(backup, SafeController) else SafeController(backup)
        if on_model is None:
            on_model = Mode.BACKUP if guarded else Mode.LIMITED if limits else Mode.FALLBACK
        if Mode.BACKUP in (on_model, on_sensor) and guarded is None:
            raise InputError(
                "guard: mode BACKUP needs a controller and its estimator; give backup and backup_estimator "
                "[HM-LOOP-011]"
            )
        if Mode.LIMITED in (on_model, on_sensor) and limits is None:
            raise InputError(
                "guard: mode LIMITED needs limits; give e.g. Limits([-0.2], [0.2]) [HM-LOOP-012]"
            )
        times = float(dwell), float(quiet), float(patience)
        if not all(0 <= value < math.inf for value in times):
            raise InputError(
                f"guard: dwell, quiet and patience must be 0 s or more, got {dwell} s, {quiet} s and {patience} s"
                " [HM-LOOP-013]"
            )
        if patience > 0 and quiet == 0:
            raise InputError(
                f"guard: patience of {patience} s needs quiet above 0 s, to separate one alarm from the next"
                " [HM-LOOP-014]"
            )
        values = on_model, on_sensor, limits, guarded, backup_estimator, *times
        for name, value in zip(self.__dataclass_fields__, values, strict=True):
            object.__setattr__(self, name, value)


@dataclass(frozen=True)
class GuardState:
    """State of a guard between two periods; times are in seconds.

    Args:
        mode: The present mode, and the time ``since`` it has been active.
        wanted: The mode of the next period, and the reason ``why``.
        alarm: Time of the last alarm; ``doubt``: begin of the present sequence of alarms.
        frozen: Time of the last reading with a frozen sensor.
        backup: Estimate of the backup's estimator; None without a backup, and before the first sample.
        planner: Origin of the last plan: ``"controller"``, ``"backup"``, or ``"nobody"`` (at rest).
        switches: All changes of the mode.
    """

    mode: Mode = Mode.NORMAL
    wanted: Mode = Mode.NORMAL
    why: str = ""
    since: float = 0.0
    alarm: float = -math.inf
    doubt: float = -math.inf
    frozen: float = -math.inf
    backup: Estimate | None = None
    planner: Literal["controller", "backup", "nobody"] = "controller"
    switches: tuple[Switch, ...] = ()


class GuardedController:
    """A controller that changes with the guard's mode; its state is a :class:`GuardState`."""

    def __init__(self, safe: SafeController, guard: Guard | None = None) -> None:
        self.safe, self.guard = safe, guard
        if guard is not None and Mode.REST in (guard.on_model, guard.on_sensor) and safe.safe_input is None:
            raise InputError(
                "guard: mode REST needs a safe input, which may act without supervision. Give "
                "Scenario(safe_input=...) or SafeController(safe_input=...) [HM-LOOP-015]"
            )
        self._backup = safe if guard is None or guard.backup is None else guard.backup
        if guard is not None and guard.backup is not None and guard.backup_estimator is not None:
            _check_alike(safe.controller, guard.backup.controller, guard.backup_estimator)

    def measured(
        self, state: GuardState, t: float, y: Array, u_prev: Array, w: Array | None = None
    ) -> GuardState:
        """State after a sample ``y`` ``(n_y,)`` at ``t``, with ``u_prev`` held before it; the wanted mode begins now.

        ``w`` ``(n_w,)`` are the measured disturbances at ``t``; None without any.
        """
        if state.wanted is not state.mode:
            switch = Switch(t, state.mode, state.wanted, state.why)
            state = replace(state, mode=state.wanted, since=t, switches=(*state.switches, switch))
        estimator = None if self.guard is None else self.guard.backup_estimator
        if estimator is None:
            return state
        known, also = state.backup, {} if w is None else {"w": w}
        backup = (
            estimator.start(y, t, **also) if known is None else estimator.update(known, y, u_prev, **also)
        )
        return replace(state, backup=backup)

    def decide(
        self, state: GuardState, previous: Decision, estimate: Estimate, reference: Array,
        weight: Array | None = None, *, prepared: Any = None, late: bool = False, w: Array | None = None,
    ) -> tuple[Decision, GuardState]:  # fmt: skip
        """The input to hold from now on, from the mode's controller; see :meth:`SafeController.decide`.

        ``late``: the solve missed its deadline; see :meth:`SafeController.late`.
        """
        bounds = None if state.mode is Mode.NORMAL or self.guard is None else self.guard.limits
        if state.mode is Mode.REST:
            return self._rest(previous, bounds), replace(state, planner="nobody")
        safe, known = self.safe, estimate
        if state.mode is Mode.BACKUP and state.backup is not None:
            safe, known = self._backup, state.backup
        before, state = self._hand_over(state, previous, safe, known)
        if late:
            return safe.late(before, known, reference, limits=bounds), state
        if state.mode is Mode.FALLBACK:
            decision = safe.late(replace(before, age=USED_UP), known, reference, limits=bounds)
            return replace(decision, status=Status.INITIAL, age=0), state
        return safe.decide(before, known, reference, weight, limits=bounds, prepared=prepared, w=w), state

    def prepare(self, state: GuardState, decision: Decision, weight: Array | None) -> Any:
        """Part of the next solve that can be computed now; None without such a part, or if another plan is used."""
        if state.wanted in (Mode.FALLBACK, Mode.REST):
            return None
        safe = self._backup if state.wanted is Mode.BACKUP and state.backup is not None else self.safe
        return safe.prepare(decision, weight) if self._name_planner(safe) == state.planner else None

    def watched(self, state: GuardState, t: float, reading: Any) -> GuardState:
        """State after the monitor's reading of the period at ``t``, which determines the next period's mode."""
        guard = self.guard
        if guard is None:
            return state
        alarm, doubt, frozen = state.alarm, state.doubt, state.frozen
        if reading.alarm:
            if t - alarm >= guard.quiet - TINY:
                doubt = t
            alarm = t
        if getattr(reading, "frozen", False):
            frozen = t
        on = alarm == t or t - alarm < guard.quiet - TINY
        if frozen == t or t - frozen < guard.quiet - TINY:
            names = ", ".join(getattr(reading, "frozen_outputs", ()))
            why = "the sensor repeats its value while motion is predicted" + (f": {names}" if names else "")
            wanted = guard.on_sensor
        elif on and alarm - doubt >= guard.patience - TINY:
            blind = getattr(reading, "blind", False)
            wanted = guard.on_model
            names = ", ".join(getattr(reading, "channels", ()))
            why = "the monitor has no valid reading" if blind else "the model does not describe the machine"
            why += f": {names}" if names and not blind else ""
        else:
            wanted, why = Mode.NORMAL, f"no alarm for {guard.quiet:g} s"
        if wanted < state.mode and t - state.since < guard.dwell - TINY:
            wanted = state.mode
        return replace(state, wanted=wanted, why=why, alarm=alarm, doubt=doubt, frozen=frozen)

    def _name_planner(self, safe: SafeController) -> Literal["controller", "backup"]:
        return "controller" if safe is self.safe else "backup"

    def _hand_over(
        self, state: GuardState, previous: Decision, safe: SafeController, estimate: Estimate
    ) -> tuple[Decision, GuardState]:
        """The previous decision as one of ``safe``: the inputs of its plan, simulated with the model of ``safe``."""
        planner = self._name_planner(safe)
        if planner == state.planner:
            return previous, state
        finite = replace(
            estimate, **{name: np.nan_to_num(getattr(estimate, name)) for name in ("x", "h", "d", "w")}
        )
        following = safe.controller.initial(finite, previous.solution.following).delayed(previous.u)
        decision = Decision(previous.u, previous.source, following, Status.INITIAL, 0)
        return decision, replace(state, planner=planner)

    def _rest(self, previous: Decision, limits: Limits | None) -> Decision:
        """The safe input, approached within ``du_max``."""
        ocp, safe = self.safe.controller.ocp, self.safe.safe_input
        assert safe is not None  # checked when the guard was made
        u, way = self.safe.controller.problem.soft.on_inputs.keep(safe, previous.u, limits)
        plan = replace(previous.solution, u=np.tile(u, (ocp.horizon, 1)), given_way=way)
        return Decision(u, Source.SAFE, plan, Status.INITIAL, 0)


def _check_alike(main: Controller, backup: Controller, estimator: Estimator) -> None:
    shapes = [(c.model.n_x, c.ocp.n_u, c.ocp.horizon, c.model.dt) for c in (main, backup)]
    if shapes[0] != shapes[1]:
        raise InputError(
            f"guard: the backup has (n_x, n_u, N, dt) = {shapes[1]}, but the controller has {shapes[0]}. Give both the "
            "same problem"
            " [HM-LOOP-016]"
        )
    sizes = [(m.n_x, m.n_h, m.n_u) for m in (backup.model, estimator.model)]
    if sizes[0] != sizes[1]:
        raise InputError(
            f"guard: the backup's model has (n_x, n_h, n_u) = {sizes[0]}, but its estimator's model has {sizes[1]}. "
            "Give both the same model"
            " [HM-LOOP-017]"
        )
