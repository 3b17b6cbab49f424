"""The stages of the paper as loops that read like it: slow oracles of both backends.

Shapes and units are those of `gp_ground_seg.core.backend.NumpyBackend`. One point, one cell or one
line at a time; each fit is made anew. Rules that are ours have no oracle: the two backends are
compared with each other, and tests have cases of each rule.
"""

import math

import numpy as np

from gp_ground_seg.core.frame import Candidates, Lines, PseudoInputs

# Polar grid (section II)


def place_of(x, y, grid):
    """Bin of a point, or None beyond the grid, and its azimuth in segments, 0 to M."""
    r = math.sqrt(x * x + y * y)
    steps = np.arange(grid.n_bins + 1) / grid.n_bins
    edges = grid.r_min + (grid.r_max - grid.r_min) * steps**grid.bin_growth
    # The origin counts as lying on +x, also where its x is -0.
    angle = math.atan2(y, x) if x != 0.0 or y != 0.0 else 0.0
    turn = (angle / (2.0 * math.pi) + 0.5) * grid.n_segments
    if not r < edges[-1]:
        return None, turn
    return next(n for n in range(grid.n_bins) if r < edges[n + 1]), turn


def lowest_of_cells(scan, config):
    """Lowest point of each cell; of equally low ones the nearest, then the first by place.

    The density is the mean over three slices of equal height of points over area.
    """
    members = {}
    for i in np.flatnonzero(scan.grid.cell >= 0):
        members.setdefault(int(scan.grid.cell[i]), []).append(i)
    rows, counts = [], np.zeros(scan.grid.n_segments, dtype=np.int64)
    for cell, own in sorted(members.items()):
        z = scan.xyz[own, 2].astype(np.float64)
        x, y = scan.xyz[own, 0], scan.xyz[own, 1]
        low, r, x, y, tile = min(zip(z, scan.grid.r[own], x, y, scan.tiles.tile[own], strict=True))
        segment, n = divmod(cell, scan.grid.n_bins)
        extent = max(max(z) - low, config.lines.min_density_extent)
        number = np.bincount(np.minimum((z - low) / extent * 3, 2).astype(int), minlength=3)
        area = np.diff(scan.grid.edges)[n] * extent / 3
        rows.append((r, low, n, np.mean(number / area), tile, x, y))
        counts[segment] += 1
    r, z, own_bin, density, tile, x, y = np.array(rows, dtype=np.float64).reshape(-1, 7).T
    offsets = np.concatenate([[0], np.cumsum(counts)])
    return Candidates(
        r, z, own_bin.astype(np.int64), density, offsets, tile.astype(np.int32), x, y
    )


# Lines and pseudo-inputs (sections III-C, III-D, Algorithm 1)


def fit_line(r, z, error_ratio):
    """Slope of the line of least distance, and the middle of the points, by SVD."""
    if len(r) == 1:
        return math.nan, r[0], z[0]
    scale = math.sqrt(error_ratio)
    centred = np.column_stack([r - r.mean(), (z - z.mean()) / scale])
    direction = np.linalg.svd(centred, full_matrices=False)[2][0]
    return scale * direction[1] / direction[0], r.mean(), z.mean()


def extract_lines(candidates, lines):
    """Lines between critical points."""
    r, z, density = candidates.r, candidates.z, candidates.density
    ids, slopes, starts = [], [], [0]
    for m in range(len(candidates.offsets) - 1):
        start, end = candidates.offsets[m], candidates.offsets[m + 1]
        while start < end:
            stop = start + 1
            while stop < end and not _is_critical(start, stop, r, z, density, lines):
                stop += 1
            ids += [len(slopes)] * (stop - start)
            slopes.append(fit_line(r[start:stop], z[start:stop], lines.error_ratio)[0])
            starts.append(stop)
            start = stop
    return Lines(np.array(ids, np.int64), np.array(slopes), np.array(starts, np.int64))


def _is_critical(start, new, r, z, density, lines):
    """Whether candidate `new` ends the line from `start`."""
    if r[new] - r[new - 1] > lines.max_gap + lines.max_gap_growth * r[new]:
        return True
    ratio = density[new] / density[new - 1]
    if max(ratio, 1.0 / ratio) > lines.max_density_ratio:
        return True
    if new - start == 1:
        return False
    old, old_r, old_z = fit_line(r[start:new], z[start:new], lines.error_ratio)
    slope, mean_r, mean_z = fit_line(r[start : new + 1], z[start : new + 1], lines.error_ratio)
    before, after = old_z + old * (r[new] - old_r), mean_z + slope * (r[new] - mean_r)
    return (
        abs(math.atan(slope) - math.atan(old)) > lines.slope_tolerance
        or abs(after - before) > lines.offset_tolerance
        or abs(z[new] - before) / math.hypot(1.0, old) > lines.max_line_distance
    )


def pseudo_inputs(candidates, lines, config):
    """One pseudo-input in the middle of each of equal shares of a line's candidates."""
    r_bar, guesses, places, lines_of, kinds = [], [], [], [], []
    limits, per = config.length_scale, config.latent.candidates_per_pseudo_input
    for q in range(len(lines.slope)):
        first, stop = lines.start[q], lines.start[q + 1]
        extent = candidates.r[stop - 1] - candidates.r[first]
        number = max(round((stop - first) / per), 1)
        for k in range(number):
            place = first + int((stop - first) * (k + 0.5) / number)
            r_bar.append(candidates.r[place])
            guesses.append(math.log(min(max(extent, limits.min), limits.max)))
            places.append(place)
            lines_of.append(q)
            kinds.append(line_class(lines.slope[q], guesses[-1], limits))
    offsets = np.array([sum(p < o for p in places) for o in candidates.offsets], np.int64)
    if config.learning.length_scale == 'factor':
        kinds = [0] * len(kinds)
    else:
        edges = np.linspace(math.log(limits.min), math.log(limits.max), 7)
        guesses = [edges[2 * (kind // 3) + 1] for kind in kinds]
    lines_of, kinds = np.array(lines_of, np.int64), np.array(kinds, np.int64)
    return PseudoInputs(np.array(r_bar, float), np.array(guesses, float), offsets, lines_of, kinds)


def line_class(slope, log_extent, limits):
    """Short, middle and long lines, three times; of each those that fall, are flat, rise."""
    edges = np.linspace(math.log(limits.min), math.log(limits.max), 4)[1:3]
    rises, falls = slope > limits.flat_gradient, slope < -limits.flat_gradient
    return 3 * sum(log_extent >= edge for edge in edges) + (2 if rises else 0 if falls else 1)
