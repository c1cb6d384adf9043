"""Colours that remain apart for colour-blind eyes (M. Okabe and K. Ito, Color Universal Design, 2002)."""

BLUE = "#0072B2"
RED = "#D55E00"
GREEN = "#009E73"
ORANGE = "#E69F00"
GREY = "#8A8F98"
DARK = "#22262B"
