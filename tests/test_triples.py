"""Pose triples of AXB = YCZ: closed form, maximum likelihood with its covariance, and the files they come from."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualcal_hal.errors import FormatError
from dualcal_hal.session import triples as files
from dualcal_hal.session.triples import read_triples
from dualcal_hal.transforms import (
    Array,
    inverse,
    quaternion_from_rotation,
    rotation_from_vector,
    transform,
    vector_from_rotation,
)
from procedures.estimation import Degenerate
from procedures.estimation.triples import Solution, TripleNoise, estimate_triples, solve_in_closed_form
from tools.benchmarks.triples import TRUTH, UR10, figures, noise, random_triples, with_errors

SMALL = TripleNoise.of_sigmas((1e-5, 1e-5), (1e-5, 1e-5), (1e-5, 1e-5))

Triples = tuple[Array, Array, Array]


def moved(rng: np.random.Generator, poses: Array, sigmas: tuple[float, float]) -> Array:
    """With Gaussian errors of the sigmas in m and rad, in the child frame."""
    errors = rng.normal(size=(2, len(poses), 3))
    return poses @ transform(rotation_from_vector(sigmas[1] * errors[1]), sigmas[0] * errors[0])


def motion(T: Array, goal: Array) -> Array:
    between = inverse(T) @ goal
    return np.concatenate([between[:3, 3], vector_from_rotation(between[:3, :3])])


def errors(found: Any, truth: Solution = TRUTH) -> Array:
    """(18,) of X, Y, Z."""
    return np.concatenate([motion(getattr(found, name), getattr(truth, name)) for name in "XYZ"])


def following(A: Array, C: Array) -> Triples:
    """With the B that belong to them."""
    return A, inverse(A @ TRUTH.X) @ TRUTH.Y @ C @ TRUTH.Z, C


def random_poses(rng: np.random.Generator, *shape: int) -> Array:
    q = rng.normal(size=(*shape, 3))
    return transform(rotation_from_vector(1.5 * q), rng.uniform(-1, 1, (*shape, 3)))


# The estimate


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(12, 40))
def test_exact_triples_are_solved_exactly_in_closed_form_whatever_the_frames(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    truth, A, C = Solution(*random_poses(rng, 3)), random_poses(rng, count), random_poses(rng, count)
    found = solve_in_closed_form(A, inverse(A @ truth.X) @ truth.Y @ C @ truth.Z, C)
    assert np.abs(errors(found, truth)).max() < 1e-6


@settings(max_examples=10, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(5, 12))
def test_exact_triples_are_solved_without_a_start_also_where_they_are_few(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    truth, A, C = Solution(*random_poses(rng, 3)), random_poses(rng, count), random_poses(rng, count)
    found = estimate_triples(A, inverse(A @ truth.X) @ truth.Y @ C @ truth.Z, C, SMALL)
    assert np.abs(errors(found, truth)).max() < 1e-6


@pytest.mark.parametrize(("count", "rotation", "translation"), [(30, 1.0, 0.8), (270, 0.3, 0.25)])
def test_the_published_benchmark_is_kept_with_full_covariance(count: int, rotation: float, translation: float) -> None:
    found = figures(count, runs=5, seed=1)
    assert found.refined[0] < rotation
    assert found.refined[1] < translation
    assert found.closed_form[0] > 2 * found.refined[0]
    assert found.closed_form[1] > 2 * found.refined[1]


def test_errors_are_as_large_as_their_covariance_says() -> None:
    rng = np.random.default_rng(3)
    sigmas = {"A": (0.2e-3, 1e-3), "B": (2e-3, 6e-3), "C": (0.5e-3, 2e-3)}
    squared, costs = [], []
    for _ in range(30):
        exact = random_triples(rng, 20)
        A, B, C = (moved(rng, poses, sigmas[name]) for name, poses in zip("ABC", exact, strict=True))
        found = estimate_triples(A, B, C, TripleNoise.of_sigmas(**sigmas))
        error = errors(found)
        squared.append(error @ np.linalg.solve(found.covariance, error))
        costs.append(found.cost / found.degrees_of_freedom)
        assert found.noise_fits
        assert not found.warnings
    # A chi-square of 18 has the variance 36.
    assert np.mean(squared) == pytest.approx(18, abs=4 * 6 / np.sqrt(30))
    assert np.mean(costs) == pytest.approx(1, abs=4 * np.sqrt(2 / 102 / 30))


def test_a_covariance_of_each_triple_weighs_it() -> None:
    rng = np.random.default_rng(4)
    A, B, C = random_triples(rng, 40)
    spoiled = B.copy()
    spoiled[::2] = moved(rng, B[::2], (0.05, 0.05))
    covariance = np.where(np.arange(40)[:, None, None] % 2 == 0, 0.05**2, 1e-5**2) * np.eye(6)
    found = estimate_triples(A, spoiled, C, TripleNoise(SMALL.A, covariance, SMALL.C))
    assert np.abs(errors(found)).max() < 5e-5
    assert np.abs(errors(estimate_triples(A, spoiled, C, noise()))).max() > 5e-3


def test_flanges_may_be_exact_the_target_in_the_camera_not() -> None:
    rng = np.random.default_rng(5)
    A, B, C = random_triples(rng, 20)
    exact = (0.0, 0.0)
    found = estimate_triples(A, moved(rng, B, (1e-4, 1e-4)), C, TripleNoise.of_sigmas(exact, (1e-4, 1e-4), exact))
    assert np.abs(errors(found)).max() < 5e-4
    with pytest.raises(ValueError, match="B must not be exact"):
        TripleNoise.of_sigmas((1e-4, 1e-4), (1e-4, 0.0), (1e-4, 1e-4))


def test_the_other_direction_between_the_bases_has_its_own_covariance() -> None:
    rng = np.random.default_rng(6)
    A, B, C = (with_errors(rng, poses) for poses in random_triples(rng, 30))
    found = estimate_triples(A, B, C, noise())
    np.testing.assert_allclose(found.T_P_A @ found.Y, np.eye(4), atol=1e-12)
    # Moving Y by e moves its inverse by -Ad(Y) e: compare along each direction of Y.
    for e in 1e-6 * np.eye(6):
        turned = found.Y @ transform(rotation_from_vector(e[3:]), e[:3])
        other = motion(found.T_P_A, inverse(turned))
        squared = e @ np.linalg.solve(found.covariance_of("Y"), e)
        assert other @ np.linalg.solve(found.covariance_of_T_P_A, other) == pytest.approx(squared, rel=1e-4)


def test_noise_stated_too_small_widens_the_covariance_and_noise_stated_too_large_does_not_narrow_it() -> None:
    rng = np.random.default_rng(7)
    A, B, C = (with_errors(rng, poses) for poses in random_triples(rng, 30))
    honest = estimate_triples(A, B, C, noise())
    stated = noise()
    for factor, widened in ((0.1, 10.0), (10.0, 1.0)):
        scaled = TripleNoise(*(factor**2 * each for each in (stated.A, stated.B, stated.C)))
        found = estimate_triples(A, B, C, scaled)
        assert not found.noise_fits
        assert found.scale == pytest.approx(honest.scale / factor, rel=0.02)
        assert "times what the stated noise explains" in found.warnings[0]
        ratio = np.sqrt(np.diag(found.covariance) / np.diag(honest.covariance)) / factor
        np.testing.assert_allclose(ratio, widened, rtol=0.1)


def test_an_outlier_is_named() -> None:
    rng = np.random.default_rng(8)
    A, B, C = (with_errors(rng, poses) for poses in random_triples(rng, 30))
    B[17] = B[17] @ transform(np.eye(3), [0.1, 0.0, 0.0])
    found = estimate_triples(A, B, C, noise())
    assert int(np.argmax(found.squares)) == 17
    assert "without triple 17, which contradicts the others, 0.961 times" in found.warnings[0]


@pytest.mark.parametrize(
    ("count", "wrong"), [(8, (4,)), (10, (0, 7)), (30, (3, 4, 11, 12, 28)), (30, tuple(range(10)))]
)
def test_all_that_contradict_the_others_are_named_and_none_beside(count: int, wrong: tuple[int, ...]) -> None:
    for seed in range(2):
        rng = np.random.default_rng(seed)
        A, B, C = (with_errors(rng, poses) for poses in random_triples(rng, count))
        B[list(wrong)] = random_poses(rng, len(wrong))
        names = [f"pose {index}" for index in range(count)]
        with pytest.raises(Degenerate) as refused:
            estimate_triples(A, B, C, noise(), names)
        assert re.findall(r"pose \d+", str(refused.value)) == [names[index] for index in wrong][:8]
        assert ("and 2 more" in str(refused.value)) == (len(wrong) == 10)
        assert "leave out what contradicts" in str(refused.value)


def test_where_all_are_worse_than_stated_none_is_named() -> None:
    rng = np.random.default_rng(9)
    A, B, C = (with_errors(rng, poses) for poses in random_triples(rng, 30))
    found = estimate_triples(A, B, C, SMALL)
    assert found.scale > 50
    assert "contradict" not in found.warnings[0]


def test_a_few_triples_turned_by_little_come_with_a_warning_where_first_order_is_not_enough() -> None:
    rng = np.random.default_rng(0)
    sigmas = (0.03e-3, 0.15e-3)
    A, C = (UR10.forward(rng.uniform(-0.2, 0.2, (4, 6))) for _ in range(2))
    measured = [moved(rng, poses, sigmas) for poses in following(A, C)]
    found = estimate_triples(*measured, TripleNoise.of_sigmas(sigmas, sigmas, sigmas))
    assert found.rise > 2
    assert any("holds to first order" in warning for warning in found.warnings)


# What is refused


def about_one_axis(rng: np.random.Generator, count: int) -> Array:
    q = np.tile(rng.uniform(-np.pi, np.pi, 6), (count, 1))
    q[:, 2] = rng.uniform(-2, 2, count)
    return UR10.forward(q)


def of_one_orientation(rng: np.random.Generator, count: int) -> Array:
    poses = anywhere(rng, count)
    poses[:, :3, :3] = poses[0, :3, :3]
    return poses


def anywhere(rng: np.random.Generator, count: int) -> Array:
    return UR10.forward(rng.uniform(-np.pi, np.pi, (count, 6)))


Poses = Callable[[np.random.Generator, int], Array]


@pytest.mark.parametrize("sigmas", [(1e-7, 1e-7), (1e-4, 1e-4), (3e-4, 5e-3)])
@pytest.mark.parametrize("count", [5, 200])
@pytest.mark.parametrize(
    ("flange_1", "flange_2", "reason"),
    [
        (about_one_axis, anywhere, r"flange 1 \(A\) is turned about one axis only"),
        (of_one_orientation, anywhere, r"flange 1 \(A\) has the same orientation"),
        (anywhere, about_one_axis, r"flange 2 \(C\) is turned about one axis only"),
        (anywhere, of_one_orientation, r"flange 2 \(C\) has the same orientation"),
    ],
)
def test_flanges_not_turned_about_two_axes_are_refused_with_and_without_noise(
    sigmas: tuple[float, float], count: int, flange_1: Poses, flange_2: Poses, reason: str
) -> None:
    rng = np.random.default_rng(count)
    exact = following(flange_1(rng, count), flange_2(rng, count))
    A, B, C = (moved(rng, poses, sigmas) for poses in exact)
    with pytest.raises(Degenerate, match=reason):
        estimate_triples(A, B, C, TripleNoise.of_sigmas(sigmas, sigmas, sigmas))


def test_arms_that_move_in_step_so_that_the_camera_always_sees_the_same_are_refused() -> None:
    rng = np.random.default_rng(1)
    C = anywhere(rng, 30)
    A = TRUTH.Y @ C @ TRUTH.Z @ random_poses(rng) @ inverse(TRUTH.X)
    with pytest.raises(Degenerate, match=r"the target as the camera sees it \(B\) has the same orientation"):
        estimate_triples(*following(A, C), noise())


def test_three_triples_are_too_few_however_often_they_were_taken() -> None:
    rng = np.random.default_rng(2)
    three = random_triples(rng, 3)
    with pytest.raises(Degenerate, match="3 triples, at least 4 are needed"):
        estimate_triples(*three, noise())
    A, B, C = (with_errors(rng, np.tile(poses, (10, 1, 1))) for poses in three)
    with pytest.raises(Degenerate, match="30 triples, 3 of them different"):
        estimate_triples(A, B, C, noise())


def test_what_is_turned_too_little_for_its_noise_is_refused() -> None:
    rng = np.random.default_rng(3)
    A, C = anywhere(rng, 6), UR10.forward(0.05 * rng.uniform(-1, 1, (6, 6)))
    A, B, C = (with_errors(rng, poses) for poses in following(A, C))
    with pytest.raises(Degenerate, match=r"is uncertain by|one axis only|the same orientation"):
        estimate_triples(A, B, C, noise())


@pytest.mark.parametrize("count", [10, 22, 40])
@pytest.mark.parametrize("mistake", ["inverted", "shuffled"])
def test_poses_that_do_not_belong_together_are_refused_and_neither_averaged_nor_blamed_on_some(
    mistake: str, count: int
) -> None:
    rng = np.random.default_rng(4)
    A, B, C = (with_errors(rng, poses) for poses in random_triples(rng, count))
    B = inverse(B) if mistake == "inverted" else np.roll(B, 1, axis=0)
    with pytest.raises(Degenerate, match=r"do not fit AXB = YCZ: .* explains; check what A, B and C are"):
        estimate_triples(A, B, C, noise())


def test_what_is_no_pose_and_no_covariance_is_told() -> None:
    A, B, C = random_triples(np.random.default_rng(0), 5)
    with pytest.raises(ValueError, match="B has poses that are no rigid transforms"):
        estimate_triples(A, 1.001 * B, C, SMALL)
    with pytest.raises(ValueError, match="5 poses A, 4 B and 5 C"):
        estimate_triples(A, B[:4], C, SMALL)
    with pytest.raises(ValueError, match="finite poses"):
        estimate_triples(A, B * np.nan, C, SMALL)
    with pytest.raises(ValueError, match="4 covariances of B for 5 triples"):
        estimate_triples(A, B, C, TripleNoise(np.eye(6), np.tile(np.eye(6), (4, 1, 1)), np.eye(6)))
    for wrong, why in ((-np.eye(6), "negative"), (np.eye(3), "shape"), (np.full((6, 6), np.inf), "finite")):
        with pytest.raises(ValueError, match=why):
            TripleNoise(np.eye(6), wrong, np.eye(6))
    with pytest.raises(ValueError, match="the closed form needs 10"):
        solve_in_closed_form(A, B, C)


# Files


@pytest.fixture
def write(tmp_path: Path) -> Callable[..., Path]:
    def write(content: str | dict[str, Any], name: str = "") -> Path:
        path = tmp_path / (name or ("triples.csv" if isinstance(content, str) else "triples.json"))
        path.write_text(content if isinstance(content, str) else json.dumps(content, indent=1))
        return path

    return write


def problems(path: Path) -> list[str]:
    with pytest.raises(FormatError) as caught:
        read_triples(path)
    return [str(problem).removeprefix(str(path)) for problem in caught.value.problems]


def document(*entries: Any) -> dict[str, Any]:
    return {"format": "dualcal.triples/1", "made by": "another program", "triples": list(entries)}


def entry(**changes: Any) -> dict[str, Any]:
    identity = {"matrix": np.eye(4).tolist()}
    return {"A": identity, "B": identity, "C": identity} | changes


def columns(form: str) -> list[str]:
    names = {
        "matrix": [f"{row}{column}" for row in range(3) for column in range(4)],
        "quaternion": ["x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"],
        "vector": ["x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad"],
    }[form]
    return [f"{key}_{name}" for key in "ABC" for name in names]


def numbers(T: Array, form: str) -> list[float]:
    rotation = quaternion_from_rotation if form == "quaternion" else vector_from_rotation
    return [*T[:3].ravel()] if form == "matrix" else [*T[:3, 3], *rotation(T[:3, :3])]


@pytest.mark.parametrize("form", ["matrix", "quaternion", "vector"])
@pytest.mark.parametrize("separator", [",", ";"])
def test_each_form_of_a_pose_in_csv_gives_the_same_triples(
    write: Callable[..., Path], form: str, separator: str
) -> None:
    exact = random_triples(np.random.default_rng(1), 4)
    rows = [[f"{n:.12f}" for T in triple for n in numbers(T, form)] for triple in zip(*exact, strict=True)]
    lines = [separator.join(row) for row in (columns(form), *rows)]
    read = read_triples(write("\ufeff" + "\r\n".join([lines[0], "", *lines[1:]])))
    for found, expected in zip((read.A, read.B, read.C), exact, strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-9)
    assert read.names == ("line 3", "line 4", "line 5", "line 6")
    assert read.covariances == {"A": None, "B": None, "C": None}


def test_each_form_of_a_pose_in_json_gives_the_same_triples(write: Callable[..., Path]) -> None:
    exact = random_triples(np.random.default_rng(2), 3)
    entries = []
    for number, (A, B, C) in enumerate(zip(*exact, strict=True)):
        entries.append(
            {
                "id": number,
                "A": {"matrix": A.round(5).tolist()},
                "B": {"translation_m": [*B[:3, 3]], "quaternion_xyzw": [*quaternion_from_rotation(B[:3, :3]).round(4)]},
                "C": {"translation_m": [*C[:3, 3]], "rotation_vector_rad": [*vector_from_rotation(C[:3, :3])]},
            }
        )
    read = read_triples(write(document(*entries)))
    for found, expected in zip((read.A, read.B, read.C), exact, strict=True):
        np.testing.assert_allclose(found, expected, atol=3e-4)
        np.testing.assert_allclose(found[:, :3, :3] @ np.swapaxes(found[:, :3, :3], 1, 2) - np.eye(3), 0, atol=1e-12)
    assert read.names == ("0", "1", "2")


def test_uncertainty_comes_as_sigmas_in_csv_and_as_a_covariance_in_json(write: Callable[..., Path]) -> None:
    header = [*columns("vector"), "B_sigma_m", "B_sigma_rad"]
    read = read_triples(write(",".join(header) + "\n" + ",".join(["0"] * 18 + ["0.002", "0.01"])))
    covariance = read.covariances["B"]
    assert covariance is not None
    np.testing.assert_allclose(covariance, [np.diag([4e-6] * 3 + [1e-4] * 3)])
    pose = {"matrix": np.eye(4).tolist(), "covariance": covariance[0].tolist()}
    again = read_triples(write(document(entry(B=pose))))
    np.testing.assert_array_equal(np.asarray(again.covariances["B"]), covariance)


def test_all_that_is_wrong_in_a_csv_file_is_told_at_once_each_at_its_line(write: Callable[..., Path]) -> None:
    good = ["0"] * 18
    rows = [
        ["id", *columns("vector")],
        ["first", *good],
        ["short", *good[1:]],
        ["word", "abc", *good[1:]],
        ["mm", "1700", *good[1:]],
        ["deg", *good[:5], "90", *good[6:17], "nan"],
        ["first", *good],
    ]
    assert problems(write("\n".join(",".join(row) for row in rows))) == [
        ":3: 18 values where there are 19 columns",
        ":4: A: A_x_m is no finite number: 'abc'",
        ":5: A: a translation of 1700 m: lengths are in metres",
        ":6: A: a rotation vector of length 90: angles are in radians",
        ":6: C: C_rz_rad is no finite number: 'nan'",
        f":7: id 'first' is that of {write('', 'x').parent / 'triples.csv'}:2, too",
    ]


def test_all_that_is_wrong_in_a_json_file_is_told_at_once_each_at_its_line(write: Callable[..., Path]) -> None:
    mirrored, projective = np.diag([1.0, 1.0, -1.0, 1.0]), np.eye(4) + np.eye(4, k=-3)
    pose, lopsided = np.eye(4).tolist(), (np.eye(6) + np.eye(6, k=1)).tolist()
    text = json.dumps(
        document(
            entry(),
            entry(A={"matrix": mirrored.tolist()}, B={"matrix": projective.tolist()}),
            entry(id="x", A={"translation_m": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 2]}, B=3, C={}),
            7,
            entry(A={"matrix": [[1]]}, B={"matrix": pose, "covariance": lopsided}),
            entry(id=True),
        )
    ).replace('{"A"', '\n{"A"')
    assert problems(write(text, "triples.json")) == [
        ":3: triples[1]: A: the matrix has no rotation: its columns must be orthonormal and right-handed",
        ":3: triples[1]: B: the last row of the matrix must be 0, 0, 0, 1",
        ":4: x: A: the quaternion has length 2, not 1",
        ":4: x: B: is not a JSON object",
        ":4: x: C: needs one of matrix, quaternion_xyzw and rotation_vector_rad",
        ":4: triples[3] is not a JSON object",
        ":5: triples[4]: A: matrix is no list of 4 rows",
        ":5: triples[4]: B: the covariance is not symmetric with variances from 0 up",
        ":6: triples[5]: id must be a text",
    ]


@pytest.mark.parametrize(
    ("content", "name", "what"),
    [
        ("", "t.csv", "has no triples"),
        ("A_x_m,A_y_m\n1,2\n", "t.csv", "the columns of A must be one of"),
        (",".join([*columns("vector"), "A_sigma_m"]), "t.csv", "go together"),
        (",".join([*columns("vector"), "A_qx"]), "t.csv", "the columns of A must be one of"),
        (",".join([*columns("vector"), "id", "id"]), "t.csv", "'id' is there twice"),
        ("{", "t.json", "is not JSON"),
        ('{"triples": []}', "t.json", "key 'format' is missing"),
        ('{"format": "dualcal.triples/1"}', "t.json", "triples: must be a list"),
        ('{"format": "dualcal.triples/1", "triples": []}', "t.json", "has no triples"),
    ],
)
def test_what_is_no_file_of_triples_is_refused(write: Callable[..., Path], content: str, name: str, what: str) -> None:
    assert any(what in problem for problem in problems(write(content, name)))


def test_an_id_is_of_one_triple_also_where_all_stand_in_one_line(write: Callable[..., Path]) -> None:
    path = write(json.dumps(document(entry(id="a"), entry(id="b"), entry(id="a"))), "one-line.json")
    assert problems(path) == [f":1: id 'a' is that of {path}:1, too"]


def test_a_covariance_is_given_for_all_or_for_none(write: Callable[..., Path]) -> None:
    known = {"matrix": np.eye(4).tolist(), "covariance": np.eye(6).tolist()}
    (problem,) = problems(write(document(entry(B=known), entry())))
    assert problem.endswith("B has no covariance where others have one")


def test_files_without_end_are_refused_and_problems_without_end_cut_short(
    write: Callable[..., Path], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    rows = "\n".join([",".join(columns("vector")), *["x"] * 80])
    told = problems(write(rows))
    assert len(told) == 51
    assert told[-1].endswith("30 more problems of this kind")
    assert problems(tmp_path / "nowhere.csv") == [": cannot be read: No such file or directory"]
    monkeypatch.setattr(files, "MOST_TRIPLES", 1)
    assert problems(write(document(entry(), entry()))) == [": has 2 triples, at most 1 are read"]
    monkeypatch.setattr(files, "LARGEST_FILE", 10)
    assert problems(write(document(entry())))[0].endswith("at most 10 are read")
