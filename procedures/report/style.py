"""What the panels of the picture have in common.

The colours remain apart for colour-blind eyes (M. Okabe and K. Ito, Color Universal Design, 2002).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.gridspec import SubplotSpec

BLUE = "#0072B2"
RED = "#D55E00"
GREEN = "#009E73"
ORANGE = "#E69F00"
GREY = "#8A8F98"
DARK = "#22262B"

TEXT = 12.0
"""Size of ordinary text, points."""


def head(axes: Axes, title: str, drawn: Axes | None = None) -> None:
    """A panel's title and, below it and outside the panel, where it can hide no data, a legend in two lines.

    drawn: where the things that the legend names are, if not in ``axes``.
    """
    axes.set_title(title, loc="left", fontsize=TEXT + 3, weight="bold", color=DARK, pad=46)
    handles, labels = (drawn or axes).get_legend_handles_labels()
    axes.legend(
        handles,
        labels,
        loc="lower left",
        bbox_to_anchor=(0.0, 1.0),
        ncols=(len(labels) + 1) // 2,
        frameon=False,
        fontsize=TEXT - 0.5,
        borderpad=0.2,
        borderaxespad=0.1,
        columnspacing=1.4,
        handletextpad=0.5,
    )


def label(axes: Axes, x: str, y: str) -> None:
    """Names for both directions, with units."""
    # A dollar sign in a name begins no formula.
    axes.set_xlabel(x, fontsize=TEXT, parse_math=False)
    axes.set_ylabel(y, fontsize=TEXT)
    axes.tick_params(labelsize=TEXT - 1)


def host(figure: Figure, place: SubplotSpec) -> Axes:
    """An empty panel: its head stands above what is drawn at the same place."""
    axes = figure.add_subplot(place)
    axes.set_axis_off()
    return axes
