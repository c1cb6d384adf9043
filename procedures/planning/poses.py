"""Selection of poses: of many candidates those that tell most, in an order that can be visited quickly."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dualcal_hal.errors import NoPlan
from dualcal_hal.session.captures import Use
from dualcal_hal.transforms import Array
from procedures.planning.advice import advice, counted
from procedures.planning.belief import Belief
from procedures.planning.candidates import Candidate, CandidateSource
from procedures.planning.choice import LEAST_SPREAD, LEAST_TURN, Knowledge, most_informative, spread_of
from procedures.planning.model import ArmModel, CellModel, Posture
from procedures.planning.order import shortest_order
from procedures.planning.plan import Plan, PlannedConstraint, PlannedPosition
from procedures.planning.ways import Leg, WayFinder

POINT_SECONDS = 0.1
"""What pictures, corrections and settling take at a position besides the way there, as simulated runs have it."""

_POOLS = (5, 10, 20)  # candidates drawn for each constraint of a use; more where fewer do not do
_LEAST_WHOLE = 6  # a pool that is to spread well is large enough for so many, however few are wanted
_AXES_TRIED = 2000
_AXES_FOR_ADVICE = 200
_WAYS_MISSED = 16
"""Constraints of a request that no way leads to, after which the start or the cell is to blame and no longer they."""

_WAYS_FOR_ADVICE = 12

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

    @property
    def end(self) -> Posture:
        """Where the arms are after its last position."""
        return _end(self.candidate)


class PosePlanner:
    """Draws and chooses poses for one belief; the same seed gives the same poses."""

    def __init__(self, model: CellModel, belief: Belief, ways: WayFinder, seed: Sequence[int]) -> None:
        self._model = model
        self._belief = belief
        self._ways = ways
        self._source = CandidateSource(model, belief, np.random.default_rng(list(seed)))
        self.refused = self._source.refused
        self._ways_missed = 0
        self._truly_clear: dict[Candidate, bool] = {}
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
            posture = stops[-1].end
            planned += [self._planned(stop, request, number) for number, stop in enumerate(stops)]
            if request.use == "calibration":
                spread = Knowledge.together([known, *(stop.candidate.knowledge for stop in stops)]).spread
        return Plan(tuple(planned), spread, dict(self.refused), provisional, self._belief.source)

    def require_candidates(self, request: Request) -> None:
        """Raises NoPlan where not one constraint of a request is possible, as :meth:`plan` would."""
        if not self._source.draw(request.positions, 1, _AXES_TRIED):
            raise NoPlan(self._refusal(request, []))

    def _select(self, request: Request, known: Knowledge, start: Posture) -> list[_Stop]:
        """From a pool that grows until it holds a choice that keeps all conditions."""
        pool: list[Candidate] = []
        self._ways_missed = 0
        drawn, whole = 0, request.constraints + len(request.captured)
        if request.use == "calibration":
            whole = max(_LEAST_WHOLE, whole)
        for share in _POOLS:
            new = self._source.draw(request.positions, share * whole - drawn, _AXES_TRIED)
            drawn += len(new)
            pool += new
            # What is captured already may leave no way to a good spread; the run goes on with the best there is.
            insist = share < _POOLS[-1] or not request.captured
            stops = self._visitable(pool, request, known, start, insist=insist)
            if stops:
                return stops
            if not drawn:
                break
        raise NoPlan(self._refusal(request, pool))

    def _visitable(
        self, pool: list[Candidate], request: Request, known: Knowledge, start: Posture, *, insist: bool
    ) -> list[_Stop] | None:
        """The best choice from the pool in its order of visit; candidates that cannot be visited leave the pool."""
        while len(pool) >= request.constraints:
            chosen = self._choice(pool, request, known, insist=insist)
            if chosen is None:
                return None
            # What costs most to judge is judged only of candidates that would be chosen.
            lost = self._unfit(chosen)
            if not lost:
                ordered = self._in_order(chosen, start)
                stops = self._visit(ordered, start)
                if len(stops) == len(ordered):
                    return stops
                lost = [ordered[len(stops)]]
                self._way_missed(request, stops[-1].end if stops else start, lost[0])
            pool[:] = [candidate for candidate in pool if candidate not in lost]
        return None

    def _choice(
        self, pool: Sequence[Candidate], request: Request, known: Knowledge, *, insist: bool
    ) -> list[Candidate] | None:
        """The best of the pool; None if its axes do not spread, if that is insisted on, or its flanges do not turn."""
        calibrates = request.use == "calibration"
        knowledge = [candidate.knowledge for candidate in pool]
        numbers = most_informative(knowledge, request.constraints, known, well_spread=calibrates)
        together = Knowledge.together([known, *(knowledge[i] for i in numbers)])
        narrow, unturned = together.spread < LEAST_SPREAD, together.turn < LEAST_TURN
        if calibrates:
            self.refused["the axes of the best choice do not spread"] += narrow
            self.refused["the flange is not turned by 30 degrees about two axes"] += unturned
            if unturned or (narrow and insist):
                return None
        return [pool[i] for i in numbers]

    def _unfit(self, chosen: Sequence[Candidate]) -> list[Candidate]:
        """Those that are not clear in the true shapes, or whose positions the passive arm cannot go to straight."""
        close = [candidate for candidate in chosen if not self._is_truly_clear(candidate)]
        bent = [candidate for candidate in chosen if candidate not in close and not self._is_straight(candidate)]
        self.refused["too close in the true shapes"] += len(close)
        self.refused["the way between two positions is not clear"] += len(bent)
        return [*close, *bent]

    def _is_truly_clear(self, candidate: Candidate) -> bool:
        if candidate not in self._truly_clear:
            postures = (Posture.of(candidate.active, q) for q in candidate.passive)
            self._truly_clear[candidate] = all(map(self._ways.is_clear_in_true_shapes, postures))
        return self._truly_clear[candidate]

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
            drawn = _drawn_for_advice(model, belief, request)
            return len(drawn) if few else _spread_of_best(drawn, request.constraints, known)

        return (
            f"no plan: {len(pool)} candidates for {request.constraints} {request.use} constraints with "
            f"{request.positions} positions{'' if few else ', and no choice of them will do'}. "
            f"{counted(self.refused)}. {advice(self._model, self._belief, success)}"
        )

    def _way_missed(self, request: Request, here: Posture, last: Candidate) -> None:
        self._ways_missed += 1
        self.refused[_NO_WAY] += 1
        if self._ways_missed <= _WAYS_MISSED:
            return

        def success(model: CellModel, belief: Belief) -> float:
            """Candidates that both arms can go to straight from where they are."""
            ways = WayFinder(model, belief, [])
            drawn = _drawn_for_advice(model, belief, request)[:_WAYS_FOR_ADVICE]
            return sum(not ways.blocked_by(here, _begin(candidate)) for candidate in drawn)

        raise NoPlan(
            f"no plan: {self._ways_missed} {request.use} constraints that no clear way leads to, the last one because "
            f"{self._ways.blocked_by(here, _begin(self._turned(last, here)))}. {counted(self.refused)}. "
            f"{advice(self._model, self._belief, success)}"
        )


def judged_anew(plan: Plan, model: CellModel, belief: Belief) -> Plan:
    """The same poses with the clearances and the spread of the axes that they have by another belief."""
    constraints = tuple(_cleared_anew(constraint, model, belief) for constraint in plan.constraints)
    active = [constraint.active for constraint in plan.of("calibration")]
    spread = spread_of(model.camera_in_passive(active, belief)[:, :3, 2]) if active else None
    return replace(plan, constraints=constraints, axis_spread=spread, planned_from=belief.source)


def _cleared_anew(constraint: PlannedConstraint, model: CellModel, belief: Belief) -> PlannedConstraint:
    passive = [position.passive for position in constraint.positions]
    clearance = model.geometry.clearance([constraint.active], passive, belief.placement)
    positions = (
        replace(position, clearance=float(least))
        for position, least in zip(constraint.positions, clearance, strict=True)
    )
    return replace(constraint, positions=tuple(positions))


def _drawn_for_advice(model: CellModel, belief: Belief, request: Request) -> list[Candidate]:
    source = CandidateSource(model, belief, np.random.default_rng(0))
    return source.draw(request.positions, _AXES_TRIED, _AXES_FOR_ADVICE)


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
