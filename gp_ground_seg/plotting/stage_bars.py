"""Where the time of a frame goes: one bar per case, in stages."""

from __future__ import annotations

from itertools import cycle
from pathlib import Path
from typing import Any

from gp_ground_seg.data.atomic_output import staged_file
from gp_ground_seg.errors import MissingDependencyError

# After Okabe and Ito's palette, in the order of the stages.
COLOURS = ('#0072B2', '#56B4E9', '#009E73', '#E69F00', '#D55E00', '#CC79A7', '#B4BAC0', '#7A4FA3')
BASELINE_COLOUR = '#3B4046'
# Inches.
WIDTH, BAR, AROUND = 10.0, 0.55, 1.9
DPI = 120


def plot_stage_bars(document: dict[str, Any], path: str | Path, *, force: bool) -> None:
    """Draw the stages of every case of a benchmark as a PNG.

    Parameters
    ----------
    document : dict
        Report of `gp_ground_seg.evaluation.benchmark`.
    path : str or Path
        File to write.
    force : bool
        Whether an existing one is replaced.

    Raises
    ------
    MissingDependencyError
        If matplotlib is not installed.
    DataError
        If the file cannot be written.
    """
    try:
        from matplotlib.backends.backend_agg import FigureCanvasAgg
        from matplotlib.figure import Figure
    except ImportError as error:
        raise MissingDependencyError(
            "drawing needs matplotlib: pip install 'gp_ground_seg[plot]'"
        ) from error

    # Without compiled code a frame takes so long that the others would be but slivers.
    cases = [case for case in document['cases'] if case['backend'] == 'numba']
    cases = cases or document['cases']
    stages = list(cases[0]['stages_ms'])
    titles = [case['name'] for case in cases]
    peer = document['baseline_ms']
    height = AROUND + BAR * len(titles)
    figure = Figure((WIDTH, height), dpi=DPI)
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_axes((0.19, 0.75 / height, 0.77, BAR * len(titles) / height))
    start = [0.0] * len(cases)
    for stage, colour in zip(stages, cycle(COLOURS)):
        width = [case['stages_ms'][stage] for case in cases]
        axes.barh(titles, width, left=start, color=colour, label=stage, height=0.72)
        start = [a + b for a, b in zip(start, width, strict=True)]
    if peer:
        axes.axvline(
            peer['median'], color=BASELINE_COLOUR, linewidth=1.5, linestyle=(0, (4, 3)),
            label=f'{document["baseline"]}, whole frame',
        )  # fmt: skip
    axes.invert_yaxis()
    axes.set_xlabel('median time per frame [ms]')
    axes.spines[['top', 'right']].set_visible(False)
    axes.tick_params(axis='y', length=0)
    axes.set_xlim(left=0.0)
    figure.legend(
        loc='upper center', ncols=len(stages) + 1, frameon=False, fontsize=9.5,
        bbox_to_anchor=(0.5, 1.0 - 0.55 / height), handlelength=1.2, columnspacing=1.2,
    )  # fmt: skip
    environment = document['environment']
    figure.text(
        0.5, 1.0 - 0.3 / height,
        f'{document["n_frames"]} frames of {document["data"]}, '
        f'{round(document["n_points"]["median"] / 1000)} 000 points each, {environment["cpu"]}',
        fontsize=11, ha='center', va='center', parse_math=False,
    )  # fmt: skip
    with staged_file(path, force=force) as part:
        canvas.print_png(str(part))
