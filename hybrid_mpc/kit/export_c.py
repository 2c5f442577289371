"""The controller of a kit as a folder of C."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hybrid_mpc.embedded.export import write_controller
from hybrid_mpc.errors import InputError
from hybrid_mpc.kit.artifact import Kit
from hybrid_mpc.kit.assembly import make_ocp


def generate_controller(
    kit: Kit, folder: str | Path, *, model: str = "", task: str = "", load: bool = True, single: bool = False
) -> Path:
    """Write estimator, real-time iteration and safeguards as C11, with a test program and a README.

    One period of the C is one of :class:`~hybrid_mpc.loop.loop.Loop`, without monitor and guard.

    Args:
        kit: The loaded artifact.
        folder: Folder, made if missing; it must be empty, or hold an earlier controller.
        model: Name of the model that plans and estimates. Default: the recommended one.
        task: Whose control problem it solves. Default: the common one.
        load: Whether the estimator follows an unknown load, as :meth:`Kit.observer`. Default: yes.
        single: Whether numbers are ``float``. Default: ``double``.

    Returns:
        The folder.

    Raises:
        InputError: If something of the controller has no C, all of it by name; if the folder holds something else; if
            the kit lacks something that a loop needs.

    Example:
        ``hm.generate_controller(hm.load("runs/mine"), "controller")``
    """
    place = Path(folder)
    if place.exists() and not place.is_dir():
        raise InputError(f"{place} is a file; give a folder")
    if place.is_dir() and any(place.iterdir()) and not (place / "hmpc.h").is_file():
        raise InputError(f"{place} is not empty; give a new folder")
    name = model or kit.recommended
    estimator = kit.observer(name, task=task, load=load)
    prior = kit.models["prior"]
    safe = None if kit.safe_input is None else np.array(kit.safe_input)
    write_controller(
        place, kit.models[name], make_ocp(prior, kit.problem(task)), estimator=estimator, fallback=prior,
        safe_input=safe, single=single,
    )  # fmt: skip
    return place
