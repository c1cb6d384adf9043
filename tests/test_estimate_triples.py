"""``dualcal estimate`` on pose triples: from a file of another program to a table and a public document."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dualcal_hal.session.triples import read_triples
from dualcal_hal.transforms import Array, inverse, quaternion_from_rotation, vector_from_rotation
from procedures.estimation.triples import TripleNoise, estimate_triples
from tests.command_line import dualcal
from tests.reference_cell import REFERENCE
from tools.benchmarks.triples import ROTATION_ERROR, TRANSLATION_ERROR, TRUTH, random_triples, with_errors

CELL = Path(__file__).parent.parent / "cells" / "paper.yaml"
SIGMAS = TRANSLATION_ERROR / np.sqrt(3), ROTATION_ERROR / np.sqrt(3)
TYPED = f"{1e3 * SIGMAS[0]},{np.degrees(SIGMAS[1])}"
ALL_TYPED = ("--sigma-a", TYPED, "--sigma-b", TYPED, "--sigma-c", TYPED)
NAMES = {"X": "camera_in_active_flange", "Y": "passive_base_in_active_base", "Z": "target_in_passive_flange"}

Triples = tuple[Array, Array, Array]


@pytest.fixture
def triples() -> Triples:
    rng = np.random.default_rng(1)
    A, B, C = (with_errors(rng, poses) for poses in random_triples(rng, 30))
    return A, B, C


def document(triples: Triples, exactly_known: str = "") -> dict[str, Any]:
    """As another program writes it; of the letters in ``exactly_known`` the file has a covariance."""
    covariance = np.diag(np.repeat(np.square(SIGMAS), 3)).tolist()
    entries = [
        {"id": f"P{number}"}
        | {
            name: {"matrix": T.tolist()} | ({"covariance": covariance} if name in exactly_known else {})
            for name, T in zip("ABC", poses, strict=True)
        }
        for number, poses in enumerate(zip(*triples, strict=True))
    ]
    return {"format": "dualcal.triples/1", "triples": entries}


def written(folder: Path, triples: Triples, exactly_known: str = "") -> Path:
    path = folder / "triples.json"
    path.write_text(json.dumps(document(triples, exactly_known)))
    return path


def written_as_csv(folder: Path, triples: Triples) -> Path:
    path = folder / "triples.CSV"
    pose, sigma = ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw"), ("sigma_m", "sigma_rad")
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["id", *(f"{name}_{column}" for name in "ABC" for column in (*pose, *sigma))])
        for number, poses in enumerate(zip(*triples, strict=True)):
            values = [[*T[:3, 3], *quaternion_from_rotation(T[:3, :3]), *SIGMAS] for T in poses]
            writer.writerow([f"P{number}", *(value for row in values for value in row)])
    return path


def as_document(*arguments: object) -> dict[str, Any]:
    ended = dualcal("estimate", *arguments, "--json")
    assert ended.exit_code == 0, ended.stderr
    found: dict[str, Any] = json.loads(ended.stdout)
    return found


def refusal(*arguments: object) -> str:
    ended = dualcal("estimate", *arguments)
    assert ended.exit_code == 2
    assert not ended.stdout
    return " ".join(ended.stderr.split())


# The result


def test_the_document_has_what_the_estimator_found(tmp_path: Path, triples: Triples) -> None:
    found = as_document(written(tmp_path, triples), *ALL_TYPED)
    expected = estimate_triples(*triples, TripleNoise.of_sigmas(SIGMAS, SIGMAS, SIGMAS))
    assert found["format"] == "dualcal.triples-result/1"
    assert found["equation"] == {"form": "A X B = Y C Z", **NAMES}
    for letter, name in NAMES.items():
        transform = found["transforms"][name]
        np.testing.assert_allclose(transform["matrix"], getattr(expected, letter), atol=1e-9)
        np.testing.assert_allclose(transform["covariance"]["matrix"], expected.covariance_of(letter), rtol=1e-5)
        assert "child" in transform["covariance"]["frame"]
        assert transform["covariance"]["units"] == "m and rad"
    T_P_A = found["transforms"]["active_base_in_passive_base"]
    np.testing.assert_allclose(T_P_A["matrix"], inverse(expected.Y), atol=1e-9)
    np.testing.assert_allclose(T_P_A["covariance"]["matrix"], expected.covariance_of_T_P_A, rtol=1e-5, atol=1e-13)
    np.testing.assert_allclose(found["covariance"]["matrix"], expected.covariance, rtol=1e-5, atol=1e-13)
    assert found["covariance"]["of"][0] == "camera_in_active_flange: translation x"
    assert found["covariance"]["of"][17] == "target_in_passive_flange: rotation z"
    assert found["noise"]["scale"] == pytest.approx(expected.scale)
    assert found["noise"]["as_stated"]
    assert not found["noise"]["covariance_is_scaled"]
    assert found["observability"]["conditioning"] == pytest.approx(expected.conditioning)
    assert found["observability"]["unobservable"] == []
    assert found["warnings"] == []


def test_sigmas_are_along_the_axes_of_the_outer_frame_and_none_exceeds_the_least_certain(
    tmp_path: Path, triples: Triples
) -> None:
    found = as_document(written(tmp_path, triples), *ALL_TYPED)
    least = {(entry["of"], entry["what"]): entry for entry in found["observability"]["least_certain"]}
    for name in NAMES.values():
        transform = found["transforms"][name]
        R = np.array(transform["matrix"])[:3, :3]
        covariance = np.array(transform["covariance"]["matrix"])
        for at, what, key, unit in (
            (slice(0, 3), "position", "sigma_mm", 1e3),
            (slice(3, 6), "rotation", "sigma_deg", np.degrees(1.0)),
        ):
            outer = R @ covariance[at, at] @ R.T
            np.testing.assert_allclose(transform[key], unit * np.sqrt(np.diag(outer)))
            direction = np.array(least[name, what]["direction"])
            assert least[name, what][key] == pytest.approx(unit * np.sqrt(direction @ outer @ direction))
            assert least[name, what][key] >= max(transform[key])


def test_residuals_lead_from_the_measured_target_to_the_predicted_one(tmp_path: Path, triples: Triples) -> None:
    found = as_document(written(tmp_path, triples), *ALL_TYPED)
    X, Y, Z = (np.array(found["transforms"][name]["matrix"]) for name in NAMES.values())
    A, B, C = triples
    between = inverse(B) @ inverse(A @ X) @ Y @ C @ Z
    assert [residual["id"] for residual in found["residuals"]] == [f"P{number}" for number in range(30)]
    translations = [residual["translation_m"] for residual in found["residuals"]]
    rotations = [residual["rotation_rad"] for residual in found["residuals"]]
    np.testing.assert_allclose(translations, between[:, :3, 3], atol=1e-9)
    np.testing.assert_allclose(rotations, vector_from_rotation(between[:, :3, :3]), atol=1e-9)
    assert sum(residual["square"] for residual in found["residuals"]) == pytest.approx(found["noise"]["cost"])


def test_what_is_written_is_what_is_printed(tmp_path: Path, triples: Triples) -> None:
    path, out = written(tmp_path, triples), tmp_path / "found.json"
    assert as_document(path, *ALL_TYPED, "--out", out) == json.loads(out.read_text())


def test_csv_and_json_say_the_same(tmp_path: Path, triples: Triples) -> None:
    found = as_document(written(tmp_path, triples, "ABC"))
    again = as_document(written_as_csv(tmp_path, triples))
    for name, transform in found["transforms"].items():
        np.testing.assert_allclose(again["transforms"][name]["matrix"], transform["matrix"], atol=1e-7)


# What a person sees


def test_the_table_is_complete_within_80_columns(tmp_path: Path, triples: Triples) -> None:
    ended = dualcal("estimate", written(tmp_path, triples), *ALL_TYPED)
    assert ended.exit_code == 0
    lines = ended.stdout.splitlines()
    assert max(map(len, lines)) <= 80
    rows = {line.split()[0]: line.split()[1:] for line in reversed(lines) if line.split()}
    found = estimate_triples(*triples, TripleNoise.of_sigmas(SIGMAS, SIGMAS, SIGMAS))
    for letter, T in (("X", found.X), ("Y", found.Y), ("Z", found.Z), ("T_P_A", found.T_P_A)):
        printed = [float(cell) for cell in rows[letter]]
        np.testing.assert_allclose(printed[:3], 1e3 * T[:3, 3], atol=6e-4)
        np.testing.assert_allclose(printed[3:], np.degrees(vector_from_rotation(T[:3, :3])), atol=6e-5)
    assert len([line for line in lines if line.split()[:1] == ["sigma"]]) == 4
    for words in ("All 18 directions are determined", "Scale 0.9", "as large as the stated noise makes them"):
        assert words in ended.stdout
    assert "Not written to a file" in ended.stdout


def test_an_outlier_comes_first_of_the_worst_and_is_warned_of_by_its_name(tmp_path: Path, triples: Triples) -> None:
    A, B, C = triples
    B[17, 0, 3] += 0.1
    ended = dualcal("estimate", written(tmp_path, (A, B, C)), *ALL_TYPED)
    assert ended.exit_code == 0
    worst = ended.stdout.split("Triples that fit worst")[1]
    assert worst.split("deg", 1)[1].split()[1] == "P17"
    said = " ".join(ended.stdout.split())
    assert "times what the stated noise explains, and without triple P17" in said
    assert "too large for the stated noise; the sigmas of X, Y and Z are multiplied by it" in said


def test_noise_that_is_stated_too_large_is_said_and_does_not_shrink_the_sigmas(
    tmp_path: Path, triples: Triples
) -> None:
    ended = dualcal("estimate", written(tmp_path, triples, "AC"), "--sigma-b", "10,5")
    assert "too small for the stated noise; the sigmas of X, Y and Z are those that it makes" in " ".join(
        ended.stdout.split()
    )


def test_a_name_that_is_no_plain_text_is_no_command_for_the_terminal(tmp_path: Path, triples: Triples) -> None:
    path = tmp_path / "triples.json"
    path.write_text(json.dumps(document(triples, "ABC")).replace('"P10"', r'"[red]\u001b[2J' + 100 * "x" + '"'))
    ended = dualcal("estimate", path)
    assert "[red]?[2Jxxx" in ended.stdout
    assert max(map(len, ended.stdout.splitlines())) <= 80


# How exact the poses are


def test_nothing_is_assumed_of_how_exact_the_poses_are(tmp_path: Path, triples: Triples) -> None:
    path = written(tmp_path, triples)
    assert refusal(path) == (
        f"dualcal: {path}: does not say how exact the poses of A, B, C are; give --sigma-a MM,DEG --sigma-b MM,DEG"
        " --sigma-c MM,DEG, the sigma per axis (0,0 for an exact A or C), or write it into the file"
    )
    path = written(tmp_path, triples, "AC")
    assert "the poses of B are; give --sigma-b MM,DEG, the sigma" in refusal(path, "--sigma-a", "0,0")


def test_what_is_typed_goes_before_what_the_file_says(tmp_path: Path, triples: Triples) -> None:
    path = written(tmp_path, triples, "ABC")
    stated = as_document(path, "--sigma-b", "2,1.5")["noise"]["stated"]
    assert stated["A"] == {
        "sigma_mm": pytest.approx(1e3 * SIGMAS[0]),
        "sigma_deg": pytest.approx(np.degrees(SIGMAS[1])),
        "stated_in": "file",
    }
    assert stated["B"] == {"sigma_mm": pytest.approx(2), "sigma_deg": pytest.approx(1.5), "stated_in": "option"}
    sigmas = [as_document(path, *more)["transforms"][NAMES["X"]]["sigma_deg"] for more in ((), ("--sigma-b", "2,1.5"))]
    assert np.all(np.array(sigmas[1]) > 1.05 * np.array(sigmas[0]))


@pytest.mark.parametrize("typed", ["1", "1,2,3", "a,b", "-1,1", "nan,1", "inf,1", ""])
def test_sigmas_that_are_none_are_refused(tmp_path: Path, triples: Triples, typed: str) -> None:
    assert "must be MM,DEG, two numbers from 0 up" in refusal(written(tmp_path, triples), f"--sigma-b={typed}")


def test_the_target_in_the_camera_is_never_exact(tmp_path: Path, triples: Triples) -> None:
    assert "--sigma-b: the covariance of B is singular" in refusal(written(tmp_path, triples, "AC"), "--sigma-b", "0,0")
    entries = document(triples, "AC")
    for entry in entries["triples"]:
        entry["B"]["covariance"] = np.zeros((6, 6)).tolist()
    path = tmp_path / "exact.json"
    path.write_text(json.dumps(entries))
    assert f"{path}: the covariance of B is singular" in refusal(path)


# Refusals


def test_triples_that_determine_nothing_are_refused_with_the_reason(tmp_path: Path, triples: Triples) -> None:
    A, B, C = triples
    three = written(tmp_path, (A[:3], B[:3], C[:3]))
    assert refusal(three, *ALL_TYPED) == "dualcal: the triples give no X, Y and Z: 3 triples, at least 4 are needed"
    shuffled = written(tmp_path, (A, np.roll(B, 1, axis=0), C))
    assert "the triples do not fit AXB = YCZ" in refusal(shuffled, *ALL_TYPED)


@pytest.mark.parametrize(
    ("content", "why"),
    [
        ("{", "is not JSON"),
        ('{"format": "dualcal.triples/2"}', "format 'dualcal.triples/2' is not known"),
        ('{"triples": []}', "key 'format' is missing; this version reads 'dualcal.triples/1'"),
        ('{"format": "dualcal.triples/1", "triples": [{"A": {}}]}', "triples.json:1: triples[0]: B: is missing"),
    ],
)
def test_a_file_that_cannot_be_used_is_refused_for_what_is_wrong_with_it(
    tmp_path: Path, content: str, why: str
) -> None:
    path = tmp_path / "triples.json"
    path.write_text(content)
    assert why in refusal(path, *ALL_TYPED)


def test_options_for_the_other_kind_of_file_are_refused(tmp_path: Path, triples: Triples) -> None:
    path = written(tmp_path, triples, "ABC")
    said = refusal(path, "--cell", CELL, "--method", "paper", "--truth", path, "--redetect")
    assert said.endswith("has pose triples; leave out what is for captures: --cell, --method, --truth, --redetect")
    said = refusal(REFERENCE, "--cell", CELL, "--sigma-b", "1,1")
    assert said.endswith("has captures; leave out what is for pose triples: --sigma-b")


def test_no_result_replaces_the_triples_it_comes_from(tmp_path: Path, triples: Triples) -> None:
    path = written(tmp_path, triples, "ABC")
    assert "is what the estimate is made from" in refusal(path, "--out", path)
    assert len(read_triples(path).names) == 30
    assert "cannot be written" in refusal(path, "--out", tmp_path / "missing" / "out.json")


def test_the_truth_is_found_within_its_sigmas(tmp_path: Path, triples: Triples) -> None:
    found = as_document(written(tmp_path, triples, "ABC"))
    for letter, name in NAMES.items():
        transform = found["transforms"][name]
        off = 1e3 * (np.array(transform["matrix"])[:3, 3] - getattr(TRUTH, letter)[:3, 3])
        assert np.all(np.abs(off) < 4 * np.array(transform["sigma_mm"]))
