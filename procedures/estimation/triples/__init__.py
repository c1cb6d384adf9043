"""Pose triples A, B, C of AXB = YCZ: hand-eye, base to base and target mount at once, from poses made anywhere.

======  =====================================================  ========  =================================
matrix  what it is                                             METHOD    known
======  =====================================================  ========  =================================
A       flange 1 in base 1 (the arm that carries the camera)   T_A_H     measured, for each triple
B       target in the camera                                   T_E_T     measured, for each triple
C       flange 2 in base 2 (the arm that carries the target)   T_P_F     measured, for each triple
X       camera in flange 1                                     T_H_E     sought
Y       base 2 in base 1                                       T_A_P     sought; T_P_A is its inverse
Z       target in flange 2                                     T_F_T     sought
======  =====================================================  ========  =================================

Both sides are the target in base 1, ``T_A_H T_H_E T_E_T = T_A_P T_P_F T_F_T``. Anything else of the same form will do.
Errors are motions [translation in m; rotation in rad] in the child frame: true = measured moved by the error.
"""

from procedures.estimation.triples.closed_form import FEWEST_FOR_KRONECKER, Solution, solve_in_closed_form
from procedures.estimation.triples.estimate import FEWEST_TRIPLES, TripleEstimate, estimate_triples
from procedures.estimation.triples.noise import TripleNoise

__all__ = [
    "FEWEST_FOR_KRONECKER",
    "FEWEST_TRIPLES",
    "Solution",
    "TripleEstimate",
    "TripleNoise",
    "estimate_triples",
    "solve_in_closed_form",
]
