"""Faces that hide their foot: whatever lies lowest in their tile is no ground.

What stands before a wall hides its foot, and far away the rings of the sensor miss the
strip of ground in its tile. The lowest return of the tile is the wall's then.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from gp_ground_seg.frame import Candidates, FloatArray, IntArray
from gp_ground_seg.jit import compiled
from gp_ground_seg.parameters.config import FacesConfig

BoolArray = npt.NDArray[np.bool_]


def hides_foot(
    tile: npt.NDArray[np.int64],
    xyz: FloatArray,
    above_foot: FloatArray,
    n_tiles: int,
    faces: FacesConfig,
) -> npt.NDArray[np.bool_]:
    """Tell the faces whose lowest returns are no ground before them but their own.

    Ground would lie off the plane that the returns above make, and all at one height;
    what is in the plane and no denser than above is the face.

    Parameters
    ----------
    tile : (P,) int64
        Tile of each return.
    xyz : (P, 3) float64
        Returns, relative to any point of their tile [m].
    above_foot : (P,) float64
        Height above the lowest return of the tile [m].
    n_tiles : int
        Number of tiles T.
    faces : FacesConfig
        What counts as the face's own.

    Returns
    -------
    (T,) bool
        False where fewer than two returns are higher than the tolerance.
    """

    def total(values: FloatArray, chosen: npt.NDArray[np.bool_]) -> FloatArray:
        return np.bincount(tile[chosen], values[chosen], minlength=n_tiles).astype(np.float64)

    low = above_foot <= faces.tolerance
    n_low, n_high = (np.bincount(tile[part], minlength=n_tiles) for part in (low, ~low))
    number = np.maximum(n_high, 1)
    x = xyz[:, 0] - (total(xyz[:, 0], ~low) / number)[tile]
    y = xyz[:, 1] - (total(xyz[:, 1], ~low) / number)[tile]
    along, across = total(x * x - y * y, ~low), 2.0 * total(x * y, ~low)
    own_along, own_across = total(x * x - y * y, low), 2.0 * total(x * y, low)
    # Mean square along the direction in which the returns above scatter least.
    size = np.hypot(along, across)
    turned = (own_along * along + own_across * across) / np.where(size > 0.0, size, 1.0)
    square = 0.5 * (total(x * x + y * y, low) - turned)
    top = np.zeros(n_tiles)
    np.maximum.at(top, tile, above_foot)
    is_in_plane = square <= n_low * faces.max_foot_distance**2
    usual = n_high * faces.tolerance
    is_sparse = n_low * (top - faces.tolerance) <= faces.max_foot_density * usual
    result: npt.NDArray[np.bool_] = is_in_plane & is_sparse & (n_high >= 2)
    return result & (faces.max_foot_distance > 0.0)


def without_hidden_feet(candidates: Candidates, is_footless: BoolArray) -> Candidates:
    """Leave out the candidates whose tile shows no ground.

    Parameters
    ----------
    candidates : Candidates
        Ground candidates.
    is_footless : (T,) bool
        Tiles whose face hides its foot.
    """
    return candidates.where(~is_footless[candidates.tile])


@compiled
def keep_compiled(
    is_footless: npt.NDArray[np.bool_],
    r: FloatArray,
    z: FloatArray,
    own_bin: IntArray,
    density: FloatArray,
    offsets: IntArray,
    tile: npt.NDArray[np.int32],
) -> tuple[FloatArray, FloatArray, IntArray, FloatArray, IntArray, npt.NDArray[np.int32]]:
    """Do what `without_hidden_feet` does, from and to the fields of `Candidates`."""
    kept_r, kept_z, kept_density = np.empty(len(r)), np.empty(len(r)), np.empty(len(r))
    kept_bin, kept_tile = np.empty(len(r), np.int64), np.empty(len(r), np.int32)
    kept_offsets = np.empty(len(offsets), np.int64)
    n = 0
    kept_offsets[0] = 0
    for m in range(len(offsets) - 1):
        for c in range(offsets[m], offsets[m + 1]):
            if is_footless[tile[c]]:
                continue
            kept_r[n], kept_z[n], kept_density[n] = r[c], z[c], density[c]
            kept_bin[n], kept_tile[n] = own_bin[c], tile[c]
            n += 1
        kept_offsets[m + 1] = n
    return (kept_r[:n], kept_z[:n], kept_bin[:n], kept_density[:n], kept_offsets, kept_tile[:n])


@compiled
def hides_foot_compiled(
    low: FloatArray,
    high: FloatArray,
    top: float,
    tolerance: float,
    max_foot_distance: float,
    max_foot_density: float,
) -> bool:
    """Do what `hides_foot` does, from the sums of one tile.

    Number, x, y, z, x^2, y^2, z^2, x y, x z and y z of its lowest returns, and of those
    above; height of the highest.
    """
    n_low, n_high = low[0], high[0]
    if max_foot_distance <= 0.0 or n_high < 2.0:
        return False
    if n_low * (top - tolerance) > max_foot_density * n_high * tolerance:
        return False
    mean_x, mean_y = high[1] / n_high, high[2] / n_high
    xx = high[4] - n_high * mean_x * mean_x
    yy = high[5] - n_high * mean_y * mean_y
    xy = high[7] - n_high * mean_x * mean_y
    own_xx = low[4] - 2.0 * mean_x * low[1] + n_low * mean_x * mean_x
    own_yy = low[5] - 2.0 * mean_y * low[2] + n_low * mean_y * mean_y
    own_xy = low[7] - mean_x * low[2] - mean_y * low[1] + n_low * mean_x * mean_y
    size = math.sqrt((xx - yy) ** 2 + 4.0 * xy * xy)
    turned = 0.0
    if size > 0.0:
        turned = ((own_xx - own_yy) * (xx - yy) + 4.0 * own_xy * xy) / size
    square: float = 0.5 * (own_xx + own_yy - turned)
    in_plane: bool = square <= n_low * max_foot_distance * max_foot_distance
    return in_plane
