"""A loop that reacts: on an alarm tighter limits, another controller, or rest; and back, without a bump."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybrid_mpc.errors import InputError
from hybrid_mpc.estimation.kalman import Estimate, Estimator
from hybrid_mpc.mpc.limits import Limits
from hybrid_mpc.mpc.problem import Controller
from hybrid_mpc.mpc.safeguard import Decision, SafeController, Source
from hybrid_mpc.mpc.solution import Solution, Status

Array = NDArray[np.float64]
TINY = 1e-9
"""Tolerance [s] of comparisons between times; far below any period, above rounding."""
USED_UP = 10**6
"""Age of a plan that no :class:`SafeController` follows any more, so that its fallback takes over."""


class Mode(IntEnum):
    """How the loop is run, the more careful the larger."""

    NORMAL = 0
    """The controller as it is."""
    LIMITED = 1
    """The same controller within the guard's limits."""
    BACKUP = 2
    """Another controller with an estimator of its own: usually the MPC of the fitted prior with observer."""
    FALLBACK = 3
    """The stabilising feedback of the safeguards."""
    REST = 4
    """No input: what is left where the sensor cannot be believed. The machine must come to rest by itself."""


@dataclass(frozen=True)
class Switch:
    """A change of mode.

    Args:
        t: First instant [s] at which the new mode decides.
        before: Mode until then.
        after: Mode from then on.
        why: In words.
    """

    t: float
    before: Mode
    after: Mode
    why: str


