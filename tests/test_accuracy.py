"""Accuracy over seeds: whole runs of the paper's cell on the simulator."""

from __future__ import annotations

import numpy as np
import pytest

from tests.cells import NOISELESS, PAPER
from tools.benchmarks.accuracy import run


@pytest.mark.slow
def test_twenty_seeds_of_the_papers_cell_are_accurate_and_quickly_aligned():
    """In physics: contact would end a run with an error."""
    runs = [run(PAPER, seed, []) for seed in range(1, 21)]
    mismatch = [one.mismatch for one in runs]
    assert np.mean(mismatch) <= 0.10
    assert max(mismatch) <= 0.20
    assert max(one.rotation for one in runs) <= 0.04
    assert max(one.translation for one in runs) <= 0.5
    frames = np.concatenate([one.frames for one in runs])
    assert frames.mean() <= 2.0
    assert np.percentile(frames, 95) <= 3
    assert np.concatenate([one.later_frames for one in runs]).mean() <= 1.5
    assert all(len(one.frames) - one.given_up >= 42 for one in runs)
    assert all(one.verdict == "ok" for one in runs)


@pytest.mark.slow
def test_from_the_nominal_alignment_takes_few_pictures_too():
    runs = [run(PAPER, seed, ["procedure.first_looks=0"]) for seed in range(1, 6)]
    frames = np.concatenate([one.frames for one in runs])
    assert frames.mean() <= 3.0
    assert np.percentile(frames, 95) <= 5
    assert all(len(one.frames) - one.given_up >= 42 for one in runs)


@pytest.mark.slow
def test_without_noise_the_papers_cell_is_exact():
    assert run(PAPER, 1, [*NOISELESS, "procedure.tolerance_px=0.01"]).mismatch <= 0.01
