"""Checkerboards by their saddle points: each corner is one, and its neighbours are the same turned inside out.

A saddle of the blurred image has a Hessian H of negative determinant. Across a square's edge black and white change
places, so neighbouring corners have opposite H, whatever the view. From four saddles that belong to one square the
lattice grows as far as it goes. Nothing in this depends on a threshold between black and white, so it stands uneven
light, and a board partly hidden gives the part that is seen.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from dualcal_hal.camera import Image
from dualcal_hal.transforms import Array

Place = tuple[int, int]
Step = tuple[float, float]

BLUR = 1.5
"""px, sigma, before derivatives are taken."""
LEAST_STEP = 6.0
"""px between neighbouring corners, below which they merge."""
_DERIVATIVES = (((2, 0), 1 / 4), ((0, 2), 1 / 4), ((1, 1), 1 / 4))  # xx, yy, xy: orders, Sobel's scale
_RING = 4.0  # px, radius on which a saddle's surroundings are compared with their mirror image
_RING_X, _RING_Y = (np.rint(_RING * part(np.arange(16) * np.pi / 8)).astype(int) for part in (np.cos, np.sin))
_LEAST_CURVATURE = 0.7  # grey levels per px^2: a contrast of 5 in a sharp image, of 20 in one that is barely usable
_MOST_SADDLES = 600
_BAND = 192  # rows that are worked on together: they stay in the processor's cache, a whole image does not
_BEYOND = 12  # rows beyond them that have a part in what is found: the blur's reach, and the ring's
_NEIGHBOURS = 12  # of a saddle, among which its neighbours in the lattice are looked for
_SYMMETRY = 0.5  # correlation of a saddle's surroundings with their mirror image; a square's outer corner has -0.3
ALIKE = 0.75
"""Cosine between the Hessians of a square's opposite corners; of its neighbouring ones it is the negative."""
OFF = 0.25
"""Of a step between corners, by which one may be off where it is expected."""
_TILE = 32  # px, of the image, whose saddles are looked through together
_LEAST_SINE = 0.3  # of the angle between a square's sides


@dataclass(frozen=True, eq=False)
class SaddlePoints:
    """points: (n, 2) px, good to a pixel or two; hessians: (n, 3) xx, sqrt(2) xy, yy, of unit length."""

    points: Array
    hessians: Array

    def moved(self, by: tuple[int, int]) -> SaddlePoints:
        """The same in an image of which this one is a part that begins at ``by`` px."""
        return SaddlePoints(self.points + np.array(by, dtype=float), self.hessians)


