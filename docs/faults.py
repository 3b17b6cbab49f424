"""Draw a good result and five typical faults, for docs/right.md: ``python docs/faults.py OUT``."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from gp_ground_seg import GroundSegmenter, PointCloudError
from gp_ground_seg.core.frame import FloatArray
from gp_ground_seg.data.inputs import list_inputs
from gp_ground_seg.lab.plotting import (
    camera_at,
    draw_scan,
    label_layers,
    new_figure,
    save,
)

SCAN = Path(__file__).parent / 'scans' / 'vls128_street.npz'
CAMERA = camera_at(190.0, 26.0, 46.0)
AHEAD = np.array([12.0, 1.0, 1.0])  # brings the sensor to the middle of the picture [m]
WIDTH, HEIGHT, TITLE = 4.0, 2.0, 0.3
"""Size of a panel, and of the room for its title [inch]."""


def faults(xyz: FloatArray) -> dict[str, tuple[FloatArray, dict[str, float], float]]:
    """Cloud, parameters, and how much each panel enlarges it."""
    optical = np.stack([-xyz[:, 1], -xyz[:, 2], xyz[:, 0]], axis=1)
    return {
        'good': (xyz, {}, 1.0),
        '1 wrong height (3 m given, 2 m true)': (xyz, {'sensor_height': 3.0}, 1.0),
        '2 z not up (optical frame): refused': (optical, {}, 1.0),
        '3 vehicle frame, height of the sensor given': (
            xyz + np.array([0.0, 0.0, 2.0]),
            {'sensor_height': 2.0},
            1.0,
        ),
        '4 own body, from nearby': (xyz, {}, 4.0),
        '5 ground cut away (z above -1.5 m)': (xyz[xyz[:, 2] > -1.5], {}, 1.0),
    }


def main(path: str) -> int:
    """Segment, draw, and print the share of ground."""
    panels = faults(list_inputs(SCAN)[0].read().xyz.astype(np.float64))
    n_rows = len(panels) // 2
    size = 2 * WIDTH, n_rows * (HEIGHT + TITLE) + TITLE
    figure, said = new_figure(*size), []
    for k, (title, (xyz, parameters, zoom)) in enumerate(panels.items()):
        row, column = divmod(k, 2)
        try:
            label = GroundSegmenter(**parameters).segment(xyz).label
        except PointCloudError:
            label = np.zeros(len(xyz), dtype=np.uint8)
        layers = label_layers(label)[1]
        layers['unknown'] = label == 0
        left, top = column * WIDTH, size[1] - row * (HEIGHT + TITLE)
        place = left, top - HEIGHT - TITLE, WIDTH - 0.1, HEIGHT
        axes = figure.add_axes(tuple(np.divide(place, (*size, *size))))
        draw_scan(axes, zoom * xyz + AHEAD * (zoom > 1.0), layers, CAMERA, 0.4)
        figure.text((left + 0.05) / size[0], (top - 0.2) / size[1], title, fontsize=10)
        said.append(f'{title.split()[0]}: {100 * np.mean(label == 1):.1f} %')
    handles, names = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc='lower left', fontsize=9, frameon=False, ncols=3)
    save(figure, path)
    print(f'Share of ground: {", ".join(said)}, written to {path}')
    return 0


if __name__ == '__main__':
    sys.exit(main(sys.argv[1]))
