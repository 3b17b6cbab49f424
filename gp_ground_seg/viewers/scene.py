"""What every viewer shows of a segmented scan, as arrays in its level frame."""

from __future__ import annotations

import dataclasses
import itertools
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gp_ground_seg.backend import Backend
from gp_ground_seg.data.inputs import Input
from gp_ground_seg.data.semantic_kitti import read_entries
from gp_ground_seg.evaluation.metrics import GROUNDGRID, Labels, count_confusion
from gp_ground_seg.evaluation.objects import Objects, count_objects, labelled_objects
from gp_ground_seg.frame import BoolArray, FloatArray, Label
from gp_ground_seg.ground_model import GroundModel
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.plotting.scan import COLOURS, COLOURS_ABOVE, N_STD
from gp_ground_seg.plotting.style import BLUE, PINK, length_scale_colours
from gp_ground_seg.result import Segmentation

Colours = npt.NDArray[np.uint8]
CAMERA, TARGET = (-18.0, -8.0, 11.0), (9.0, 1.0, -3.0)
"""Where the camera is at first, behind and above the sensor, and what it looks at [m]."""
CLASSES = {'unknown': PINK, 'ground': COLOURS['ground'], 'obstacle': COLOURS['obstacles']}
"""Colours by `Label`."""
CHANGES = {'now ground': BLUE, 'now obstacle': '#111111'}
ERRORS = {
    name: COLOURS_ABOVE[name] for name in ('not scored', 'right', 'missed ground', 'false ground')
}
RAMPS = {'height': (-0.5, 3.0), 'p_ground': (0.0, 1.0)}
"""Ends of the ramp from dark blue to yellow: of the height over the ground [m], and of p_ground."""
CANDIDATES = {'inlier': BLUE, 'outlier': '#111111'}
_CORNERS = np.array([*itertools.product((0.0, 1.0), repeat=3)])
_EDGES = [
    list(pair)
    for pair in itertools.combinations(range(8), 2)
    if np.abs(np.subtract(*_CORNERS[list(pair)])).sum() == 1.0
]


class View(NamedTuple):
    """A scan to look at, and its truth where that is known."""

    name: str
    points: npt.NDArray[np.floating]  # (N, >=3)
    truth: Labels | None = None  # (N,) true `Label`; UNKNOWN does not count
    objects: Objects | None = None

    def scores(self, result: Segmentation) -> dict[str, float]:
        """IoU [%], objects lost, and objects; nothing where the truth is not known."""
        if self.truth is None or self.objects is None:
            return {}
        counts = count_objects(self.points, result.label, self.objects)
        found = [one for bands in counts.values() for one in bands]
        return {
            'IoU': 100.0 * count_confusion(result.label, self.truth).iou,
            'lost': sum(one.n_lost for one in found),
            'objects': sum(one.n_objects for one in found),
        }


def read_view(item: Input, labels: str | None = None) -> View:
    """Read a scan, and `labels`, a file or a folder of them, or those that SemanticKITTI has."""
    points = item.read().xyz
    folder = Path(labels) if labels else item.path.parent.with_name('labels')
    path = folder / f'{item.name}.label' if folder.is_dir() else folder
    if labels is None and not (item.path.parent.name == 'velodyne' and path.is_file()):
        return View(item.title, points)
    entries = read_entries(path, len(points))
    truth = GROUNDGRID.truth(entries & 0xFFFF, points[:, 2])
    objects = labelled_objects(points, entries, truth == Label.GROUND)
    return View(item.title, points, truth, objects)


class Mesh(NamedTuple):
    """Triangles with a colour at each corner."""

    vertices: npt.NDArray[np.float32]  # (V, 3) [m]
    triangles: npt.NDArray[np.uint32]  # (F, 3)
    colours: Colours  # (V, 3)


class Scene(NamedTuple):
    """What there is to see of a scan, in its level frame [m]."""

    points: npt.NDArray[np.float32]  # (n, 3), those that are finite
    label: Labels  # (n,)
    colours: dict[str, Colours]  # (n, 3) by class, height and p_ground, and by errors
    surface: Mesh
    band: Mesh  # two standard deviations below the surface, and above it
    faces: npt.NDArray[np.float32]  # (E, 2, 3) edges of boxes about vertical faces
    candidates: npt.NDArray[np.float32]  # (C, 3)
    is_inlier: BoolArray  # (C,)


