"""Shared by the pictures: figures without a display, colours, checks of the input."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from gp_ground_seg.core.errors import require
from gp_ground_seg.data.atomic_output import staged_file

DPI = 120

# Okabe and Ito's palette and one violet: told apart with any colour vision.
BLUE, SKY, GREEN, ORANGE, VERMILION, VIOLET = (
    '#0072B2', '#56B4E9', '#009E73', '#E69F00', '#D55E00', '#7A4FA3',
)  # fmt: skip


def new_figure(width: float, height: float, dpi: int = DPI) -> Any:
    """Return an empty matplotlib figure [inch] outside pyplot's global state."""
    return require('matplotlib.figure', 'matplotlib').Figure((width, height), dpi=dpi)


def add_axes(figure: Any, left: float, bottom: float, size: tuple[float, float]) -> Any:
    """Return new axes at a place from the lower left corner, width and height `size` [inch].

    matplotlib's own layouts leave no room for a legend below equal axes.
    """
    width, height = figure.get_size_inches()
    return figure.add_axes((left / width, bottom / height, size[0] / width, size[1] / height))


def write_line(figure: Any, text: str, x: float, below_top: float, **style: Any) -> None:
    """Write a line of text at a share of the width, `below_top` inches from the upper edge."""
    y = 1.0 - below_top / figure.get_size_inches()[1]
    figure.text(x, y, text, **{'ha': 'center', 'va': 'center', 'parse_math': False, **style})


def legend_dots(colours: Mapping[str, str], size: float) -> list[Any]:
    """Return legend entries; dots as small as in the picture would show no colour."""
    from matplotlib.lines import Line2D

    return [
        Line2D([], [], marker='o', markersize=size, color=colour, linestyle='none', label=name)
        for name, colour in colours.items()
    ]


def save(figure: Any, path: str | Path) -> None:
    """Write a figure as PDF or SVG where `path` ends so, else as PNG, replacing the file."""
    from matplotlib import rc_context

    kind = {'.pdf': 'pdf', '.svg': 'svg'}.get(Path(path).suffix.lower(), 'png')
    # With their dates, and names by chance, no two files would be equal.
    metadata = {'pdf': {'CreationDate': None}, 'svg': {'Date': None}}.get(kind, {})
    with staged_file(path, force=True) as part, rc_context({'svg.hashsalt': 'gp_ground_seg'}):
        figure.savefig(part, format=kind, metadata=metadata)
