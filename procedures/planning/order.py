"""The order in which constraints are visited."""

from __future__ import annotations

import itertools

import numpy as np

from dualcal_hal.transforms import Array


def shortest_order(first: Array, between: Array) -> list[int]:
    """The order of k stops with the least sum of costs found: nearest neighbour, improved by 2-opt.

    first: (k,) cost of the way to each from the start; between: (k, k) from each row's to each column's, which may
    differ with the direction. The way ends at the last stop (G. Croes, A Method for Solving Traveling-Salesman
    Problems, 1958).
    """
    order = _nearest_neighbours(first, between)
    cost = _cost(order, first, between)
    improved = True
    while improved:
        improved = False
        for i, j in itertools.combinations(range(len(order) + 1), 2):
            other = [*order[:i], *reversed(order[i:j]), *order[j:]]
            other_cost = _cost(other, first, between)
            if other_cost < cost:
                order, cost, improved = other, other_cost, True
    return order


def _nearest_neighbours(first: Array, between: Array) -> list[int]:
    order: list[int] = []
    left = set(range(len(first)))
    costs = first
    while left:
        order.append(min(left, key=lambda i: (costs[i], i)))
        left.remove(order[-1])
        costs = between[order[-1]]
    return order


def _cost(order: list[int], first: Array, between: Array) -> float:
    return float(first[order[0]] + np.sum(between[order[:-1], order[1:]])) if order else 0.0
