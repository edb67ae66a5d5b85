"""Shared style of all figures: matplotlib without a screen, colours, and plain axes."""

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot, ticker

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Okabe and Ito's colours, distinguishable with colour vision deficiencies."""

LABEL_HEIGHT = 13.0
"""Size of a label, in pixels of the screen."""


def style(axis: pyplot.Axes) -> None:
    """Gives an axis a pale grid and no frame."""
    axis.grid(True, color="#e6e6e6", linewidth=0.8)
    axis.set_axisbelow(True)
    axis.spines[["top", "right"]].set_visible(False)


def label_plainly(axis: matplotlib.axis.Axis) -> None:
    """Labels a logarithmic axis with plain numbers."""
    axis.set_major_locator(ticker.LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(ticker.StrMethodFormatter("{x:g}"))
    axis.set_minor_formatter(ticker.NullFormatter())
