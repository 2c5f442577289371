"""Everything of this package, for the models of one artifact: what ``hybrid-mpc analyze`` computes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from hybrid_mpc.analysis.study_loops import loops_part, schedule_part
from hybrid_mpc.analysis.study_models import POINTS, Part, equilibria_part, friction_part, linear_part, rest
from hybrid_mpc.analysis.study_signals import measured_part, memory_part, sensitivity_part
from hybrid_mpc.analysis.subject import Subject
from hybrid_mpc.errors import InputError

Say = Callable[[str, int, int, str], None]


@dataclass(frozen=True)
class Findings:
    """Numbers of an analysis.

    Args:
        result: Plain numbers, for JSON; a part that could not be had holds its ``reason``.
        arrays: Curves by name, ``"bode/hybrid/rest/magnitude"``.
    """

    result: Mapping[str, Any]
    arrays: Mapping[str, Any]


def study(subject: Subject, say: Say | None = None) -> Findings:
    """Analyse the models of a subject, part after part; a part that cannot be had says why.

    Args:
        subject: What is analysed.
        say: Called with ``(part, done, total, text)``. Default: nothing is said.
    """
    result: dict[str, Any] = {}
    arrays: dict[str, Any] = {}
    points = {name: rest(subject, model) for name, model in subject.models.items()}
    parts: dict[str, Callable[[], Part]] = {
        "equilibria": lambda: equilibria_part(subject),
        "friction": lambda: friction_part(subject, points),
        "linear": lambda: linear_part(subject, points),
        "measured": lambda: measured_part(subject),
        "schedule": lambda: schedule_part(subject),
        "loops": lambda: loops_part(subject, points),
        "memory": lambda: memory_part(subject),
        "sensitivity": lambda: sensitivity_part(subject),
    }
    for i, (name, part) in enumerate(parts.items()):
        if say is not None:
            say("parts", i, len(parts), name)
        try:
            result[name], found = part()
            arrays |= {f"{name}/{key}": value for key, value in found.items()}
        except InputError as error:
            result[name] = {"reason": str(error)}
    return Findings(result, arrays)


__all__ = ["POINTS", "Findings", "Subject", "study"]
