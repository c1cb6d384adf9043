"""Mismatch, its statistics and the verdict."""

import numpy as np
import pytest

from dualcal_hal.transforms import transform
from procedures.estimation import judge, mismatch, statistics


def test_mismatch_is_the_distance_of_the_feature_point_from_the_optical_axis() -> None:
    camera_looks_along_x = transform([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], [0.1, 0.0, 0.5])
    flanges = np.stack([np.eye(4), transform(np.eye(3), [0, 0.02, 0])])
    points = np.array([[0.6, 0.003, 0.504], [0.2, 0.02, 0.5]])
    np.testing.assert_allclose(mismatch(np.eye(4), camera_looks_along_x, flanges, points), [0.005, 0.0], atol=1e-15)


def test_mismatch_uses_the_base_transform() -> None:
    turned = transform([[-1, 0, 0], [0, -1, 0], [0, 0, 1]], [1.2, 0, 0])
    point_in_active = np.array([0.03, 0.04, 0.4])
    off = mismatch(turned, np.eye(4), np.eye(4)[None], (turned[:3, :3] @ point_in_active + turned[:3, 3])[None])
    np.testing.assert_allclose(off, [0.05])


def test_statistics_are_mean_rms_p95_and_max() -> None:
    found = statistics([0.003, 0.001, 0.004, 0.0])
    assert found.mean == pytest.approx(0.002)
    assert found.rms == pytest.approx(np.sqrt(26e-6 / 4))
    assert found.p95 == pytest.approx(0.003 + 0.85 * 0.001)
    assert found.max == 0.004
    assert found.values == (0.003, 0.001, 0.004, 0.0)


def test_a_mean_up_to_the_limit_is_ok_though_single_values_are_above() -> None:
    verdict, reason = judge(statistics([0.0, 0.001]), limit=0.0005)
    assert verdict == "ok"
    assert reason == "mean mismatch 0.500 mm on 2 verification captures, within the limit of 0.5 mm"


def test_a_mean_above_the_limit_fails_and_says_by_how_much() -> None:
    verdict, reason = judge(statistics([0.0006]), limit=0.0005)
    assert verdict == "fail"
    assert "0.600 mm" in reason
    assert "above the limit of 0.5 mm" in reason


def test_without_verification_captures_nothing_is_claimed() -> None:
    verdict, reason = judge(None, limit=0.0005)
    assert verdict == "unverified"
    assert "no verification captures" in reason
