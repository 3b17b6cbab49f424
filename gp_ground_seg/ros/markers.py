"""``~/markers``: the ground model to look at, in RViz or Foxglove.

Needs ``visualization_msgs``; importing this module fails where it is not installed.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from geometry_msgs.msg import Point
from sensor_msgs.msg import PointCloud2
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray

from gp_ground_seg.ground_model import GroundModel
from gp_ground_seg.parameters.config import Config
from gp_ground_seg.plotting.style import length_scale_colours
from gp_ground_seg.result import Segmentation

# rclpy takes some microseconds for each vertex: what is drawn is thinned to what an eye
# can tell apart, so that a viewer costs the node less than the segmentation itself.
MAX_PROFILES = 60
MAX_KNOTS = 24
N_STD = 2.0
"""Half width of the band in standard deviations."""
LINE_WIDTH = 0.04
"""[m]."""
BAND_COLOUR = (0.75, 0.75, 0.75, 0.35)


def markers(cloud: PointCloud2, segmentation: Segmentation, config: Config) -> MarkerArray:
    """Profiles of the segments of a segmented `cloud`, in its frame.

    ``profiles``: ground height over range, coloured by length-scale from
    ``length_scale.min`` (dark blue) to ``length_scale.max`` (pale yellow), grey where
    there is none. ``band``: two standard deviations about it, upright. Neither is drawn where
    the standard deviation is above ``label.ground_tolerance``: there it is a guess.
    """
    model = GroundModel.of(segmentation)
    rows, columns = _thin(len(model.height), MAX_PROFILES), _thin(len(model.knots), MAX_KNOTS)
    grid = np.ix_(rows, columns)
    points, std = model.knot_points()[grid], model.std[grid]
    known = np.isfinite(points).all(axis=-1) & (std <= config.label.ground_tolerance)
    colours = length_scale_colours(
        model.length_scale[grid], config.length_scale.min, config.length_scale.max
    )
    # Left ends of the pieces between two knots that are both known.
    left = np.flatnonzero(np.pad(known[:, :-1] & known[:, 1:], ((0, 0), (0, 1))))

    profiles = _marker(cloud, 'profiles', Marker.LINE_LIST)
    profiles.scale.x = LINE_WIDTH
    ends = np.stack([left, left + 1], axis=-1).ravel()
    _fill(profiles, points.reshape(-1, 3), ends)
    shades = _colours(colours.reshape(-1, 3))
    profiles.colors = [shades[k] for k in ends.tolist()]

    band = _marker(cloud, 'band', Marker.TRIANGLE_LIST)
    band.scale.x = band.scale.y = band.scale.z = 1.0
    band.color = ColorRGBA(**dict(zip('rgba', BAND_COLOUR, strict=True)))
    upper = points.size // 3
    corners = [left, left + 1, left + upper, left + 1, left + 1 + upper, left + upper]
    edges = [model.knot_points(sign * N_STD)[grid].reshape(-1, 3) for sign in (-1.0, 1.0)]
    both = np.concatenate(edges)
    _fill(band, both, np.stack(corners, axis=-1).ravel())
    return MarkerArray(markers=[profiles, band])


def _thin(count: int, most: int) -> npt.NDArray[np.int64]:
    """Up to `most` indices below `count`, evenly spread, the first and last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))


def _marker(cloud: PointCloud2, namespace: str, kind: int) -> Marker:
    marker = Marker(header=cloud.header, ns=namespace, id=0, type=kind, action=Marker.ADD)
    marker.pose.orientation.w = 1.0
    return marker


def _fill(marker: Marker, vertices: npt.NDArray[np.float64], index: npt.NDArray[np.int64]) -> None:
    """Give the marker its vertices; one without any is taken away, viewers warn of it."""
    if not len(index):
        marker.action = Marker.DELETE
    # A vertex that several pieces share is one object: making them takes most of the time.
    used = {}
    for k in np.unique(index).tolist():
        x, y, z = vertices[k].tolist()
        used[k] = Point(x=x, y=y, z=z)
    marker.points = [used[k] for k in index.tolist()]


def _colours(rgb: npt.NDArray[np.float64]) -> list[ColorRGBA]:
    """Message of each colour; near ones share one."""
    steps = np.rint(rgb * 50.0).astype(int)
    shared: dict[tuple[int, ...], ColorRGBA] = {}
    for key in {tuple(row) for row in steps.tolist()}:
        r, g, b = (value / 50.0 for value in key)
        shared[key] = ColorRGBA(r=r, g=g, b=b, a=1.0)
    return [shared[tuple(row)] for row in steps.tolist()]
