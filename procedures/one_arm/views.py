"""Selection of views: the arm so that the camera sees the target from many sides, its flange turned about many axes."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dualcal_hal.errors import NoPlan
from dualcal_hal.geometry import BETWEEN_SAMPLES
from dualcal_hal.kinematics import random_joints
from dualcal_hal.robot import Joints
from dualcal_hal.session.captures import Use
from dualcal_hal.transforms import Array, Mask, rotation_angle, rotation_from_vector, transform
from procedures.one_arm.known import Known, turns
from procedures.planning.advice import counted
from procedures.planning.choice import LEAST_TURN, turned_about_two_axes
from procedures.planning.order import shortest_order
from procedures.planning.plan import Plan, PlannedConstraint, PlannedPosition
from procedures.planning.sight import in_sight
from procedures.planning.ways import WayFinder

VIEW_SECONDS = 0.1
"""What a picture and settling take besides the way there."""

_BATCH = 300  # poses tried at once
_BATCHES = 12  # before no more are looked for
_STARTS, _ITERATIONS = 3, 15  # of the inverse kinematics, for each pose
_POOL = 4  # candidates for each view
_ACROSS = 0.8  # of half the image, within which the feature point is
_LEVER = 0.5  # m; flanges so far apart count as much as flanges turned by a radian
_WAYS_MISSED = 16

_UNREACHED = "the arm does not reach the pose"
_UNSEEN = "the target may not be wholly in view"
_CLOSE = "too close to what stands, to the floor, to a fixture or to itself"
_HIDDEN = "the arm or a fixture hides the target"
_TRULY_CLOSE = "too close in the true shapes"
_NO_WAY = "no clear way to the view"


@dataclass(frozen=True, eq=False)
class Request:
    """How many views of a use; names count from ``first_number``. Those ``taken`` are to be completed."""

    use: Use
    views: int
    phase: str
    first_number: int = 0
    taken: tuple[Joints, ...] = ()


@dataclass(frozen=True, eq=False)
class _Candidates:
    """joints (k, n) rad; T_E_T (k, 4, 4); clearance (k,) m; sure (k,): the share of errors within which all is seen."""

    joints: Array
    T_E_T: Array
    clearance: Array
    sure: Array

    def __len__(self) -> int:
        return len(self.joints)

    def only(self, chosen: Mask | Sequence[int]) -> _Candidates:
        return _Candidates(*(values[chosen] for values in (self.joints, self.T_E_T, self.clearance, self.sure)))

    def and_(self, other: _Candidates) -> _Candidates:
        pairs = zip(vars(self).values(), vars(other).values(), strict=True)
        return _Candidates(*(np.concatenate(pair) for pair in pairs))


class ViewPlanner:
    """Draws and chooses views by what is known; the same seed gives the same views."""

    def __init__(self, known: Known, ways: WayFinder, seed: Sequence[int]) -> None:
        self._known, self._ways = known, ways
        self._rng = np.random.default_rng(list(seed))
        self.refused: Counter[str] = Counter()
        self._missed = 0

    def plan(self, requests: Sequence[Request], start: Joints, *, provisional: bool = False) -> Plan:
        """Views for all requests, each with a clear way from the one before. NoPlan, with the reasons counted."""
        planned: list[PlannedConstraint] = []
        for request in requests:
            views = self._select(request, start)
            planned += views
            start = self._joints(views[-1])
        return Plan(tuple(planned), None, dict(self.refused), provisional, self._known.source)

    def _select(self, request: Request, start: Joints) -> list[PlannedConstraint]:
        pool = self._draw(_POOL * request.views)
        while len(pool) >= request.views:
            chosen = self._spread(pool, request)
            ordered = self._in_order(pool.only(chosen), start)
            visited, seconds = self._visit(ordered, start)
            if len(visited) == len(ordered):
                return self._planned(request, ordered, visited, seconds)
            lost = ordered.joints[len(visited)]
            pool = pool.only(~np.all(np.isclose(_turned(pool.joints, lost), lost), axis=1))
        raise NoPlan(
            f"no plan: {len(pool)} postures for {request.views} {request.use} views. {counted(self.refused)}. "
            "Check camera and target in the nominal transforms; what may help: a wider procedure.distance_mm, a larger "
            "procedure.tilt_max_deg, smaller nominal.uncertainty, or another place for what stands"
        )

    # -- candidates ---------------------------------------------------------------------------------------------

    def _draw(self, wanted: int) -> _Candidates:
        """So many, if they can be found; with looks still to come also some that are not sure to show all."""
        found = self._batch()
        for _ in range(_BATCHES - 1):
            if np.sum(found.sure == 1.0) >= wanted:
                break
            found = found.and_(self._batch())
        sure = found.only(found.sure == 1.0)
        if not self._known.looked and len(sure) < wanted:
            best = np.argsort(-found.sure, kind="stable")[:wanted]
            return found.only(best[found.sure[best] > 0.5].tolist())
        self.refused[_UNSEEN] += len(found) - len(sure)
        return sure

    def _batch(self) -> _Candidates:
        known, model = self._known, self._known.model
        T_E_T = self._poses()
        seen = model.in_view(T_E_T)
        self.refused[_UNSEEN] += int(np.sum(~seen))
        T_E_T = T_E_T[seen]
        joints, reached = self._reach(T_E_T)
        self.refused[_UNREACHED] += int(np.sum(~reached))
        joints, T_E_T = joints[reached], T_E_T[reached]
        active, passive = known.both(joints)
        clearance = model.geometry.clearance(active, passive, known.belief.placement) if len(joints) else np.zeros(0)
        clear = clearance >= model.margin + BETWEEN_SAMPLES
        self.refused[_CLOSE] += int(np.sum(~clear))
        joints, T_E_T, clearance = joints[clear], T_E_T[clear], clearance[clear]
        free = in_sight(model, active[clear], passive[clear], known.belief)
        self.refused[_HIDDEN] += int(np.sum(~free))
        found = _Candidates(joints, T_E_T, clearance, np.ones(len(joints))).only(free)
        if not len(found):
            return found
        true = np.array([self._ways.is_clear_in_true_shapes(known.posture(q)) for q in found.joints])
        self.refused[_TRULY_CLOSE] += int(np.sum(~true))
        found = found.only(true)
        possible = known.possible(found.T_E_T)
        sure = np.array([model.in_view(T) for T in possible]).mean(axis=0)
        return replace(found, sure=sure)

    def _poses(self) -> Array:
        """(k, 4, 4): the target in the camera, at any distance, tilt and roll allowed, and off the optical axis."""
        rng, model = self._rng, self._known.model
        (width, height), K = model.intrinsics.size, model.intrinsics.matrix
        half = np.array([width, height]) / 2
        pixels = half + _ACROSS * half * rng.uniform(-1.0, 1.0, (_BATCH, 2))
        sight = np.column_stack([(pixels - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones(_BATCH)])
        sight /= np.linalg.norm(sight, axis=1, keepdims=True)
        distance = rng.uniform(*model.distance, (_BATCH, 1))
        # Tilted about an axis across the line of sight: evenly over the cap.
        tilt = np.arccos(rng.uniform(np.cos(model.tilt_max), 1.0, (_BATCH, 1)))
        azimuth, roll = rng.uniform(-np.pi, np.pi, (2, _BATCH, 1))
        across = np.hstack([np.cos(azimuth), np.sin(azimuth), np.zeros((_BATCH, 1))])
        straight = rotation_from_vector(_turn_onto(sight))
        facing = np.diag([1.0, -1.0, -1.0])
        z = np.hstack([np.zeros((_BATCH, 2)), roll])
        R = straight @ rotation_from_vector(tilt * across) @ facing @ rotation_from_vector(z)
        return transform(R, distance * sight)

    def _reach(self, T_E_T: Array) -> tuple[Array, Mask]:
        """Joint angles (k, n), and which of them bring the flange there: from home, else from somewhere at random."""
        arm = self._known.arm
        goals = self._known.flange(T_E_T)
        joints, reached = np.tile(arm.home, (len(goals), 1)), np.zeros(len(goals), dtype=bool)
        longest = sum(float(np.hypot(row.a, row.d)) for row in arm.chain.rows)
        within = np.linalg.norm(goals[:, :3, 3], axis=1) <= longest
        for number in range(_STARTS):
            left = np.flatnonzero(within & ~reached)
            starts = random_joints(self._rng, len(left), arm.lower, arm.upper) if number else joints[left]
            if not len(left):
                break
            q, found = arm.chain.inverse(goals[left], starts, arm.lower, arm.upper, iterations=_ITERATIONS)
            reached[left] = found
            joints[left[found]] = arm.nearest_turn(q[found], arm.home)
        return joints, reached

    # -- choice -------------------------------------------------------------------------------------------------

    def _spread(self, pool: _Candidates, request: Request) -> list[int]:
        """The farthest from those chosen before, one after the other, by where flanges are and how they are turned."""
        chain = self._known.arm.chain
        flanges = chain.forward(pool.joints)
        nearest = np.full(len(pool), np.inf)
        for q in request.taken:
            nearest = np.minimum(nearest, _apart(flanges, chain.forward(np.array(q))))
        chosen: list[int] = []
        if not request.taken:
            chosen.append(0)
            nearest = _apart(flanges, flanges[0])
        while len(chosen) < request.views:
            nearest[chosen] = -np.inf
            chosen.append(int(np.argmax(nearest)))
            nearest = np.minimum(nearest, _apart(flanges, flanges[chosen[-1]]))
        joints = [*request.taken, *map(tuple, pool.joints[chosen].tolist())]
        turn = turned_about_two_axes(turns(self._known, joints))
        if request.use == "calibration" and turn < LEAST_TURN:
            raise NoPlan(
                f"no plan: the flange is turned by no more than {np.rad2deg(turn):.0f} deg about a second axis by any "
                f"{request.views} of {len(pool)} postures, and {np.rad2deg(LEAST_TURN):.0f} deg are needed. "
                f"{counted(self.refused)}. A larger procedure.tilt_max_deg may help, or a smaller nominal.uncertainty"
            )
        return chosen

    def _in_order(self, chosen: _Candidates, start: Joints) -> _Candidates:
        """By the seconds that straight moves from one to the next take; joints turned to where they are nearest."""
        arm, joints = self._known.arm, chosen.joints
        first = arm.move_time(np.array(start), arm.nearest_turn(joints, np.array(start)))
        between = arm.move_time(joints[:, None], arm.nearest_turn(joints[None], joints[:, None]))
        ordered = chosen.only(shortest_order(first, between))
        near = np.array(start)
        for q in ordered.joints:
            q[:] = near = arm.nearest_turn(q, near)
        return ordered

    def _visit(self, ordered: _Candidates, start: Joints) -> tuple[list[Joints], list[float]]:
        """The views, and seconds to each, up to one that no way leads to."""
        here, visited, seconds = self._known.posture(start), [], []
        for q in ordered.joints:
            there = self._known.posture(q)
            way = self._ways.find(here, there)
            if way is None:
                self._miss(self._ways.blocked_by(here, there))
                break
            visited.append(self._known.joints(there))
            seconds.append(self._ways.travel(here, way))
            here = there
        return visited, seconds

    def _miss(self, why: str) -> None:
        self._missed += 1
        self.refused[_NO_WAY] += 1
        if self._missed > _WAYS_MISSED:
            raise NoPlan(f"no plan: no clear way leads to {self._missed} views, the last one because {why}")

    def _planned(
        self, request: Request, ordered: _Candidates, visited: Sequence[Joints], seconds: Sequence[float]
    ) -> list[PlannedConstraint]:
        known, arm = self._known, self._known.arm
        planned = []
        for i, (q, T, clearance) in enumerate(zip(visited, ordered.T_E_T, ordered.clearance, strict=True)):
            posture = known.posture(q)
            distance = float(np.linalg.norm(T[:3, 3]))
            tilt = float(np.arccos(np.clip(-T[:3, 2] @ T[:3, 3] / distance, -1.0, 1.0)))
            planned.append(
                PlannedConstraint(
                    f"{request.phase}/{request.first_number + i:02d}",
                    request.use,
                    posture.active,
                    (PlannedPosition(posture.passive, distance, tilt, float(clearance)),),
                    float(arm.manipulability(np.array(q))),
                    float(arm.joint_margin(np.array(q))),
                    seconds[i] + VIEW_SECONDS,
                )
            )
        return planned

    def _joints(self, view: PlannedConstraint) -> Joints:
        return view.active or view.positions[0].passive


def _turned(q: Array, reference: Array) -> Array:
    """Angles (k, n) in the turn nearest to (n,)."""
    return np.asarray(q - 2 * np.pi * np.round((q - reference) / (2 * np.pi)))


def _turn_onto(sight: Array) -> Array:
    """(k, 3) rotation vectors that bring the optical axis onto directions (k, 3)."""
    axis = np.column_stack([-sight[:, 1], sight[:, 0], np.zeros(len(sight))])
    sine = np.linalg.norm(axis, axis=1, keepdims=True)
    angle = np.arctan2(sine, sight[:, 2:])
    return np.asarray(axis / np.maximum(sine, 1e-12) * angle)


def _apart(flanges: Array, other: Array) -> Array:
    """(k,) of flanges (k, 4, 4) from one (4, 4)."""
    turned = rotation_angle(flanges[:, :3, :3], other[:3, :3])
    return np.asarray(np.hypot(turned, np.linalg.norm(flanges[:, :3, 3] - other[:3, 3], axis=1) / _LEVER))