@dataclass(frozen=True)
class Guard:
    """What a loop does on alarms of its monitor.

    A reading of one period acts in the next. To a more careful mode the guard goes at once; back, when the alarm that
    asked for it has been off for ``quiet`` and the mode has lasted for ``dwell``. On the way from one controller to
    another nothing jumps: the input is held within ``du_max`` of the last one, the new controller begins from the old
    one's plan, and both estimators run all the time. While no alarm comes the loop is the same as without a guard.

    A frozen sensor and a machine at rest look alike: in ``REST`` the guard stays there until the sensor moves.

    A monitor that judges nothing for longer than its windows (``reading.blind``: samples are missing, or model or
    estimator gives no number) has failed: that is no quiet, and asks for ``on_model`` as a doubt of the model does.

    Args:
        on_model: Mode where the model does not describe the machine, or nobody can say whether it does. Default:
            ``LIMITED`` or ``BACKUP``, whichever there is something for, else ``FALLBACK``.
        on_sensor: Mode where the sensor is frozen (``reading.frozen``). Default ``REST``.
        limits: Bounds of the inputs in every mode but ``NORMAL``. Default: the problem's own.
        backup: Controller of ``BACKUP``; a bare one is guarded without fallback.
        backup_estimator: Its estimator.
        dwell: Shortest time [s] in a mode before going back. Default 0.5.
        quiet: Time [s] without alarm before going back. Default 1.
        patience: Time [s] for which the model must have been in doubt before ``on_model``; alarms less than ``quiet``
            apart count as one. A push is over by then, and the normal controller's observer deals with it better than
            a backup that takes it for a fault. A frozen sensor is never waited for. Default 0: at once.

    Raises:
        InputError: If a mode lacks what it needs, a time is negative, or there is patience without quiet.

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
            raise InputError("guard: backup and backup_estimator belong together; give both or neither")
        guarded = backup if backup is None or isinstance(backup, SafeController) else SafeController(backup)
        if on_model is None:
            on_model = Mode.BACKUP if guarded else Mode.LIMITED if limits else Mode.FALLBACK
        if Mode.BACKUP in (on_model, on_sensor) and guarded is None:
            raise InputError(
                "guard: mode BACKUP needs a controller and its estimator: backup, backup_estimator"
            )
        if Mode.LIMITED in (on_model, on_sensor) and limits is None:
            raise InputError("guard: mode LIMITED needs limits, e.g. Limits([-0.2], [0.2])")
        times = float(dwell), float(quiet), float(patience)
        if not all(0 <= value < math.inf for value in times):
            raise InputError(
                f"guard: dwell, quiet and patience must be 0 s or more, got {dwell} s, {quiet} s and {patience} s"
            )
        if patience > 0 and quiet == 0:
            raise InputError(
                f"guard: patience of {patience} s needs a quiet above 0 s, to tell one alarm from the next"
            )
        values = on_model, on_sensor, limits, guarded, backup_estimator, *times
        for name, value in zip(self.__dataclass_fields__, values, strict=True):
            object.__setattr__(self, name, value)

    def begin(self, safe: SafeController) -> GuardedLoop:
        """The guarded controller of one run.

        Args:
            safe: The loop's own controller.

        Raises:
            InputError: If the backup has another problem or period.
        """
        if self.backup is not None and self.backup_estimator is not None:
            _check_alike(safe.controller, self.backup.controller, self.backup_estimator)
        return GuardedLoop(self, safe)


class GuardedLoop:
    """A controller that changes with the guard's mode; unlike the guard it remembers, for one run.

    To a loop it is a :class:`~hybrid_mpc.mpc.SafeController` that is told in addition what was measured
    (:meth:`measured`, before it decides) and what the monitor said (:meth:`watched`, after it).

    Args:
        guard: The policy.
        safe: The loop's own controller.
    """

    def __init__(self, guard: Guard, safe: SafeController) -> None:
        self._guard, self._safe = guard, safe
        self._mode = self._next = Mode.NORMAL
        self._made: tuple[Solution | None, SafeController] = None, safe
        self._since, self._why = 0.0, ""
        self._alarm = self._frozen = -math.inf
        self._doubt = -math.inf
        self._estimate: Estimate | None = None
        self.switches: list[Switch] = []

    @property
    def controller(self) -> Controller:
        """The controller of the normal mode."""
        return self._safe.controller

    @property
    def mode(self) -> Mode:
        """The present mode."""
        return self._mode

    def initial(
        self,
        estimate: Estimate,
        u: Array | None = None,
        reference: Array | None = None,
        weight: Array | None = None,
    ) -> Decision:
        """As :meth:`SafeController.initial`."""
        return self._own(self._safe.initial(estimate, u, reference, weight), self._safe)

    def measured(self, t: float, y: Array, u_prev: Array) -> None:
        """A sample ``y`` ``(n_y,)`` at ``t`` with ``u_prev`` held before it; the mode asked for begins now."""
        if self._next is not self._mode:
            self.switches.append(Switch(t, self._mode, self._next, self._why))
            self._mode, self._since = self._next, t
        estimator = self._guard.backup_estimator
        if estimator is None:
            return
        if self._estimate is None:
            self._estimate = estimator.start(y, t)
        else:
            self._estimate = estimator.update(self._estimate, y, u_prev)

    def decide(
        self, previous: Decision, estimate: Estimate, reference: Array, weight: Array | None = None,
        *, limits: Limits | None = None,
    ) -> Decision:  # fmt: skip
        """The input to hold from now on, by the mode's controller; see :meth:`SafeController.decide`."""
        mode, bounds = self._mode, self._bounds(limits)
        if mode is Mode.REST:
            return self._rest(previous, bounds)
        safe, known = self._active(estimate)
        before = self._handed(previous, safe, known)
        if mode is Mode.FALLBACK:
            decision = safe.late(replace(before, age=USED_UP), known, reference, limits=bounds)
            return self._own(replace(decision, status=Status.INITIAL, age=0), safe)
        return self._own(safe.decide(before, known, reference, weight, limits=bounds), safe)

    def late(
        self, previous: Decision, estimate: Estimate, reference: Array, *, limits: Limits | None = None
    ) -> Decision:
        """The input where a solve has not come in time; see :meth:`SafeController.late`."""
        if self._mode is Mode.REST:
            return self._rest(previous, self._bounds(limits))
        safe, known = self._active(estimate)
        before = self._handed(previous, safe, known)
        return self._own(safe.late(before, known, reference, limits=self._bounds(limits)), safe)

    def watched(self, t: float, reading: Any) -> None:
        """What the monitor said of the period at ``t``; decides on the next period's mode."""
        guard = self._guard
        if reading.alarm:
            if t - self._alarm >= guard.quiet - TINY:
                self._doubt = t
            self._alarm = t
        if getattr(reading, "frozen", False):
            self._frozen = t
        if self._frozen == t or t - self._frozen < guard.quiet - TINY:
            wanted, why = guard.on_sensor, "the sensor repeats itself while motion is predicted"
        elif self._in_doubt(t):
            blind = getattr(reading, "blind", False)
            said = "the monitor cannot judge" if blind else "the model does not describe the machine"
            wanted, why = guard.on_model, said
        else:
            wanted, why = Mode.NORMAL, f"no alarm for {guard.quiet:g} s"
        back = wanted < self._mode
        if back and t - self._since < guard.dwell - TINY:
            wanted = self._mode
        self._next, self._why = wanted, why

    def _in_doubt(self, t: float) -> bool:
        """True while alarms come that have come for the time of patience."""
        on = self._alarm == t or t - self._alarm < self._guard.quiet - TINY
        return on and self._alarm - self._doubt >= self._guard.patience - TINY

    def _active(self, estimate: Estimate) -> tuple[SafeController, Estimate]:
        backup = self._guard.backup
        if self._mode is Mode.BACKUP and backup is not None and self._estimate is not None:
            return backup, self._estimate
        return self._safe, estimate

    def _bounds(self, limits: Limits | None) -> Limits | None:
        own = None if self._mode is Mode.NORMAL else self._guard.limits
        return limits if own is None else own

    def _own(self, decision: Decision, safe: SafeController) -> Decision:
        """Notes whose plan this is."""
        self._made = decision.solution, safe
        return decision

    def _handed(self, previous: Decision, safe: SafeController, estimate: Estimate) -> Decision:
        """The decision before as one of ``safe``'s: its plan's inputs, run through the model of ``safe``."""
        plan, owner = self._made
        if plan is previous.solution and owner is safe:
            return previous
        u = np.vstack([previous.solution.u[1:], previous.solution.u[-1:]])
        finite = replace(
            estimate, **{name: np.nan_to_num(getattr(estimate, name)) for name in ("x", "h", "d")}
        )
        following = safe.controller.initial(finite, u).delayed(previous.u)
        return Decision(previous.u, previous.source, following, Status.INITIAL, 0)

    def _rest(self, previous: Decision, limits: Limits | None) -> Decision:
        """No input, as soon as ``du_max`` lets it be none."""
        ocp = self._safe.controller.ocp
        u = ocp.saturate(np.zeros(ocp.n_u), previous.u, limits)
        plan = replace(previous.solution, u=np.tile(u, (ocp.horizon, 1)))
        return Decision(u, Source.ZERO, plan, Status.INITIAL, 0)


def _check_alike(main: Controller, backup: Controller, estimator: Estimator) -> None:
    shapes = [(c.model.n_x, c.ocp.n_u, c.ocp.horizon, c.model.dt) for c in (main, backup)]
    if shapes[0] != shapes[1]:
        raise InputError(
            f"guard: the backup has (n_x, n_u, N, dt) = {shapes[1]}, the controller {shapes[0]}; give both one problem"
        )
    sizes = [(m.n_x, m.n_h, m.n_u) for m in (backup.model, estimator.model)]
    if sizes[0] != sizes[1]:
        raise InputError(
            f"guard: the backup's model has (n_x, n_h, n_u) = {sizes[0]}, that of its estimator {sizes[1]}"
        )
