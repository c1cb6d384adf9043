"""The target detected anew in the images of a finished run."""

from __future__ import annotations

import shutil

import cv2
import numpy as np
import pytest

from dualcal_hal.cellfile import load_cell
from dualcal_hal.session.captures import read_captures
from dualcal_hal.session.folder import Session
from procedures.redetection import detect_anew
from tests.command_line import dualcal

RESOLVED_PX = 1e-3
"""Another prediction moves a corner by less."""


@pytest.fixture
def session(recorded, tmp_path):
    return shutil.copytree(recorded, tmp_path / "session")


def test_the_same_images_show_the_same_corners(session):
    cell = load_cell(session / "cell.yaml").cell
    captures = read_captures(session / "captures.json")
    anew = detect_anew(Session(session), captures, cell)
    assert anew.rms < RESOLVED_PX
    assert [capture.id for capture in anew.captures.captures] == [capture.id for capture in captures.captures]
    assert not anew.missed


def test_what_counts_is_what_the_images_show(session):
    """The captures' own corners serve as a hint of where to look alone."""
    cell = load_cell(session / "cell.yaml").cell
    captures = read_captures(session / "captures.json")
    first = captures.captures[0]
    image = cv2.imread(str(Session(session).image_path(first.id)), cv2.IMREAD_GRAYSCALE)
    shifted = cv2.warpAffine(image, np.float32([[1, 0, 3], [0, 1, -2]]), image.shape[::-1], borderValue=128)
    cv2.imwrite(str(Session(session).image_path(first.id)), shifted)
    anew = detect_anew(Session(session), captures, cell)
    assert np.subtract(anew.captures.captures[0].feature, first.feature) == pytest.approx([3, -2], abs=RESOLVED_PX)


def test_frames_of_the_log_do_where_there_are_no_images(session):
    with_images = dualcal("estimate", session, "--redetect", "--json")
    shutil.rmtree(session / "images")
    from_log = dualcal("estimate", session, "--redetect", "--json")
    assert from_log.exit_code == 0
    assert from_log.stdout == with_images.stdout
    assert "detected anew in 12 images" in from_log.stderr


def test_an_image_without_the_target_is_left_out_by_name(session):
    captures = read_captures(session / "captures.json").captures
    blank = np.full((384, 512), 128, np.uint8)
    cv2.imwrite(str(Session(session).image_path(captures[-1].id)), blank)
    result = dualcal("estimate", session, "--redetect")
    assert result.exit_code == 0
    assert f"{captures[-1].id}: not detected anew: not found" in " ".join(result.output.split())


def test_an_image_that_is_nowhere_is_told(session):
    shutil.rmtree(session / "images")
    (session / "log-0001.mcap").unlink()
    result = dualcal("estimate", session, "--redetect")
    assert result.exit_code == 2
    assert "has no image of calibration/00/0" in result.output


def test_captures_alone_have_no_images(session):
    result = dualcal("estimate", session / "captures.json", "--redetect")
    assert result.exit_code == 2
    assert "needs the session's folder" in result.output