def make_scene(view: View, result: Segmentation, config: Config, backend: Backend) -> Scene:
    """Draw a segmented scan; `backend` finds the vertical faces again."""
    finite = result.label != Label.UNKNOWN
    level = result.pose.level(view.points[:, :3])
    own = result.candidates
    azimuth = _level_model(result).azimuth[own.segment]
    candidates = np.stack([own.r * np.cos(azimuth), own.r * np.sin(azimuth), own.z], axis=1)
    colours = point_colours(result, view.truth)
    return Scene(
        level[finite].astype(np.float32),
        result.label[finite],
        {name: values[finite] for name, values in colours.items()},
        surface_mesh(result, config, 0.0),
        surface_mesh(result, config, -N_STD, N_STD),
        _face_boxes(level, config, backend).astype(np.float32),
        candidates.astype(np.float32),
        result.surface.inlier,
    )


def point_colours(result: Segmentation, truth: Labels | None = None) -> dict[str, Colours]:
    """Colours of all points, (N, 3) each, by what they show."""
    colours = {
        'class': palette(CLASSES)[result.label],
        'height': ramp('height', result.height),
        'p_ground': ramp('p_ground', result.p_ground),
    }
    if truth is not None:
        given = result.label == Label.GROUND
        kind = np.where(given == (truth == Label.GROUND), 1, np.where(given, 3, 2))
        colours['errors'] = palette(ERRORS)[np.where(truth == Label.UNKNOWN, 0, kind)]
    return colours


def change_colours(label: Labels, before: Labels) -> Colours:
    """Colours of all points, (N, 3), by class; those of `CHANGES` where the class has changed."""
    colours = palette(CLASSES)[label]
    changed = label != before
    colours[changed] = palette(CHANGES)[(label[changed] != Label.GROUND).astype(int)]
    return colours


def palette(colours: dict[str, str]) -> Colours:
    """Return the colours of a legend, (n, 3), from 0 to 255."""
    return np.array([[*bytes.fromhex(colour[1:])] for colour in colours.values()], np.uint8)


def ramp(name: str, values: npt.NDArray[np.floating]) -> Colours:
    """Colours of a quantity in `RAMPS`, (n, 3)."""
    low, high = RAMPS[name]
    # The ramp of the length-scales is even in the logarithm.
    values = np.exp(np.clip(values, low, high).astype(np.float64))
    return _bytes(length_scale_colours(values, math.exp(low), math.exp(high)))


def _bytes(colours: FloatArray) -> Colours:
    return (255.0 * colours).round().astype(np.uint8)


def _level_model(result: Segmentation) -> GroundModel:
    return dataclasses.replace(GroundModel.of(result), roll=0.0, pitch=0.0)


def surface_mesh(result: Segmentation, config: Config, *n_std: float) -> Mesh:
    """Surfaces so many standard deviations above the ground, where it is known as in `plot`."""
    model = _level_model(result)
    n_segments, n_knots = model.height.shape
    known = np.isfinite(model.height) & (model.std <= config.label.ground_tolerance)
    quad = known & np.roll(known, -1, axis=0)
    m, k = np.nonzero(quad[:, :-1] & quad[:, 1:])
    near, next_near = m * n_knots + k, (m + 1) % n_segments * n_knots + k
    one = [[near, near + 1, next_near + 1], [near, next_near + 1, next_near]]
    triangles = np.concatenate([np.stack(corners, axis=1) for corners in one])
    limits = config.length_scale
    colours = _bytes(length_scale_colours(model.length_scale, limits.min, limits.max))
    sheets = [np.nan_to_num(model.knot_points(each)).reshape(-1, 3) for each in n_std]
    return Mesh(
        np.concatenate(sheets).astype(np.float32),
        np.concatenate([triangles + i * known.size for i in range(len(n_std))]).astype(np.uint32),
        np.tile(colours.reshape(-1, 3), (len(n_std), 1)),
    )


def _face_boxes(level: npt.NDArray[np.floating], config: Config, backend: Backend) -> FloatArray:
    """Edges of boxes about the tiles with a vertical face, (E, 2, 3) [m]."""
    scan = backend.build_grid(level, config)
    tile = np.flatnonzero(backend.find_faces(scan, config).is_face)
    size, n_sides = config.faces.cell_size, math.isqrt(len(scan.tiles.extremes))
    corner = size * (np.stack(np.divmod(tile, n_sides), axis=1) - 0.5 * n_sides)
    low, high = scan.tiles.extremes[tile].astype(np.float64).T
    # What is higher overhangs, and is no part of the face.
    tall = np.minimum(high - low, config.label.obstacle_max_height)
    boxes = np.column_stack([corner, low])[:, None] + _CORNERS * np.column_stack(
        [np.full((len(tile), 2), size), tall]
    )[:, None]  # fmt: skip
    return boxes[:, _EDGES].reshape(-1, 2, 3)
