"""Draw what a costmap marks of a hill, for README: ``python docs/hill.py hill.png``."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
from matplotlib.lines import Line2D

from gp_ground_seg import Config, GroundSegmenter
from gp_ground_seg.core.errors import in_thousands
from gp_ground_seg.core.frame import BoolArray, PointArray
from gp_ground_seg.data.costmap import SegmentedCloud
from gp_ground_seg.lab.plotting import COLOURS, new_figure, save
from gp_ground_seg.lab.simulation import HDL_64E, SCENES, simulate_scan

LOW, HIGH = 0.15, 1.5
"""Heights that a robot can hit [m]."""
CELL, REACH = 0.1, 20.0
"""Size of the cells, and how far away they are marked [m]."""
SCALE = 5.0  # length of the bar [m]
SEED = 1
SIDE = 4.2
"""Width of a map [inch]."""


def cells_of(xy: PointArray, chosen: BoolArray) -> BoolArray:
    """Cells that one of the chosen points is in, (n, n) bool, by x, y."""
    n = round(2.0 * REACH / CELL)
    near = chosen & (np.hypot(*xy.T) < REACH)
    cells = np.zeros((n, n), dtype=bool)
    cells[tuple(np.floor((xy[near] + REACH) / CELL).astype(int).T)] = True
    return cells


def draw(figure: Any, left: float, title: str, layers: dict[str, BoolArray]) -> None:
    """Draw a map from above, x to the right, `left` inches from the edge."""
    width, height = figure.get_size_inches()
    axes = figure.add_axes((left / width, 0.4 / height, SIDE / width, SIDE / height))
    for name, layer in layers.items():
        places = (np.argwhere(layer) + 0.5) * CELL - REACH
        axes.scatter(*places.T, s=0.8, linewidths=0.0, c=COLOURS[name])
    axes.plot(0.0, 0.0, '>', markersize=9, color='black')
    axes.text(0.0, -1.4, 'robot', ha='center', va='top', fontsize=9)
    axes.plot([-REACH, SCALE - REACH], [-REACH, -REACH], color='black', lw=2.0)
    axes.text(0.5 * SCALE - REACH, 0.6 - REACH, f'{SCALE:g} m', ha='center', fontsize=9)
    axes.set_axis_off()
    axes.set_aspect('equal')
    place = (left + 0.5 * SIDE) / width, 1.0 - 0.15 / height
    figure.text(*place, title, ha='center', va='center', fontsize=12)


def main(path: str) -> int:
    """Simulate, segment, count and draw."""
    scan = simulate_scan(SCENES['crest'](SEED), HDL_64E, np.random.default_rng(SEED))
    xy, up = scan.points[:, :2], scan.points[:, 2] + HDL_64E.height
    config = Config().replace(**{'output.min_height': LOW, 'output.max_height': HIGH})
    result = GroundSegmenter(config).segment(scan.points)
    chosen = {
        f'raw cloud, {LOW:g} to {HIGH:g} m up': (up >= LOW) & (up <= HIGH),
        'obstacles of gp_ground_seg': SegmentedCloud(None, result, config).is_obstacle,
    }
    objects = cells_of(xy, ~scan.is_ground)
    ground = cells_of(xy, scan.is_ground) & ~objects
    figure, said = new_figure(2.0 * SIDE + 0.2, SIDE + 0.7), []
    for k, (title, points) in enumerate(chosen.items()):
        marked = cells_of(xy, points)
        layers = {'ground': ground & ~marked, 'obstacle': objects & marked}
        layers['false ground'] = ground & marked
        draw(figure, k * (SIDE + 0.2), title, layers)
        numbers = [in_thousands(layers[name].sum()) for name in ('false ground', 'obstacle')]
        said.append(f'marks {numbers[0]} of ground, {numbers[1]} of objects')
    names = {'ground': 'ground', 'object, marked': 'obstacle', 'ground, marked': 'false ground'}
    dots = [
        Line2D(
            [], [], marker='o', markersize=7, color=COLOURS[name], linestyle='none', label=shown
        )
        for shown, name in names.items()
    ]
    figure.legend(handles=dots, loc='lower center', fontsize=11, frameon=False, ncols=3)
    save(figure, path)
    n_ground, n_objects = (in_thousands(cells.sum()) for cells in (ground, objects))
    print(
        f'{n_ground} cells of ground, {n_objects} of objects: the raw cloud {said[0]}; '
        f'gp_ground_seg {said[1]}, written to {path}'
    )
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1]))
