"""Scans with their labels, and the colours of points that `tune` shows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.frame import Label
from gp_ground_seg.core.result import Segmentation
from gp_ground_seg.data.colours import COLOURS, HEIGHTS, ramp_colours
from gp_ground_seg.data.inputs import Input
from gp_ground_seg.data.semantic_kitti import read_entries
from gp_ground_seg.lab.plotting.style import GREEN
from gp_ground_seg.lab.scoring.metrics import GROUNDGRID, Labels, count_labels, label_ratios
from gp_ground_seg.lab.scoring.objects import Objects, count_objects, labelled_objects

Colours = npt.NDArray[np.uint8]
BLACK = '#111111'
LEGENDS = {
    'class': {name: COLOURS[name] for name in ('unknown', 'ground', 'obstacle')},
    'changes': {'now ground': GREEN, 'now obstacle': BLACK},
    'errors': {
        name: COLOURS[name] for name in ('not scored', 'right', 'missed ground', 'false ground')
    },
}
RAMPS = {'height': HEIGHTS, 'p_ground': (0.0, 1.0)}
"""Ends of the ramp from dark blue to yellow of the height over the ground [m], and of p_ground."""


class View(NamedTuple):
    """A scan to look at, with its true labels and objects where they are known."""

    points: npt.NDArray[np.floating]  # (N, >=3)
    truth: Labels | None = None  # (N,) true `Label`; UNKNOWN does not count
    objects: Objects | None = None

    def scores(self, label: Labels) -> dict[str, float]:
        """Return IoU [%], objects lost and objects; nothing where the truth is not known."""
        if self.truth is None or self.objects is None:
            return {}
        rows = count_objects(self.points, label, self.objects)
        n_lost, n_objects = (sum(row[name] for row in rows) for name in ('n_lost', 'n_objects'))
        iou = 100.0 * label_ratios(count_labels(label, self.truth))['iou']
        return {'IoU': iou, 'lost': n_lost, 'objects': n_objects}


def read_view(item: Input, labels: str | None = None) -> View:
    """Read a scan, and its labels: a file, or what SemanticKITTI has beside the scan."""
    points, path = item.read().xyz, labels
    beside = item.path.parent.parent / 'labels' / f'{item.name}.label'
    if path is None and item.path.parent.name == 'velodyne' and beside.exists():
        path = str(beside)
    if path is None:
        return View(points)
    entries = read_entries(path, len(points))
    truth = GROUNDGRID.truth(entries & 0xFFFF, points[:, 2])
    objects = labelled_objects(points, entries, truth == Label.GROUND)
    return View(points, truth, objects)


def point_colours(name: str, result: Segmentation, other: Labels | None = None) -> Colours:
    """Colours of all points, (N, 3), by `name`.

    It is ``class`` or of `RAMPS`; ``errors`` against `other`, the truth; or ``changes``: the
    class, and where it differs from `other`, what it is now.
    """
    is_ground = result.label == Label.GROUND
    if name in RAMPS:
        shares = ramp_colours(getattr(result, name), *RAMPS[name])
        return np.asarray((255.0 * shares).round(), dtype=np.uint8)
    if name == 'errors' and other is not None:
        kind = np.where(is_ground == (other == Label.GROUND), 1, np.where(is_ground, 3, 2))
        kind[other == Label.UNKNOWN] = 0
        return palette(name)[kind]
    colours = palette('class')[result.label]
    if name == 'changes' and other is not None:
        changed = result.label != other
        colours[changed] = palette(name)[np.where(is_ground[changed], 0, 1)]
    return colours


def palette(name: str) -> Colours:
    """Return the colours of a legend, (n, 3)."""
    colours = [[*bytes.fromhex(colour[1:])] for colour in LEGENDS[name].values()]
    return np.array(colours, dtype=np.uint8)
