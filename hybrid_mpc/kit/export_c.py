"""The controller of a kit as a folder of C."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybrid_mpc.embedded.export import write_controller
from hybrid_mpc.errors import InputError
from hybrid_mpc.kit.artifact import Kit
from hybrid_mpc.kit.assembly import make_ocp, make_resting_guard
from hybrid_mpc.loop.guard import Guard
from hybrid_mpc.records import known

REACTIONS = ("", "rest", "adapt")
"""What an alarm does in the C: nothing, :meth:`Kit.guard`, or the same with a backup that adapts."""


def generate_controller(
    kit: Kit, folder: str | Path, *, model: str = "", task: str = "", load: bool = True, single: bool = False,
    monitor: bool = True, guard: str = "", check: bool = False,
) -> Path:  # fmt: skip
    """Write estimator, real-time iteration, safeguards, monitor and guard as C11, with a test program and a README.

    One period of the C is one of :class:`~hybrid_mpc.loop.loop.Loop`.

    Args:
        kit: The loaded artifact.
        folder: Folder, made if missing; it must be empty, or hold an earlier controller.
        model: Name of the model that plans and estimates. Default: the recommended one.
        task: Whose control problem it solves. Default: the common one.
        load: Whether the estimator follows an unknown load, as :meth:`Kit.observer`. Default: yes.
        single: Whether numbers are ``float``. Default: ``double``.
        monitor: Whether :meth:`Kit.monitor` watches the loop. Default: it does.
        guard: What its alarms do, which are those of ``kit.monitor(kind="guard")`` then: ``"rest"``, no input while a
            sensor is frozen; ``"adapt"``, a second controller too that estimates the prior's changed parameters
            (:meth:`Kit.guard`). Default: nothing, they are told.
        check: Whether the C is compiled and its test is run, and its README has its sizes: code that was made of the
            folder's content runs. Default: no, nothing of it is compiled or run.

    Returns:
        The folder.

    Raises:
        InputError: If something of the controller has no C, all of it by name; if the folder holds something else; if
            the kit lacks something that a loop, its monitor or its guard needs; if the check fails.
        StorageError: If it cannot be written; the folder is then as it was.

    Example:
        ``hm.generate_controller(hm.load("runs/mine"), "controller")``
    """
    place = Path(folder)
    if place.exists() and not place.is_dir():
        raise InputError(f"{place} is a file; give a folder [HM-KIT-023]")
    if place.is_dir() and any(place.iterdir()) and not (place / "hmpc.h").is_file():
        raise InputError(f"{place} is not empty; give a new folder [HM-KIT-024]")
    known(guard or "none", ("none", *REACTIONS[1:]), "guard")
    if guard and not monitor:
        raise InputError(f"guard {guard!r} acts on alarms; leave monitor=True [HM-KIT-025]")
    name = model or kit.recommended
    estimator = kit.observer(name, task=task, load=load)
    prior = kit.models["prior"]
    safe = None if kit.safe_input is None else np.array(kit.safe_input)
    write_controller(
        place, kit.models[name], make_ocp(prior, kit.problem(task)), estimator=estimator, fallback=prior,
        safe_input=safe, single=single,
        monitor=kit.monitor(name, task=task, kind="guard" if guard else "") if monitor else None,
        guard=_guard(kit, name, task, guard), check=check,
    )  # fmt: skip
    return place


def _guard(kit: Kit, model: str, task: str, reaction: str) -> Guard | None:
    if reaction == "adapt":
        return kit.guard(adapt=True, task=task)
    return make_resting_guard(kit.models[model]) if reaction else None
