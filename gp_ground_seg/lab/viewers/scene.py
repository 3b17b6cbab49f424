"""Points, surface and colours that the viewers show, as arrays in the level frame of a scan."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from gp_ground_seg.core.backend import Backend
from gp_ground_seg.core.frame import OUTSIDE, FloatArray, Label
from gp_ground_seg.core.ground_model import GroundModel
from gp_ground_seg.core.parameters.config import Config
from gp_ground_seg.core.result import Segmentation
from gp_ground_seg.data.colours import COLOURS, length_scale_colours, ramp_colours
from gp_ground_seg.data.inputs import Input
from gp_ground_seg.data.semantic_kitti import read_entries
from gp_ground_seg.lab.plotting.scan import N_STD, VALUES
from gp_ground_seg.lab.plotting.style import GREEN, VIOLET
from gp_ground_seg.lab.scoring.metrics import GROUNDGRID, Labels, count_confusion
from gp_ground_seg.lab.scoring.objects import Objects, count_objects, labelled_objects

Colours = npt.NDArray[np.uint8]
BLACK = '#111111'
LEGENDS = {
    'class': {name: COLOURS[name] for name in ('unknown', 'ground', 'obstacle')},
    'changes': {'now ground': GREEN, 'now obstacle': BLACK},
    'errors': {
        name: COLOURS[name] for name in ('not scored', 'right', 'missed ground', 'false ground')
    },
    'faces': {'in a tile with a vertical face': VIOLET},
    'candidates': {'outlier': BLACK, 'inlier': GREEN},
}
RAMPS = {name: (low, high) for name, (_, low, high) in VALUES.items()}
"""Ends of the ramp from dark blue to yellow of the height over the ground [m], and of p_ground."""


class View(NamedTuple):
    """A scan to look at, with its true labels and objects where they are known."""

    title: str
    points: npt.NDArray[np.floating]  # (N, >=3)
    truth: Labels | None = None  # (N,) true `Label`; UNKNOWN does not count
    objects: Objects | None = None

    def scores(self, label: Labels) -> dict[str, float]:
        """Return IoU [%], objects lost and objects; nothing where the truth is not known."""
        if self.truth is None or self.objects is None:
            return {}
        bands = count_objects(self.points, label, self.objects).values()
        counts = [(group.n_lost, group.n_objects) for groups in bands for group in groups]
        n_lost, n_objects = np.sum([(0, 0), *counts], axis=0).tolist()
        iou = 100.0 * count_confusion(label, self.truth).iou
        return {'IoU': iou, 'lost': n_lost, 'objects': n_objects}


def read_view(item: Input, labels: str | None = None) -> View:
    """Read a scan, and its labels: a file, or what SemanticKITTI has beside the scan."""
    points, path = item.read().xyz, labels
    beside = item.path.parent.parent / 'labels' / f'{item.name}.label'
    if path is None and item.path.parent.name == 'velodyne' and beside.exists():
        path = str(beside)
    if path is None:
        return View(item.title, points)
    entries = read_entries(path, len(points))
    truth = GROUNDGRID.truth(entries & 0xFFFF, points[:, 2])
    objects = labelled_objects(points, entries, truth == Label.GROUND)
    return View(item.title, points, truth, objects)


class Cloud(NamedTuple):
    """Points with colours."""

    points: npt.NDArray[np.float32]  # (n, 3) [m]
    colours: Colours  # (n, 3)


class Mesh(NamedTuple):
    """Triangles with colours at their corners."""

    vertices: npt.NDArray[np.float32]  # (V, 3) [m]
    triangles: npt.NDArray[np.uint32]  # (F, 3)
    colours: Colours  # (V, 3)


class Scene(NamedTuple):
    """Clouds and meshes of a scan, in its level frame."""

    clouds: dict[str, Cloud]  # by name
    surface: Mesh  # coloured by length-scale
    band: Mesh  # the same, two standard deviations below the surface and above it


def make_scene(view: View, result: Segmentation, config: Config, backend: Backend) -> Scene:
    """Draw a segmented scan; `backend` finds the vertical faces again."""
    finite = result.label != Label.UNKNOWN
    level = result.pose.level(view.points[:, :3])
    drawn = level.astype(np.float32)
    names = ['class', *RAMPS, *([] if view.truth is None else ['errors'])]
    clouds = {
        name: Cloud(drawn[finite], point_colours(name, result, view.truth)[finite])
        for name in names
    }
    scan = backend.build_grid(level, config)
    faces = backend.find_faces(scan, config).is_face
    on_face = drawn[(scan.tiles.tile != OUTSIDE) & faces[np.maximum(scan.tiles.tile, 0)]]
    clouds['faces'] = Cloud(on_face, np.tile(palette('faces'), (len(on_face), 1)))
    model = dataclasses.replace(GroundModel.of(result), roll=0.0, pitch=0.0)
    found = result.candidates
    azimuth = model.azimuth[found.segment]
    places = np.stack([found.r * np.cos(azimuth), found.r * np.sin(azimuth), found.z], axis=1)
    is_inlier = result.surface.inlier.astype(np.intp)
    clouds['candidates'] = Cloud(places.astype(np.float32), palette('candidates')[is_inlier])
    return Scene(clouds, _mesh(model, config, 0.0), _mesh(model, config, -N_STD, N_STD))


def point_colours(name: str, result: Segmentation, other: Labels | None = None) -> Colours:
    """Colours of all points, (N, 3), by `name`.

    It is ``class`` or of `RAMPS`; ``errors`` against `other`, the truth; or ``changes``: the
    class, and where it differs from `other`, what it is now.
    """
    is_ground = result.label == Label.GROUND
    if name in RAMPS:
        return _bytes(ramp_colours(getattr(result, name), *RAMPS[name]))
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


def _bytes(colours: FloatArray) -> Colours:
    result: Colours = (255.0 * colours).round().astype(np.uint8)
    return result


def _mesh(model: GroundModel, config: Config, *n_std: float) -> Mesh:
    """Return surfaces that many standard deviations above the ground, where `plot` shows it."""
    n_segments, n_knots = model.height.shape
    known = np.isfinite(model.height) & (model.std <= config.label.ground_tolerance)
    quad = known & np.roll(known, -1, axis=0)
    m, k = np.nonzero(quad[:, :-1] & quad[:, 1:])
    near, beside = m * n_knots + k, (m + 1) % n_segments * n_knots + k
    halves = [[near, near + 1, beside + 1], [near, beside + 1, beside]]
    triangles = np.concatenate([np.stack(corners, axis=1) for corners in halves])
    sheets = [np.nan_to_num(model.knot_points(each)).reshape(-1, 3) for each in n_std]
    limits = config.length_scale
    colours = _bytes(length_scale_colours(model.length_scale, limits.min, limits.max))
    return Mesh(
        np.concatenate(sheets).astype(np.float32),
        np.concatenate([triangles + i * known.size for i in range(len(n_std))]).astype(np.uint32),
        np.tile(colours.reshape(-1, 3), (len(n_std), 1)),
    )
