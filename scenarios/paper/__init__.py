"""The paper's experiments rebuilt: trainings, tables, figures and claims."""
