"""What a run has to show: one picture, and tables for the command line."""

from procedures.report.summary import draw_summary
from procedures.report.tables import error_table, mismatch_table, outcome, plan_table, result_tables, way_table

__all__ = [
    "draw_summary",
    "error_table",
    "mismatch_table",
    "outcome",
    "plan_table",
    "result_tables",
    "way_table",
]
