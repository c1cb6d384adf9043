"""Checkerboards by their saddle points: each corner is one, and its neighbours are the same turned inside out.

A saddle of the blurred image has a Hessian H of negative determinant. Across a square's edge black and white change
places, so neighbouring corners have opposite H, whatever the view. From four saddles that belong to one square the
lattice grows as far as it goes. Nothing in this depends on a threshold between black and white, so it stands uneven
light, and a board partly hidden gives the part that is seen.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from dualcal_hal.camera import Image
from dualcal_hal.transforms import Array

Place = tuple[int, int]

BLUR = 1.5
"""px, sigma, before derivatives are taken."""
LEAST_STEP = 6.0
"""px between neighbouring corners, below which they merge."""
_DERIVATIVES = (((2, 0), 1 / 4), ((0, 2), 1 / 4), ((1, 1), 1 / 4))  # xx, yy, xy: orders, Sobel's scale
_RING = 4.0  # px, radius on which a saddle's surroundings are compared with their mirror image
_LEAST_CURVATURE = 0.7  # grey levels per px^2: a contrast of 5 in a sharp image, of 20 in one that is barely usable
_MOST_SADDLES = 600
_NEIGHBOURS = 12  # of a saddle, among which its neighbours in the lattice are looked for
_SYMMETRY = 0.5  # correlation of a saddle's surroundings with their mirror image; a square's outer corner has -0.3
ALIKE = 0.75
"""Cosine between the Hessians of a square's opposite corners; of its neighbouring ones it is the negative."""
OFF = 0.25
"""Of a step between corners, by which one may be off where it is expected."""
_LEAST_SINE = 0.3  # of the angle between a square's sides


@dataclass(frozen=True, eq=False)
class SaddlePoints:
    """points: (n, 2) px, good to a pixel or two; hessians: (n, 3) xx, sqrt(2) xy, yy, of unit length."""

    points: Array
    hessians: Array

    def moved(self, by: tuple[int, int]) -> SaddlePoints:
        """The same in an image of which this one is a part that begins at ``by`` px."""
        return SaddlePoints(self.points + np.array(by, dtype=float), self.hessians)


@dataclass(eq=False)
class _Growth:
    """A lattice under growth: which saddle is where, and which saddles are taken."""

    at: dict[Place, int] = field(default_factory=dict)
    taken: set[int] = field(default_factory=set)

    def put(self, place: Place, saddle: int) -> None:
        self.at[place] = saddle
        self.taken.add(saddle)


def find_saddles(image: Image, scale: int = 1) -> SaddlePoints:
    """The clearest saddles whose surroundings are symmetric under half a turn, the strongest first.

    ``scale``: of the image made smaller for this, by averages over so many pixels in each direction.
    """
    if scale > 1:
        smaller = cv2.resize(image, None, fx=1 / scale, fy=1 / scale, interpolation=cv2.INTER_AREA)
        image = np.asarray(smaller, dtype=np.uint8)
    smooth = cv2.GaussianBlur(image.astype(np.float32), (0, 0), BLUR, borderType=cv2.BORDER_REPLICATE)
    blurred = np.asarray(smooth, dtype=np.float32)
    xx, yy, xy = (cv2.Sobel(blurred, cv2.CV_32F, *order, ksize=3, scale=s) for order, s in _DERIVATIVES)
    strength = xy * xy - xx * yy
    size = 2 * int(LEAST_STEP / 2) + 1
    peak = (strength >= cv2.dilate(strength, np.ones((size, size), np.uint8))) & (strength > _LEAST_CURVATURE**2)
    edge = int(np.ceil(_RING)) + 1
    peak[:edge], peak[-edge:], peak[:, :edge], peak[:, -edge:] = False, False, False, False
    v, u = np.nonzero(peak)
    symmetric = _symmetry(blurred, u, v) > _SYMMETRY
    u, v = u[symmetric], v[symmetric]
    strongest = np.argsort(-strength[v, u], kind="stable")[:_MOST_SADDLES]
    u, v = u[strongest], v[strongest]
    hessians = np.stack([xx[v, u], np.sqrt(2) * xy[v, u], yy[v, u]], axis=1).astype(float)
    hessians /= np.linalg.norm(hessians, axis=1, keepdims=True)
    points = scale * np.stack([u, v], axis=1).astype(float) + (scale - 1) / 2
    return SaddlePoints(points, hessians)


