"""What is drawn on axes, and pages without it."""

import contextlib

import numpy as np
import pytest


@contextlib.contextmanager
def no_pictures():
    """Leave pictures out of pages: drawing them takes most of the time of a page whose numbers are compared."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("miricigale.pages.page.image_of", lambda figure, dpi: ("data:,", 1))
        yield


def line_data(ax, style):
    """Points of the lines of one marker or line style, arrays of shape (n, 2)."""
    return [line.get_xydata() for line in ax.lines if style in (line.get_marker(), line.get_ls())]


def error_bars(ax):
    """Points and ends of the error bars of every group that holds some: (xy, low, high)."""
    found = []
    for bar in ax.containers:
        data, _, (bars,) = bar.lines
        ends = np.array(bars.get_segments())
        if len(ends):
            xy = None if data is None else data.get_xydata()
            found.append((xy, ends[:, 0, 1], ends[:, 1, 1]))
    return found


def legend_texts(ax):
    return [text.get_text() for text in ax.get_legend().get_texts()]
