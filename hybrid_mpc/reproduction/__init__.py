"""The paper's experiments rebuilt: trainings, tables, figures and claims. torch is imported lazily.

``experiment`` (what a scenario says), ``claims`` and ``table`` are plain data; ``run.reproduce`` does the work.
"""

from hybrid_mpc.reproduction.claims import Claim, Verdict
from hybrid_mpc.reproduction.experiment import Effort, Experiment
from hybrid_mpc.reproduction.table import METRICS, Cell, Table

__all__ = ["Experiment", "Effort", "Claim", "Verdict", "Table", "Cell", "METRICS"]
