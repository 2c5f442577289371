"""Studies: many closed loops from one configuration, on one machine or a cluster, none of them lost."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from hybrid_mpc.job.loops import LoopSpec, varied
from hybrid_mpc.studies.configuration import Study
from hybrid_mpc.studies.draws import FaultKind, RandomFaults
from hybrid_mpc.studies.dry_run import Plan, dry_run
from hybrid_mpc.studies.files import read_study
from hybrid_mpc.studies.ready import ready_study
from hybrid_mpc.studies.results import StudyResults
from hybrid_mpc.studies.runner import run_study

if TYPE_CHECKING:
    from hybrid_mpc.studies.report import write_study_report

__all__ = [
    "FaultKind",
    "Plan",
    "RandomFaults",
    "LoopSpec",
    "Study",
    "StudyResults",
    "dry_run",
    "read_study",
    "ready_study",
    "run_study",
    "varied",
    "write_study_report",
]


def __getattr__(name: str) -> Any:
    # loaded when asked for: it brings matplotlib along, and workers do without
    if name == "write_study_report":
        return import_module("hybrid_mpc.studies.report").write_study_report
    raise AttributeError(f"module 'hybrid_mpc.studies' has no attribute {name!r}")
