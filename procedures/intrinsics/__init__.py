"""Camera matrix and distortion from the cell itself: the passive arm shows the target over the whole image."""

from procedures.intrinsics.procedure import IntrinsicsProcedure, SeenView, views_of
from procedures.intrinsics.result import IntrinsicsResult, intrinsics_result

__all__ = ["IntrinsicsProcedure", "IntrinsicsResult", "SeenView", "intrinsics_result", "views_of"]