def find_lattices(saddles: SaddlePoints, least: int) -> list[Array]:
    """Lattices (rows, columns, 2) px of ``least`` corners or more among the saddles, NaN where one is missing.

    Most corners first. Rows and columns may run in any direction.
    """
    if len(saddles.points) < least:
        return []
    free = np.ones(len(saddles.points), dtype=bool)
    lattices = []
    for seed, *steps in _cells(saddles, least):
        if free[seed]:
            grown = _grow(saddles, seed, *steps)
            free[list(grown.taken)] = False
            lattices.append(_as_array(saddles, grown))
    return sorted(lattices, key=lambda lattice: -int(np.isfinite(lattice[..., 0]).sum()))


def _symmetry(image: NDArray[np.float32], u: NDArray[np.intp], v: NDArray[np.intp]) -> Array:
    """(n,): the correlation of each ring about (u, v) with itself after half a turn."""
    angles = np.arange(16) * np.pi / 8
    x, y = (np.rint(_RING * part(angles)).astype(int) for part in (np.cos, np.sin))
    ring = image[v[:, None] + y, u[:, None] + x].astype(float)
    ring = ring - ring.mean(axis=1, keepdims=True)
    power = np.maximum(np.sum(ring**2, axis=1), 1e-6)
    return np.asarray(2 * np.sum(ring[:, :8] * ring[:, 8:], axis=1) / power)


def _cells(saddles: SaddlePoints, least: int) -> Iterator[tuple[int, Array, Array]]:
    """Saddles with the two steps (2,) px to neighbours that span a square with it, smaller squares first.

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
    corners = np.concatenate([first[found], second[found], fourth[found]])
    together = coo_array((np.ones(len(corners)), (np.tile(seed[found], 3), corners)), shape=(len(points), len(points)))
    group = connected_components(together, directed=False)[1]
    found = found[np.bincount(group)[group[seed[found]]] >= least]
    for cell in found[np.argsort(longer[found], kind="stable")]:
        yield int(seed[cell]), a[cell], b[cell]


def _grow(saddles: SaddlePoints, seed: int, right: Array, down: Array) -> _Growth:
    """All corners that follow from one another by nearly equal steps, at first those to the ``right`` and ``down``."""
    grown = _Growth()
    grown.put((0, 0), seed)
    steps = {(0, 1): right, (0, -1): -right, (1, 0): down, (-1, 0): -down}
    known = {(0, 0): steps}
    queue = deque([(0, 0)])
    while queue:
        place = queue.popleft()
        for way, step in known[place].items():
            target = (place[0] + way[0], place[1] + way[1])
            if target in grown.at:
                continue
            here = grown.at[place]
            found = _corner_at(saddles, here, step)
            if found is None or found in grown.taken:
                continue
            grown.put(target, found)
            taken = saddles.points[found] - saddles.points[here]
            known[target] = {**known[place], way: taken, (-way[0], -way[1]): -taken}
            queue.append(target)
    return grown


def _corner_at(saddles: SaddlePoints, here: int, step: Array) -> int | None:
    """The saddle one step on from ``here``, if there is one with the opposite Hessian."""
    away = saddles.points - (saddles.points[here] + step)
    off = np.einsum("ni,ni->n", away, away)
    found = int(off.argmin())
    if off[found] > OFF**2 * (step @ step) or saddles.hessians[found] @ saddles.hessians[here] > -ALIKE:
        return None
    return found


def _as_array(saddles: SaddlePoints, grown: _Growth) -> Array:
    """(rows, columns, 2) px, NaN where no corner was seen."""
    places = np.array(list(grown.at))
    places -= places.min(axis=0)
    lattice = np.full((*(places.max(axis=0) + 1), 2), np.nan)
    lattice[places[:, 0], places[:, 1]] = saddles.points[list(grown.at.values())]
    return lattice
