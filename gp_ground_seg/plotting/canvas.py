"""Figures without a display or a global state."""

from __future__ import annotations

from typing import Any

from gp_ground_seg.errors import MissingDependencyError

DPI = 120


def new_figure(width: float, height: float) -> tuple[Any, Any]:
    """Return an empty matplotlib figure [inch] and its canvas, which writes PNGs.

    Raises
    ------
    MissingDependencyError
        If matplotlib is not installed.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingDependencyError(
            "drawing needs matplotlib: pip install 'gp_ground_seg[plot]'"
        ) from error
    figure = Figure((width, height), dpi=DPI)
    return figure, FigureCanvasAgg(figure)
