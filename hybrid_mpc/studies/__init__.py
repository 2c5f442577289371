"""Studies: many closed loops from one configuration, on one machine or a cluster, none of them lost."""

from hybrid_mpc.studies.configuration import Study
from hybrid_mpc.studies.draws import FaultKind, RandomFaults
from hybrid_mpc.studies.files import read_study
from hybrid_mpc.studies.ready import ready_study
from hybrid_mpc.studies.results import StudyResults
from hybrid_mpc.studies.run_config import RunConfig
from hybrid_mpc.studies.runner import run_study

__all__ = [
    "FaultKind",
    "RandomFaults",
    "RunConfig",
    "Study",
    "StudyResults",
    "read_study",
    "ready_study",
    "run_study",
]