class _Growing:
    """Lattices under growth among saddles, one after another; plain numbers, for there are many small steps."""

    def __init__(self, saddles: SaddlePoints) -> None:
        self.points: list[tuple[float, float]] = [(x, y) for x, y in saddles.points.tolist()]
        self._hessians: list[list[float]] = saddles.hessians.tolist()
        self._tiles: dict[Place, list[int]] = {}
        for saddle, (x, y) in enumerate(self.points):
            self._tiles.setdefault((int(x // _TILE), int(y // _TILE)), []).append(saddle)

    def grow(self, seed: int, right: Step, down: Step) -> dict[Place, int]:
        """All corners that follow from one another by nearly equal steps, at first those to the ``right`` and ``down``.

        By their row and column, from (0, 0) for the ``seed``.
        """
        at, taken = {(0, 0): seed}, {seed}
        known = {(0, 0): {(0, 1): right, (0, -1): _back(right), (1, 0): down, (-1, 0): _back(down)}}
        queue = deque([(0, 0)])
        while queue:
            place = queue.popleft()
            here = at[place]
            for way, step in known[place].items():
                target = (place[0] + way[0], place[1] + way[1])
                if target in at:
                    continue
                found = self._corner_at(here, step)
                if found is None or found in taken:
                    continue
                at[target] = found
                taken.add(found)
                (x0, y0), (x1, y1) = self.points[here], self.points[found]
                taken_step = (x1 - x0, y1 - y0)
                known[target] = {**known[place], way: taken_step, (-way[0], -way[1]): _back(taken_step)}
                queue.append(target)
        return at

    def _corner_at(self, here: int, step: Step) -> int | None:
        """The saddle one step on from ``here``, if there is one with the opposite Hessian."""
        (dx, dy), (x, y) = step, self.points[here]
        x, y = x + dx, y + dy
        nearest, found = OFF**2 * (dx * dx + dy * dy), None
        within = math.sqrt(nearest)
        for i in range(int((x - within) // _TILE), int((x + within) // _TILE) + 1):
            for j in range(int((y - within) // _TILE), int((y + within) // _TILE) + 1):
                for saddle in self._tiles.get((i, j), ()):
                    u, v = self.points[saddle]
                    off = (u - x) ** 2 + (v - y) ** 2
                    if off < nearest or (off == nearest and (found is None or saddle < found)):
                        nearest, found = off, saddle
        if found is None:
            return None
        a, b = self._hessians[here], self._hessians[found]
        return found if a[0] * b[0] + a[1] * b[1] + a[2] * b[2] <= -ALIKE else None


def _back(step: Step) -> Step:
    return (-step[0], -step[1])


def find_saddles(image: Image, scale: int = 1) -> SaddlePoints:
    """The clearest saddles whose surroundings are symmetric under half a turn, the strongest first.

    ``scale``: of the image made smaller for this, by averages over so many pixels in each direction.
    """
    if scale > 1:
        smaller = cv2.resize(image, None, fx=1 / scale, fy=1 / scale, interpolation=cv2.INTER_AREA)
        image = np.asarray(smaller, dtype=np.uint8)
    bands = [_saddles_between(image, top, top + _BAND) for top in range(0, image.shape[0], _BAND)]
    pixels, strength, hessians = (np.concatenate(parts) for parts in zip(*bands, strict=True))
    strongest = np.argsort(-strength, kind="stable")[:_MOST_SADDLES]
    hessians = hessians[strongest] / np.linalg.norm(hessians[strongest], axis=1, keepdims=True)
    return SaddlePoints(scale * pixels[strongest] + (scale - 1) / 2, hessians)


def _saddles_between(image: Image, top: int, bottom: int) -> tuple[Array, Array, Array]:
    """The saddles in the rows from ``top`` to before ``bottom``: pixels (n, 2), strength (n,), Hessians (n, 3)."""
    first = max(top - _BEYOND, 0)
    band = image[first : bottom + _BEYOND].astype(np.float32)
    smooth = cv2.GaussianBlur(band, (0, 0), BLUR, borderType=cv2.BORDER_REPLICATE)
    blurred = np.asarray(smooth, dtype=np.float32)
    xx, yy, xy = (cv2.Sobel(blurred, cv2.CV_32F, *order, ksize=3, scale=s) for order, s in _DERIVATIVES)
    strength = cv2.subtract(cv2.multiply(xy, xy), cv2.multiply(xx, yy))
    size = 2 * int(LEAST_STEP / 2) + 1
    peak = strength >= cv2.dilate(strength, np.ones((size, size), np.uint8))
    peak &= strength > _LEAST_CURVATURE**2
    edge = int(np.ceil(_RING)) + 1
    peak[: max(top, edge) - first], peak[max(min(bottom, image.shape[0] - edge) - first, 0) :] = False, False
    peak[:, :edge], peak[:, -edge:] = False, False
    v, u = np.divmod(np.flatnonzero(peak), peak.shape[1])  # np.nonzero takes ten times as long
    symmetric = _symmetry(blurred, u, v) > _SYMMETRY
    u, v = u[symmetric], v[symmetric]
    hessians = np.stack([xx[v, u], np.sqrt(2) * xy[v, u], yy[v, u]], axis=1)
    return np.stack([u, v + first], axis=1).astype(float), strength[v, u].astype(float), hessians.astype(float)


def find_lattices(saddles: SaddlePoints, least: int, narrowest: float = math.inf) -> list[Array]:
    """Lattices (rows, columns, 2) px of ``least`` corners or more among the saddles, NaN where one is missing.

    Most corners first. Rows and columns may run in any direction. Only those with a square whose shorter side is
    below ``narrowest`` px.
    """
    if len(saddles.points) < least:
        return []
    growing, free = _Growing(saddles), np.ones(len(saddles.points), dtype=bool)
    seeds, steps = _cells(saddles, least, narrowest)
    lattices = []
    while len(seeds):
        at = growing.grow(int(seeds[0]), *steps[0].tolist())
        free[list(at.values())] = False
        if len(at) >= least:
            lattices.append(_as_array(saddles, at))
        seeds, steps = seeds[free[seeds]], steps[free[seeds]]
    return sorted(lattices, key=lambda lattice: -int(np.isfinite(lattice[..., 0]).sum()))


def _symmetry(image: NDArray[np.float32], u: NDArray[np.intp], v: NDArray[np.intp]) -> Array:
    """(n,): the correlation of each ring about (u, v) with itself after half a turn."""
    ring = image[v[:, None] + _RING_Y, u[:, None] + _RING_X].astype(float)
    ring = ring - ring.mean(axis=1, keepdims=True)
    power = np.maximum(np.sum(ring**2, axis=1), 1e-6)
    return np.asarray(2 * np.sum(ring[:, :8] * ring[:, 8:], axis=1) / power)


def _cells(saddles: SaddlePoints, least: int, narrowest: float) -> tuple[NDArray[np.intp], Array]:
    """Saddles (k,) with the two steps (k, 2, 2) px to neighbours that span a square with it, smaller squares first.

    Only squares that hang together with others, with ``least`` saddles in all.
    """
    points, hessians = saddles.points, saddles.hessians
    tree = KDTree(points)
    count = min(_NEIGHBOURS + 1, len(points))
    distances, neighbours = tree.query(points, count)
    opposite = np.einsum("ni,nki->nk", hessians, hessians[neighbours]) < -ALIKE
    possible = opposite & (distances >= LEAST_STEP)
    one, other = np.triu_indices(count, 1)
    seed, pair = np.nonzero(possible[:, one] & possible[:, other])
    first, second = neighbours[seed, one[pair]], neighbours[seed, other[pair]]
    a, b = points[first] - points[seed], points[second] - points[seed]
    shorter, longer = distances[seed, one[pair]], distances[seed, other[pair]]
    fourth_off, fourth = tree.query(points[seed] + a + b)
    closes = (fourth_off < OFF * longer) & (np.einsum("ni,ni->n", hessians[seed], hessians[fourth]) > ALIKE)
    spans = np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]) > _LEAST_SINE * shorter * longer
    found = np.flatnonzero(closes & spans)
    # Most squares in clutter stand alone: only what hangs together in sufficient number is worth growing.
    group = _groups(np.stack([part[found] for part in (seed, first, second, fourth)], axis=1), len(points))
    found = found[np.bincount(group)[group[seed[found]]] >= least]
    found = found[shorter[found] < narrowest]
    found = found[np.argsort(longer[found], kind="stable")]
    return seed[found], np.stack([a[found], b[found]], axis=1)


def _groups(squares: NDArray[np.intp], count: int) -> NDArray[np.intp]:
    """(count,): for each corner the least that hangs together with it by ``squares`` (m, 4) that share corners."""
    group = np.arange(count)
    while True:
        least = group.copy()
        np.minimum.at(least, squares, group[squares].min(axis=1, keepdims=True))
        least = least[least]  # what is least for one's least is so for oneself: few rounds, however long the chain
        if np.array_equal(least, group):
            return group
        group = least


def _as_array(saddles: SaddlePoints, at: dict[Place, int]) -> Array:
    """(rows, columns, 2) px, NaN where no corner was seen."""
    places = np.array(list(at))
    places -= places.min(axis=0)
    lattice = np.full((*(places.max(axis=0) + 1), 2), np.nan)
    lattice[places[:, 0], places[:, 1]] = saddles.points[list(at.values())]
    return lattice
