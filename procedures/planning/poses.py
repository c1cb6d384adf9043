"""Selection of poses: of many candidates those that tell most, in an order that can be visited quickly."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dualcal_hal.errors import NoPlan
from dualcal_hal.session.captures import Use
from dualcal_hal.transforms import Array
from procedures.planning.advice import advice
from procedures.planning.belief import Belief
from procedures.planning.candidates import Candidate, CandidateSource
from procedures.planning.choice import LEAST_SPREAD, LEAST_TURN, Knowledge, most_informative
from procedures.planning.model import ArmModel, CellModel, Posture
from procedures.planning.order import shortest_order
from procedures.planning.plan import Plan, PlannedConstraint, PlannedPosition
from procedures.planning.ways import Leg, WayFinder

POINT_SECONDS = 0.1
"""What pictures, corrections and settling take at a position besides the way there, as simulated runs have it."""

_POOLS = (6, 12, 24)  # candidates drawn for each constraint of a use; more where fewer do not do
_LEAST_WHOLE = 6  # constraints that a pool is large enough for, however few are wanted
_AXES_TRIED = 2000
_AXES_FOR_ADVICE = 200
_WAYS_MISSED = 16
"""Constraints that no way leads to, after which the start or the cell is to blame and no longer the candidates."""

_NO_WAY = "no clear way to the constraint"


@dataclass(frozen=True, eq=False)
class Request:
    """How many constraints of a use, each with how many positions.

    Their names count from ``first_number``; ``captured`` are constraints of this use that there are already, which
    the new ones shall complete.
    """

    use: Use
    constraints: int
    positions: int
    first_number: int = 0
    captured: tuple[PlannedConstraint, ...] = ()


@dataclass(frozen=True, eq=False)
class _Stop:
    """A candidate with the way that leads there."""

    candidate: Candidate
    way: tuple[Leg, ...]
    seconds: float


class PosePlanner:
    """Draws and chooses poses for one belief; the same seed gives the same poses."""

    def __init__(self, model: CellModel, belief: Belief, ways: WayFinder, seed: Sequence[int]) -> None:
        self._model = model
        self._belief = belief
        self._ways = ways
        self._source = CandidateSource(model, belief, np.random.default_rng(list(seed)))
        self.refused = self._source.refused
        self._straight: dict[Candidate, bool] = {}
        self._found: dict[tuple[Posture, Posture], tuple[Leg, ...] | None] = {}

    def plan(self, requests: Sequence[Request], start: Posture, *, provisional: bool) -> Plan:
        """Constraints for all requests, in an order in which each can be reached from the one before.

        Raises NoPlan, which says how many candidates failed which condition.
        """
        planned: list[PlannedConstraint] = []
        posture, spread = start, None
        for request in requests:
            known = self._known(request.captured)
            stops = self._select(request, known, posture)
            posture = _end(stops[-1].candidate)
            planned += [self._planned(stop, request, number) for number, stop in enumerate(stops)]
            if request.use == "calibration":
                spread = Knowledge.together([known, *(stop.candidate.knowledge for stop in stops)]).spread
        return Plan(tuple(planned), spread, dict(self.refused), provisional, self._belief.source)

    def _select(self, request: Request, known: Knowledge, start: Posture) -> list[_Stop]:
        """From a pool that grows until it holds a choice that keeps all conditions."""
        pool: list[Candidate] = []
        drawn, whole = 0, max(_LEAST_WHOLE, request.constraints + len(request.captured))
        for share in _POOLS:
            new = self._source.draw(request.positions, share * whole - drawn, _AXES_TRIED)
            drawn += len(new)
            pool += new
            stops = self._visitable(pool, request, known, start)
            if stops:
                return stops
            if not drawn:
                break
        raise NoPlan(self._refusal(request, pool))

    def _visitable(
        self, pool: list[Candidate], request: Request, known: Knowledge, start: Posture
    ) -> list[_Stop] | None:
        """The best choice from the pool in its order of visit; candidates that cannot be visited leave the pool."""
        while len(pool) >= request.constraints:
            chosen = self._choice(pool, request, known)
            if chosen is None:
                return None
            # Ways cost most to judge: only those of candidates that would be chosen are.
            lost = [candidate for candidate in chosen if not self._is_straight(candidate)]
            self.refused["the way between two positions is not clear"] += len(lost)
            if not lost:
                ordered = self._in_order(chosen, start)
                stops = self._visit(ordered, start)
                missed = len(stops) if len(stops) < len(ordered) else self._first_too_close(stops, start)
                if missed is None:
                    return stops
                lost = [ordered[missed]]
            pool[:] = [candidate for candidate in pool if candidate not in lost]
        return None

    def _choice(self, pool: Sequence[Candidate], request: Request, known: Knowledge) -> list[Candidate] | None:
        calibrates = request.use == "calibration"
        knowledge = [candidate.knowledge for candidate in pool]
        numbers = most_informative(knowledge, request.constraints, known, well_spread=calibrates)
        together = Knowledge.together([known, *(knowledge[i] for i in numbers)])
        if calibrates and not together.well_spread:
            self.refused["the axes of the best choice do not spread"] += together.spread < LEAST_SPREAD
            self.refused["the flange is not turned by 30 degrees about two axes"] += together.turn < LEAST_TURN
            return None
        return [pool[i] for i in numbers]

    def _is_straight(self, candidate: Candidate) -> bool:
        """Whether the passive arm can go straight from each position to the next."""
        if candidate not in self._straight:
            passive = self._model.passive.name
            self._straight[candidate] = self._ways.clear(passive, _begin(candidate), candidate.passive[1:])
        return self._straight[candidate]

    # -- order --------------------------------------------------------------------------------------------------

    def _in_order(self, chosen: Sequence[Candidate], start: Posture) -> list[Candidate]:
        """By the seconds that straight moves from one to the next take."""
        a, p = self._model.active, self._model.passive
        active = np.array([candidate.active for candidate in chosen])
        begin, end = (np.array([candidate.passive[i] for candidate in chosen]) for i in (0, -1))

        def seconds(arm: ArmModel, here: Array, there: Array) -> Array:
            return arm.move_time(here, arm.nearest_turn(there, here))

        first = seconds(a, np.array(start.active), active) + seconds(p, np.array(start.passive), begin)
        between = seconds(a, active[:, None], active) + seconds(p, end[:, None], begin)
        return [chosen[i] for i in shortest_order(first, between)]

    def _visit(self, ordered: Sequence[Candidate], start: Posture) -> list[_Stop]:
        """The candidates with the ways that lead there, up to one that no way leads to."""
        stops: list[_Stop] = []
        posture = start
        for candidate in ordered:
            turned = self._turned(candidate, posture)
            leads = posture, _begin(turned)
            if leads not in self._found:
                self._found[leads] = self._ways.find(*leads)
            way = self._found[leads]
            if way is None:
                self._way_missed(*leads)
                break
            stops.append(_Stop(turned, way, self._ways.travel(posture, way)))
            posture = _end(turned)
        return stops

    def _turned(self, candidate: Candidate, near: Posture) -> Candidate:
        """The same poses with joints turned by whole turns to where the way from ``near`` is shortest."""
        active, passive = self._model.active, self._model.passive
        turn = passive.nearest_turn(candidate.passive[0], np.array(near.passive)) - candidate.passive[0]
        inside = np.all(passive.within_limits(candidate.passive + turn), axis=0)
        return replace(
            candidate,
            active=active.nearest_turn(candidate.active, np.array(near.active)),
            passive=candidate.passive + np.where(inside, turn, 0.0),
        )

    def _way_missed(self, start: Posture, goal: Posture) -> None:
        self.refused[_NO_WAY] += 1
        if self.refused[_NO_WAY] > _WAYS_MISSED:
            raise NoPlan(
                f"no plan: {self.refused[_NO_WAY]} constraints that no clear way leads to, the last one because "
                f"{self._ways.blocked_by(start, goal)}"
            )

    # -- final check --------------------------------------------------------------------------------------------

    def _first_too_close(self, stops: Sequence[_Stop], start: Posture) -> int | None:
        """The number of the first stop that is not clear in the true shapes, at its positions or on the way there."""
        here = start
        # Who stands closer than told at first may leave.
        least = min(self._model.margin, self._exact_clearance(start))
        for number, stop in enumerate(stops):
            c = stop.candidate
            postures = [*self._closest(here, stop.way), *(Posture.of(c.active, q) for q in c.passive)]
            if min(map(self._exact_clearance, postures)) < least:
                self.refused["too close in the true shapes"] += 1
                return number
            here = _end(c)
        return None

    def _exact_clearance(self, posture: Posture) -> float:
        return self._model.exact.clearance(posture.active, posture.passive, self._belief.T_P_A)

    def _closest(self, start: Posture, way: Sequence[Leg]) -> Iterator[Posture]:
        """Of each leg the checked posture with the least clearance."""
        geometry, here = self._model.geometry, start
        for leg in way:
            moves_active = leg.arm == self._model.active.name
            own, other = (here.active, here.passive) if moves_active else (here.passive, here.active)
            body = geometry.active if moves_active else geometry.passive
            path = body.sampled([own, *leg.waypoints])
            standing = np.array([other])
            q_a, q_p = (path, standing) if moves_active else (standing, path)
            closest = path[int(np.argmin(geometry.clearance(q_a, q_p, self._belief.placement)))]
            yield Posture.of(closest, other) if moves_active else Posture.of(other, closest)
            here = Posture(leg.goal, other) if moves_active else Posture(other, leg.goal)

    # -- what comes of it ---------------------------------------------------------------------------------------

    def _known(self, captured: Sequence[PlannedConstraint]) -> Knowledge:
        return Knowledge.together(
            [
                Knowledge.of(
                    self._model.active.chain.forward(constraint.active),
                    self._belief,
                    np.array([position.distance for position in constraint.positions]),
                )
                for constraint in captured
            ]
        )

    def _planned(self, stop: _Stop, request: Request, number: int) -> PlannedConstraint:
        c, a, p = stop.candidate, self._model.active, self._model.passive
        positions = tuple(
            PlannedPosition(tuple(map(float, q)), float(d), float(t), float(least))
            for q, d, t, least in zip(c.passive, c.distance, c.tilt, c.clearance, strict=True)
        )
        along = float(np.sum(p.move_time(c.passive[:-1], c.passive[1:])))
        return PlannedConstraint(
            f"{request.use}/{request.first_number + number:02d}",
            request.use,
            tuple(map(float, c.active)),
            positions,
            min(float(a.manipulability(c.active)), float(np.min(p.manipulability(c.passive)))),
            min(float(a.joint_margin(c.active)), float(np.min(p.joint_margin(c.passive)))),
            stop.seconds + along + POINT_SECONDS * len(positions),
        )

    def _refusal(self, request: Request, pool: Sequence[Candidate]) -> str:
        few = len(pool) < request.constraints
        known = self._known(request.captured)

        def success(model: CellModel, belief: Belief) -> float:
            source = CandidateSource(model, belief, np.random.default_rng(0))
            drawn = source.draw(request.positions, _AXES_TRIED, _AXES_FOR_ADVICE)
            return len(drawn) if few else _spread_of_best(drawn, request.constraints, known)

        counts = "; ".join(f"{what}: {count}" for what, count in self.refused.most_common() if count)
        return (
            f"no plan: {len(pool)} candidates for {request.constraints} {request.use} constraints with "
            f"{request.positions} positions{'' if few else ', and no choice of them will do'}. Refused: {counts}. "
            f"{advice(self._model, self._belief, success)}"
        )


def _spread_of_best(drawn: Sequence[Candidate], count: int, known: Knowledge) -> float:
    """How near the best choice comes to being well spread; 1 where it is."""
    pool = [candidate.knowledge for candidate in drawn]
    chosen = most_informative(pool, count, known, well_spread=True)
    together = Knowledge.together([known, *(pool[i] for i in chosen)])
    return min(together.spread / LEAST_SPREAD, together.turn / LEAST_TURN) if len(chosen) == count else 0.0


def _begin(candidate: Candidate) -> Posture:
    return Posture.of(candidate.active, candidate.passive[0])


def _end(candidate: Candidate) -> Posture:
    return Posture.of(candidate.active, candidate.passive[-1])
