"""One arm alone: a camera on it before a target that stays, or a camera that stays before a target on it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualcal_hal.cellfile import load_cell
from dualcal_hal.kinematics import Chain
from dualcal_hal.target import Checkerboard
from dualcal_hal.transforms import Array, apply, inverse, rotation_from_vector, transform
from procedures.estimation import Degenerate
from procedures.estimation.projection import project
from procedures.estimation.refined import intrinsics
from procedures.estimation.refined.arms import Inverted, MeasuredFlange
from procedures.estimation.refined.as_read import fit_as_read
from procedures.estimation.refined.breakdown import break_down
from procedures.estimation.refined.hidden import hidden_of_one_arm
from procedures.estimation.refined.inexact import Known
from procedures.estimation.refined.left_out import leave_one_out
from procedures.estimation.refined.motion import in_flange, logarithm, moved
from procedures.estimation.refined.one_arm import FlangePoses, JointReadings, OneArm, Placement, Views, one_arm
from tests.cells import PAPER

BOARD = Checkerboard(5, 4, 0.025, 9)
MATRIX = np.array([[812.0, 0.0, 511.5], [0.0, 812.0, 383.5], [0.0, 0.0, 1.0]])
DISTORTION = np.array([-0.1, 0.05, 1e-3, -5e-4, 0.0])
PIXEL, TRANSLATION, ROTATION, JOINT = 0.1, 3e-4, 4e-4, 2e-4
CHAIN: Chain = load_cell(PAPER).cell.active.chain
FREE = [intrinsics(np.inf, np.inf, [np.inf, np.inf, np.inf, np.inf, 0.0])]

both_placements = pytest.mark.parametrize("placement", list(Placement))


@dataclass(frozen=True)
class World:
    """Camera and target where they are; T_camera_target (k, 4, 4) of the views; joints (k, 6) or none."""

    placement: Placement
    camera: Array
    target: Array
    seen: Array
    joints: Array | None = None

    @property
    def flange(self) -> Array:
        if self.placement is Placement.FIXED:
            return np.asarray(self.camera @ self.seen @ inverse(self.target))
        return np.asarray(self.target @ inverse(self.seen) @ inverse(self.camera))

    def views(self, rng: np.random.Generator | None = None, board: Array = BOARD.corners) -> Views:
        """As they would be measured, with noise if there is a generator."""
        pixels = project(apply(self.seen, board), MATRIX, DISTORTION)
        joints, flange = self.joints, self.flange
        if rng is not None:
            pixels = pixels + rng.normal(0, PIXEL, pixels.shape)
            sigmas = np.repeat([TRANSLATION, ROTATION], 3)
            # The pose is off from what is read, so what is read is off from the pose the other way.
            flange = moved(flange, -rng.normal(0, 1, (len(flange), 6)) * sigmas)
            joints = None if joints is None else joints + rng.normal(0, JOINT, joints.shape)
        arm = FlangePoses(flange, TRANSLATION, ROTATION) if joints is None else JointReadings(CHAIN, joints, JOINT)
        return Views(arm, pixels, BOARD.corners, MATRIX, DISTORTION)

    def error(self, result: OneArm) -> Array:
        """(12,): what covariances are of."""
        return np.concatenate([logarithm(result.camera, self.camera), logarithm(result.target, self.target)])


FACING = np.diag([1.0, -1.0, -1.0])


def random_pose(rng: np.random.Generator, reach: float) -> Array:
    return transform(rotation_from_vector(rng.normal(0, 1, 3)), rng.normal(0, reach, 3))


def random_world(rng: np.random.Generator, placement: Placement, count: int = 12) -> World:
    """Boards turned by up to some 40 deg in every direction, 0.3 to 0.6 m away."""
    turns = rotation_from_vector(rng.uniform(-0.5, 0.5, (count, 3))) @ FACING
    places = rng.uniform([-0.08, -0.06, 0.3], [0.08, 0.06, 0.6], (count, 3))
    reach = (0.6, 0.1) if placement is Placement.FIXED else (0.1, 0.6)
    return World(placement, random_pose(rng, reach[0]), random_pose(rng, reach[1]), transform(turns, places))


def jointed_world(rng: np.random.Generator, placement: Placement, count: int = 12, *, chain: Chain = CHAIN) -> World:
    """The same with an arm of known joints, which move by up to 0.25 rad."""
    joints = np.array([0.2, -0.9, 1.1, 0.3, 0.7, -0.4]) + rng.uniform(-0.25, 0.25, (count, 6))
    flange = chain.forward(joints)
    on_flange, apart = random_pose(rng, 0.05), transform(FACING, [0.0, 0.0, 0.45])
    there = chain.forward(joints.mean(axis=0)) @ on_flange
    if placement is Placement.ON_ARM:
        world = World(placement, on_flange, there @ apart, np.empty(0), joints)
        return replace(world, seen=inverse(flange @ world.camera) @ world.target)
    world = World(placement, there @ inverse(apart), on_flange, np.empty(0), joints)
    return replace(world, seen=inverse(world.camera) @ flange @ world.target)


def normalised(errors_and_results: list[tuple[Array, OneArm]]) -> float:
    return float(np.mean([e @ np.linalg.solve(result.covariance, e) for e, result in errors_and_results]))


class TestArms:
    @settings(max_examples=10, deadline=None)
    @given(numbers=st.lists(st.floats(-1.5, 1.5), min_size=6, max_size=6))
    def test_an_inverted_arm_moves_as_the_flange_sees_the_base_move(self, numbers: list[float]) -> None:
        arm, q = Inverted(CHAIN), np.array(numbers)
        expected = in_flange(arm.jacobian(q), arm.forward(q))
        for i, step in enumerate(1e-6 * np.eye(6)):
            np.testing.assert_allclose(
                logarithm(arm.forward(q), arm.forward(q + step)) / 1e-6, expected[:, i], atol=1e-5
            )

    @settings(max_examples=10, deadline=None)
    @given(numbers=st.lists(st.floats(-1.5, 1.5), min_size=6, max_size=6))
    def test_a_measured_flange_is_off_along_and_about_its_own_axes(self, numbers: list[float]) -> None:
        arm, q = MeasuredFlange(0.7), np.array(numbers)
        expected = np.diag([0.7, 0.7, 0.7, 1.0, 1.0, 1.0])
        np.testing.assert_allclose(in_flange(arm.jacobian(q), arm.forward(q)), expected, atol=1e-12)
        np.testing.assert_allclose(arm.readings(arm.forward(q)[None])[0], q, atol=1e-12)


@both_placements
class TestEstimate:
    def test_exact_views_give_exact_transforms_by_their_names(self, placement: Placement) -> None:
        world = random_world(np.random.default_rng(0), placement)
        result = one_arm(world.views(), placement, PIXEL)
        np.testing.assert_allclose(world.error(result), 0, atol=1e-7)
        assert result.used.all()
        assert result.warnings == ()
        names = list(result.transforms)
        if placement is Placement.ON_ARM:
            assert names == ["camera_in_flange", "target_in_base"]
        else:
            assert names == ["camera_in_base", "target_in_flange"]
        np.testing.assert_array_equal(result.transforms[names[1]], result.target)
        assert result.rms < 1e-5

    def test_so_do_exact_joints(self, placement: Placement) -> None:
        world = jointed_world(np.random.default_rng(0), placement)
        np.testing.assert_allclose(world.error(one_arm(world.views(), placement, PIXEL)), 0, atol=1e-7)

    @pytest.mark.parametrize("world_of", [random_world, jointed_world])
    @pytest.mark.parametrize("runs", [15, pytest.param(300, marks=pytest.mark.slow)])
    def test_errors_are_as_large_as_the_covariance_says(self, placement: Placement, world_of, runs: int) -> None:
        """The mean of n chi-squares of f has a sigma of sqrt(2 f / n)."""
        rng = np.random.default_rng(1)
        found = []
        for _ in range(runs):
            world = world_of(rng, placement)
            result = one_arm(world.views(rng), placement, PIXEL)
            found.append((world.error(result), result))
        assert normalised(found) == pytest.approx(12, abs=3 * np.sqrt(24 / runs))
        for part in (slice(0, 6), slice(6, 12)):
            squares = [e[part] @ np.linalg.solve(r.covariance[part, part], e[part]) for e, r in found]
            assert np.mean(squares) == pytest.approx(6, abs=3.5 * np.sqrt(12 / runs))

    def test_corners_that_were_not_seen_do_not_matter(self, placement: Placement) -> None:
        world = random_world(np.random.default_rng(2), placement)
        views = world.views()
        views.pixels[3, 5:] = np.nan
        views.pixels[7] = np.nan
        result = one_arm(views, placement, PIXEL)
        np.testing.assert_allclose(world.error(result), 0, atol=1e-7)
        assert [(drop.capture, drop.reason) for drop in result.dropped] == [(7, "no corner was seen")]

    def test_a_view_with_the_pose_of_another_is_dropped_and_named(self, placement: Placement) -> None:
        rng = np.random.default_rng(3)
        world = random_world(rng, placement)
        views = world.views(rng)
        assert isinstance(views.arm, FlangePoses)
        views.arm.flange[4] = views.arm.flange[9]
        result = one_arm(views, placement, PIXEL)
        assert [drop.capture for drop in result.dropped] == [4]
        assert "from where the other views put it" in result.dropped[0].reason
        assert world.error(result) @ np.linalg.solve(result.covariance, world.error(result)) < 40
        assert not one_arm(views, placement, PIXEL, keep_all=True).dropped

    def test_boards_read_from_the_other_end_are_turned(self, placement: Placement) -> None:
        rng = np.random.default_rng(4)
        world = random_world(rng, placement)
        views = world.views(rng)
        turned = np.arange(len(views)) % 3 == 1
        pixels = np.where(turned[:, None, None], views.pixels[:, ::-1], views.pixels)
        known = np.arange(len(views)) == 0
        result = one_arm(replace(views, pixels=pixels, order_known=known), placement, PIXEL)
        np.testing.assert_array_equal(result.flipped, turned)
        assert world.error(result) @ np.linalg.solve(result.covariance, world.error(result)) < 40

    def test_noise_is_found(self, placement: Placement) -> None:
        rng = np.random.default_rng(5)
        views = random_world(rng, placement, 40).views(rng)
        assumed = replace(views, arm=FlangePoses(views.arm.flange, 10 * TRANSLATION, 10 * ROTATION))
        result = one_arm(assumed, placement, 1.0, estimate_noise=True)
        assert result.pixel_sigma == pytest.approx(PIXEL, rel=0.15)
        assert result.arm_sigma == pytest.approx(ROTATION, rel=0.35)
        assert result.scale == 1

    def test_the_lens_is_found_too(self, placement: Placement) -> None:
        rng = np.random.default_rng(6)
        world = random_world(rng, placement, 20)
        views = replace(world.views(rng), matrix=MATRIX + np.diag([5.0, -4.0, 0.0]), distortion=np.zeros(5))
        result = one_arm(views, placement, PIXEL, inexact=FREE)
        error = world.error(result)
        assert error @ np.linalg.solve(result.covariance, error) < 40
        truth = np.concatenate([MATRIX[[0, 1, 0, 1], [0, 1, 2, 2]], DISTORTION[:4]])
        found = np.concatenate([result.matrix[[0, 1, 0, 1], [0, 1, 2, 2]], result.distortion[:4]])
        assert np.all(np.abs(found - truth) < 4 * np.array([known.sigma for known in result.known]))

    def test_contributions_add_up(self, placement: Placement) -> None:
        rng = np.random.default_rng(7)
        result = one_arm(random_world(rng, placement).views(rng), placement, PIXEL)
        assert set(result.contributions) == {"pixels", "arm"}
        np.testing.assert_allclose(sum(result.contributions.values()), result.covariance, rtol=1e-6, atol=1e-14)


class TestRefusals:
    @both_placements
    def test_two_views(self, placement: Placement) -> None:
        with pytest.raises(Degenerate, match="2 views with at least 4 corners seen, at least 3 are needed"):
            one_arm(random_world(np.random.default_rng(0), placement, 2).views(), placement, PIXEL)

    @both_placements
    def test_a_flange_that_was_only_shifted(self, placement: Placement) -> None:
        world = random_world(np.random.default_rng(0), placement)
        seen = world.seen.copy()
        seen[:, :3, :3] = seen[0, :3, :3]
        with pytest.raises(Degenerate, match=r"^the flange .* only shifted"):
            one_arm(replace(world, seen=seen).views(), placement, PIXEL)

    @both_placements
    def test_a_flange_that_was_turned_about_one_axis(self, placement: Placement) -> None:
        rng = np.random.default_rng(0)
        world = random_world(rng, placement)
        turns = rotation_from_vector(np.outer(rng.uniform(-0.6, 0.6, 12), [0.3, 0.8, 0.5]))
        seen = world.seen.copy()
        seen[:, :3, :3] = turns @ FACING
        with pytest.raises(Degenerate, match=r"^the flange was turned about one axis only"):
            one_arm(replace(world, seen=seen).views(), placement, PIXEL)

    @both_placements
    def test_a_fan_with_little_about_a_second_axis_is_warned_of(self, placement: Placement) -> None:
        rng = np.random.default_rng(0)
        world = random_world(rng, placement)
        along, across = (
            np.outer(rng.uniform(-0.6, 0.6, 12), [0, 1, 0]),
            np.outer(rng.uniform(-0.09, 0.09, 12), [1, 0, 0]),
        )
        seen = world.seen.copy()
        seen[:, :3, :3] = rotation_from_vector(along) @ rotation_from_vector(across) @ FACING
        result = one_arm(replace(world, seen=seen).views(), placement, PIXEL)
        assert any(words.startswith("weak: the flange turns") and "views with" in words for words in result.warnings)

    def test_a_sigma_of_zero(self) -> None:
        with pytest.raises(ValueError, match="positive"):
            FlangePoses(np.eye(4)[None], 0.0, 1e-3)


@both_placements
class TestAsRead:
    @pytest.mark.parametrize("runs", [10, pytest.param(300, marks=pytest.mark.slow)])
    def test_its_errors_are_as_large_as_its_covariance_says(self, placement: Placement, runs: int) -> None:
        """Least squares is not the most likely fit here, but knows how far it is off."""
        rng = np.random.default_rng(8)
        found, likely = [], []
        for _ in range(runs):
            world = random_world(rng, placement)
            views = world.views(rng)
            result = one_arm(views, placement, PIXEL)
            fitted = fit_as_read(views, result)
            assert fitted.as_read
            assert fitted.rms <= result.rms + 1e-9
            found.append((world.error(fitted), fitted))
            likely.append(np.trace(result.covariance))
        assert normalised(found) == pytest.approx(12, abs=3 * np.sqrt(24 / runs))
        assert np.mean([np.trace(result.covariance) for _, result in found]) > np.mean(likely)

    @pytest.mark.parametrize("runs", [2, pytest.param(60, marks=pytest.mark.slow)])
    def test_so_they_are_with_the_lens_free(self, placement: Placement, runs: int) -> None:
        rng = np.random.default_rng(9)
        found = []
        for _ in range(runs):
            world = random_world(rng, placement)
            views = world.views(rng)
            fitted = fit_as_read(views, one_arm(views, placement, PIXEL, inexact=FREE), FREE)
            found.append((world.error(fitted), fitted))
        assert normalised(found) == pytest.approx(12, abs=3 * np.sqrt(24 / runs))


class TestLeftOut:
    def test_exact_views_predict_each_other(self) -> None:
        views = random_world(np.random.default_rng(0), Placement.FIXED).views()
        left_out = leave_one_out(views, one_arm(views, Placement.FIXED, PIXEL))
        np.testing.assert_allclose(left_out.pixels, 0, atol=1e-4)
        np.testing.assert_allclose(left_out.at_target, 0, atol=1e-7)

    @pytest.mark.parametrize("inexact", [(), FREE], ids=["lens given", "lens free"])
    def test_what_a_view_shows_does_not_move_its_own_prediction(self, inexact) -> None:
        rng = np.random.default_rng(1)
        views = random_world(rng, Placement.ON_ARM).views(rng)
        moved_one = views.pixels.copy()
        moved_one[2] += [0.4, -0.3]
        predicted = []
        for pixels in (views.pixels, moved_one):
            taken = replace(views, pixels=pixels)
            result = one_arm(taken, Placement.ON_ARM, PIXEL, inexact=inexact, keep_all=True)
            left_out = leave_one_out(taken, result, inexact)
            predicted.append(pixels + left_out.pixels)
        np.testing.assert_allclose(predicted[0][2], predicted[1][2], atol=2e-3)
        assert np.abs(predicted[0][3] - predicted[1][3]).max() > 2e-2

    def test_errors_at_the_target_are_those_in_the_image_at_its_distance(self) -> None:
        rng = np.random.default_rng(2)
        world = random_world(rng, Placement.FIXED)
        views = world.views(rng)
        left_out = leave_one_out(views, one_arm(views, Placement.FIXED, PIXEL))
        pixels, metres = left_out.rms()
        distance = np.linalg.norm(world.seen[:, :3, 3], axis=1)
        np.testing.assert_allclose(metres, np.sqrt(2) * pixels * distance / 812.0, rtol=0.15)

    def test_a_dropped_view_is_predicted_too_and_is_far_off(self) -> None:
        rng = np.random.default_rng(3)
        views = random_world(rng, Placement.FIXED).views(rng)
        views.arm.flange[4] = views.arm.flange[9]
        pixels, _ = leave_one_out(views, one_arm(views, Placement.FIXED, PIXEL)).rms()
        assert np.argmax(pixels) == 4
        assert pixels[4] > 20 * np.median(pixels)

    def test_of_many_views_several_are_left_out_at_a_time(self) -> None:
        rng = np.random.default_rng(4)
        views = random_world(rng, Placement.FIXED, 60).views(rng)
        pixels, _ = leave_one_out(views, one_arm(views, Placement.FIXED, PIXEL)).rms()
        assert np.all(np.isfinite(pixels))
        assert np.sqrt(np.mean(pixels**2)) < 1.5


class TestBreakdown:
    def test_it_tells_lens_arm_and_board_apart(self) -> None:
        rng = np.random.default_rng(5)
        world = random_world(rng, Placement.FIXED, 20)
        bent = BOARD.corners + rng.normal(0, 2e-4, BOARD.corners.shape)
        views = replace(world.views(rng, bent), distortion=np.zeros(5))
        result = one_arm(views, Placement.FIXED, PIXEL, estimate_noise=True, inexact=FREE)
        told = break_down(views, result)
        assert told.lens_free is not None
        assert told.poses_free is not None
        assert told.corners_free == pytest.approx(PIXEL, rel=0.1)
        assert told.given > 1.1 * told.lens_free > 1.2 * told.poses_free > 2 * PIXEL
        assert told.off_places is not None
        # Of what was drawn a rigid motion and a scale do not show, and across the board they show less well.
        assert told.off_places[0] == pytest.approx(2e-4 * np.sqrt(2), rel=0.35)

    def test_few_views_are_not_asked_too_much(self) -> None:
        rng = np.random.default_rng(6)
        views = random_world(rng, Placement.FIXED, 4).views(rng)
        views.pixels[:, 6:] = np.nan
        told = break_down(views, one_arm(views, Placement.FIXED, PIXEL))
        assert told.corners_free is None
        assert told.off_places is None


class TestPrediction:
    def test_of_a_point_it_is_that_of_drawn_errors(self) -> None:
        rng = np.random.default_rng(7)
        result = one_arm(random_world(rng, Placement.FIXED).views(rng), Placement.FIXED, PIXEL)
        point = np.array([0.1, -0.05, 0.5])
        drawn = rng.multivariate_normal(np.zeros(6), result.covariance_of("camera_in_base"), 4000)
        off = (moved(np.tile(result.camera, (4000, 1, 1)), drawn) @ np.append(point, 1))[:, :3]
        off -= (result.camera @ np.append(point, 1))[:3]
        predicted = result.spatial_error(point)
        assert predicted.rms == pytest.approx(np.sqrt(np.mean(np.sum(off**2, axis=1))), rel=0.04)
        assert predicted.p95 == pytest.approx(np.percentile(np.linalg.norm(off, axis=1), 95), rel=0.05)


HAYATI = Chain((replace(CHAIN.rows[0], d=0.0, beta=0.1), *CHAIN.rows[1:5], replace(CHAIN.rows[5], d=0.0, beta=-0.2)))
OFF = {
    "zero of joint 1": (0, "theta"),
    "d of row 1": (0, "d"),
    "zero of joint 6": (5, "theta"),
    "alpha of row 6": (5, "alpha"),
    "beta of row 6": (5, "beta"),
    "d of row 6": (5, "d"),
    "a of row 6": (5, "a"),
}


class TestHidden:
    """What fits all views as well, and puts camera or target elsewhere."""

    @both_placements
    @pytest.mark.parametrize("chain", [CHAIN, HAYATI], ids=["plain", "Hayati"])
    def test_an_arm_that_is_off_so_fits_as_well_and_puts_points_off_by_so_much(
        self, placement: Placement, chain: Chain
    ) -> None:
        world = jointed_world(np.random.default_rng(0), placement, chain=chain)
        on_arm = placement is Placement.ON_ARM
        carried, stands = ("camera", "target") if on_arm else ("target", "camera")
        in_flange = getattr(world, carried)[None, :3, 3]
        in_base = (world.target[None] if on_arm else chain.forward(world.joints) @ world.target)[:, :3, 3]
        *told, _ = hidden_of_one_arm(chain, in_base, in_flange)
        assert len(told) == (6 if chain is CHAIN else 5)
        for one in told:
            name, against = one.what.removeprefix("the ").split(" of the arm, against its ")
            number, number_of_row = OFF[name]
            rows = list(chain.rows)
            by = 1e-3 if number_of_row in ("d", "a") else np.radians(0.1)
            rows[number] = replace(rows[number], **{number_of_row: getattr(rows[number], number_of_row) + by})
            views = replace(world.views(), arm=JointReadings(Chain(tuple(rows)), world.joints, JOINT))
            result = one_arm(views, placement, PIXEL)
            assert result.rms < 1e-4
            what, points = (carried, in_flange) if against == "flange" else (stands, in_base)
            there = apply(getattr(result, what) @ inverse(getattr(world, what)), points)
            error = np.linalg.norm(there - points, axis=1).max()
            assert error == pytest.approx(one.error, rel=2e-3), one

    def test_a_stated_sigma_is_what_it_is_told_for(self) -> None:
        known = Known("zero of joint 1 of the arm", "rad", 0.0, 2e-3, 2e-3, False)
        points = np.array([[0.3, 0.4, 0.9]])
        assert hidden_of_one_arm(CHAIN, points, points, [known])[0].error == pytest.approx(1e-3)

    @both_placements
    def test_an_arm_and_a_target_that_are_too_large_alike_are_one_of_them(self, placement: Placement) -> None:
        world = jointed_world(np.random.default_rng(0), placement)
        rows = tuple(replace(row, d=1.001 * row.d, a=1.001 * row.a) for row in CHAIN.rows)
        views = replace(
            world.views(), arm=JointReadings(Chain(rows), world.joints, JOINT), corners=1.001 * BOARD.corners
        )
        result = one_arm(views, placement, PIXEL)
        assert result.rms < 1e-5
        np.testing.assert_allclose(result.camera[:3, 3], 1.001 * world.camera[:3, 3], atol=1e-9)
        np.testing.assert_allclose(result.target[:3, 3], 1.001 * world.target[:3, 3], atol=1e-9)
