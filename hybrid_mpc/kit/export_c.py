"""Export of a kit's controller as a folder of C code."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybrid_mpc.embedded.export import write_controller
from hybrid_mpc.errors import InputError
from hybrid_mpc.estimate.tracking import TrackingFilter, with_tracked
from hybrid_mpc.kit.artifact import Kit
from hybrid_mpc.kit.assembly import make_ocp, make_resting_guard
from hybrid_mpc.loop.guard import Guard
from hybrid_mpc.records import known

REACTIONS = ("", "rest", "adapt")
"""Reactions to an alarm in the C code: none, :meth:`Kit.guard`, or the same with an adaptive backup."""


def generate_controller(
    kit: Kit, folder: str | Path, *, model: str = "", task: str = "", load: bool = True, tracking: bool = False,
    single: bool = False, monitor: bool = True, guard: str = "", check: bool = False,
) -> Path:  # fmt: skip
    """Write estimator, real-time iteration, safeguards, monitor and guard as C11, with a test program and a README.

    One period of the C code equals one period of :class:`~hybrid_mpc.loop.loop.Loop`.

    Args:
        kit: The loaded artifact.
        folder: Folder to write; it must be new or empty, or hold an earlier controller.
        model: Name of the model of controller and estimator. Default: the recommended model.
        task: Task whose control problem is solved. Default: the common control problem.
        load: Whether the estimator estimates an unknown load, as :meth:`Kit.observer`. Default: True.
        tracking: Whether the estimator tracks the parameters that differ between recordings, and the controller plans
            with them, as :meth:`Kit.tracking_observer`; of ``kit.blended()`` the share of the correction is one of
            them. Default: False.
        single: Whether numbers are ``float``. Default: False, ``double``.
        monitor: Whether :meth:`Kit.monitor` watches the loop. Default: True.
        guard: Reaction to alarms of ``kit.monitor(kind="guard")``: ``"rest"``, the safe input while a sensor is frozen;
            ``"adapt"``, also a second controller that estimates the prior's changed parameters (:meth:`Kit.guard`).
            Default: none, alarms are only reported.
        check: Whether to compile the C code, run its test, and write its sizes into the README. This executes code that
            was generated from the folder's content. Default: False.

    Returns:
        The folder.

    Raises:
        InputError: If parts of the controller cannot be exported (the message names all of them), the folder holds
            something else, the kit lacks a part of the loop, its monitor or its guard, or the check fails.
        StorageError: If the folder cannot be written; it is then unchanged.

    Example:
        ``hm.generate_controller(hm.load("runs/mine"), "controller")``
    """
    place = Path(folder)
    if place.exists() and not place.is_dir():
        raise InputError(f"{place}: is a file; give a folder [HM-KIT-023]")
    if place.is_dir() and any(place.iterdir()) and not (place / "hmpc.h").is_file():
        raise InputError(f"{place}: folder is not empty; give a new folder [HM-KIT-024]")
    known(guard or "none", ("none", *REACTIONS[1:]), "guard")
    if guard and not monitor:
        raise InputError(
            f"guard: {guard!r} reacts to alarms, so it needs the monitor; set monitor=True [HM-KIT-025]"
        )
    if tracking and guard == "adapt":
        raise InputError(
            "guard: 'adapt' and tracking=True both estimate changed parameters; choose one of them [HM-KIT-043]"
        )
    name, prior = model or kit.recommended, kit.models["prior"]
    make = kit.tracking_observer if tracking else kit.observer
    estimator = make(name, task=task, load=load)
    if isinstance(estimator, TrackingFilter):
        prior = with_tracked(prior, estimator.tracked)
    safe = None if kit.safe_input is None else np.array(kit.safe_input)
    write_controller(
        place, estimator.model, make_ocp(prior, kit.problem(task)), estimator=estimator, fallback=prior,
        safe_input=safe, single=single,
        monitor=kit.monitor(name, task=task, kind="guard" if guard else "", tracking=tracking) if monitor else None,
        guard=_guard(kit, name, task, guard), check=check,
    )  # fmt: skip
    return place


def _guard(kit: Kit, model: str, task: str, reaction: str) -> Guard | None:
    if reaction == "adapt":
        return kit.guard(adapt=True, task=task)
    return make_resting_guard(kit.models[model]) if reaction else None
