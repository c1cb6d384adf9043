"""What a run has to show: pictures of the plan and of the result, and tables for the command line."""

from procedures.report.one_arm import draw_one_arm
from procedures.report.one_arm_tables import one_arm_tables, views_table
from procedures.report.plan_picture import draw_plan
from procedures.report.summary import draw_summary
from procedures.report.tables import (
    error_table,
    mismatch_table,
    outcome,
    plan_table,
    posture_table,
    result_tables,
    way_table,
)
from procedures.report.triples import triples_tables

__all__ = [
    "draw_one_arm",
    "draw_plan",
    "draw_summary",
    "error_table",
    "mismatch_table",
    "one_arm_tables",
    "outcome",
    "plan_table",
    "posture_table",
    "result_tables",
    "triples_tables",
    "views_table",
    "way_table",
]
