"""The HTML report of the main job and the schema of its ``results.json``. No torch in here."""

from hybrid_mpc.report.page import KeyFigure, Report, Section, Table, write_report
from hybrid_mpc.report.schema import SCHEMA_VERSION, validate_results

__all__ = ["KeyFigure", "Report", "SCHEMA_VERSION", "Section", "Table", "validate_results", "write_report"]
