"""The stages as loops that read like the paper: slow oracles of both backends.

Shapes and units are those of `gp_ground_seg.core.backend.Backend`, which `Reference` implements.
One point, one tile or one segment at a time; each fit is made anew.
"""

import math

import numpy as np
from reference_gp import estimate_surface, log_likelihood
from reference_relief import find_relief

from gp_ground_seg.core.backend import NumpyBackend
from gp_ground_seg.core.frame import (
    NOT_FINITE,
    Candidates,
    Faces,
    Label,
    Labelled,
    Lines,
    PseudoInputs,
)
from gp_ground_seg.core.pipeline.relief import Relief

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
    """Lowest point of each cell; of equally low ones the nearest, first by tile, then by place.

    The density is the mean over three slices of equal height of points over area.
    """
    members = {}
    for i in np.flatnonzero(scan.grid.cell >= 0):
        members.setdefault(int(scan.grid.cell[i]), []).append(i)
    rows, counts = [], np.zeros(scan.grid.n_segments, dtype=np.int64)
    for cell, own in sorted(members.items()):
        z = scan.xyz[own, 2].astype(np.float64)
        x, y = scan.xyz[own, 0], scan.xyz[own, 1]
        low, r, tile, x, y = min(zip(z, scan.grid.r[own], scan.tiles.tile[own], x, y, strict=True))
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


# Vertical faces


def find_faces(scan, height, config):
    """Tall tiles whose returns have a level normal; of those, faces down to the lowest return.

    And raised tiles among which many scatter.
    """
    faces, label = config.faces, config.label
    limit, least = label.obstacle_max_height, label.obstacle_min_height + label.ground_tolerance
    result, place, scatter, owned = Faces.none(scan.tiles), scan.tiles.place, {}, []
    for t in np.unique(scan.tiles.tile[scan.tiles.tile >= 0]):
        own = scan.xyz[scan.tiles.tile == t].astype(np.float64)
        above = own[:, 2] - own[:, 2].min()
        own, above = own[above <= limit], above[above <= limit]
        if len(own) < 4:
            continue
        value, vector = np.linalg.eigh(np.cov(own.T, ddof=0))
        lowest, highest = (float(z) + height for z in scan.tiles.extremes[t])
        minors = value[0] * value[1] + value[0] * value[2] + value[1] * value[2]
        if minors > 0.05**2 * value.sum():
            spread = math.sqrt(max(value.prod(), 0.0) / minors)
            if lowest > 0.5 * least:
                scatter[t] = spread
            elif lowest > -0.5 * least and highest - lowest <= least and not place[t] % 2:
                owned.append(level_of(4.0 * spread))
        if above.max() <= least:
            continue
        # Each eigenvector is a normal with the product of the other two eigenvalues.
        weight = np.array([value[1] * value[2], value[0] * value[2], value[0] * value[1]])
        weight = np.maximum(weight, 0.0)
        is_wide = weight.sum() > 1e-9 * value.sum() ** 2
        square = (weight * vector[2] ** 2).sum() / weight.sum() if is_wide else 1.0
        result.is_face[t] = math.sqrt(square) < faces.max_normal_z
        result.has_occluded_base[t] = result.is_face[t] and _is_occluded(own, above, config)
    level = {t: level_of(4.0 * x) for t, x in scatter.items() if not result.is_face[t]}
    own = LEVELS[sorted(owned)[int(0.75 * (len(owned) - 1))] if owned else 0]
    for t in level:
        about = LEVELS[level_about(scan.tiles, level, t, 4, 0.75, 4 * [0])] / 4.0
        if scan.tiles.extremes[t, 0] + height > least and about > max(0.025, 1.125 * own):
            result.is_face[t] = result.has_occluded_base[t] = True
    before, c = {}, scan.candidates
    for r, z, m, t in zip(c.r, c.z, c.segment, c.tile, strict=True):
        if r - before.get(m, 0.0) > 1.0 + 0.4 * r and z + height < -least:
            result.has_occluded_base[t] = result.is_face[t]
        before[m] = r
    return result


def _is_occluded(own, above, config):
    faces, foot_height = config.faces, config.label.ground_tolerance
    low, high = own[above <= foot_height, :2], own[above > foot_height, :2]
    if len(high) < 2 or faces.max_foot_distance <= 0.0:
        return False
    # The direction in which the returns above scatter least, across the face.
    across = np.linalg.eigh(np.cov(high.T))[1][:, 0]
    distance = (low - high.mean(axis=0)) @ across
    return len(low) == 0 or np.mean(distance**2) <= faces.max_foot_distance**2


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


def continues_line(candidates, lines, config):
    """Candidates of lines that are long and flat, or start at a slope break."""
    r, z, result = candidates.r, candidates.z, np.zeros(len(lines.line), bool)
    growth, tolerance = config.growth, config.lines.offset_tolerance
    for q, slope in enumerate(lines.slope):
        first, stop = lines.start[q], lines.start[q + 1]
        if not abs(slope) <= growth.max_line_slope:
            continue
        result[first + 1 : stop] = stop - first >= growth.min_line_size
        is_long = stop - first >= 3 and r[stop - 1] - r[first] >= growth.min_bend_extent
        if not is_long or first in candidates.offsets:
            continue
        before = lines.slope[q - 1] if abs(lines.slope[q - 1]) <= growth.max_line_slope else 0.0
        own = slice(first, stop)
        over_last = z[own].mean() + slope * (r[first - 1] - r[own].mean()) - z[first - 1]
        over_first = z[first] - z[first - 1] - before * (r[first] - r[first - 1])
        # The two lines intersect in the gap between them, up to the tolerance.
        signs = (over_last, over_first), (-over_last, -over_first)
        result[own] |= any(a <= tolerance and b >= -tolerance for a, b in signs)
    return result


# Labels (Algorithm 2, line 14)


def label_points(scan, faces, surface, relief, sensor_height, config):
    """Label each point by its height over the surface, against the band of its tile."""
    grid, label, n_points = scan.grid, config.label, len(scan.xyz)
    height, margin = np.full((2, n_points), np.nan)
    result = np.full(n_points, Label.OBSTACLE, np.uint8)
    result[grid.cell == NOT_FINITE] = Label.UNKNOWN
    is_face, is_occluded = (mask[scan.tiles.tile] & grid.inside for mask in faces)
    for i in np.flatnonzero(grid.inside):
        m, n = grid.segment[i], grid.bin[i]
        r, ends = max(float(grid.r[i]), grid.edges[0]), slice(n, n + 2)
        lift = relief.at(*scan.xyz[i : i + 1, :2].astype(np.float64).T)[0]
        height[i] = scan.xyz[i, 2] - lift
        height[i] -= np.interp(r, surface.knots[ends], surface.mean[m, ends])
    near = grid.inside & (height < 0.5) & (height >= -0.5)
    rough = ground_roughness(scan.tiles, height, near & ~is_face)
    for i in np.flatnonzero(grid.inside):
        by_roughness = label.rule == 'roughness'
        roughness = rough.get(scan.tiles.tile[i], 0.0) if by_roughness else 0.0
        band, depth = label.ground_tolerance, label.ground_tolerance
        if label.rule == 'roughness':
            band = max(min(2.1 * roughness, 0.5), band)
            depth = min(sensor_height, 1.0) * label.obstacle_max_height
        margin[i] = min(band - height[i], height[i] + depth)
        if is_face[i]:
            limit = max(0.5 * label.ground_tolerance, min(2.1 * roughness, 0.05))
            limit *= -1.0 if is_occluded[i] else 1.0
            lowest = float(scan.tiles.lowest_z[scan.tiles.tile[i]])
            margin[i] = min(margin[i], limit - (float(scan.xyz[i, 2]) - lowest))
    if label.rule == 'roughness':
        margin = settle(scan, surface, margin, near, label)
    result[margin >= 0.0] = Label.GROUND
    return Labelled(result, height, margin)


def ground_roughness(tiles, height, counted):
    """Roughness about each tile, by those in the windows about it with returns that count."""
    level = {
        tile: level_of(math.sqrt(np.mean(height[counted & (tiles.tile == tile)] ** 2)))
        for tile in np.unique(tiles.tile[counted])
    }
    if not level:
        return {}
    median = sorted(level.values())[(len(level) - 1) // 2]
    return {
        tile: min(
            LEVELS[level_about(tiles, level, tile, 2, 0.8, 4 * [median])],
            3.4 * LEVELS[level_about(tiles, level, tile, 4, 0.5, 16 * [median])],
        )
        for tile in range(len(tiles.place))
    }


EDGES = [0.01 * 1.14**k for k in range(31)]
LEVELS = [0.01, *(edge * math.sqrt(1.14) for edge in EDGES)]
"""Levels are 14 % apart, and as rough as the middle of theirs."""


def level_of(rms):
    return sum(rms >= edge for edge in EDGES)


def level_about(tiles, level, tile, size, share, prior):
    """Level that a share of the tiles in 3 x 3 blocks, and the prior, does not exceed."""
    side = math.isqrt(len(tiles.at))
    block = [place // size for place in divmod(int(tiles.place[tile]), side)]
    beside = [
        found
        for other, found in level.items()
        if all(
            abs(place // size - own) <= 1
            for place, own in zip(divmod(int(tiles.place[other]), side), block, strict=True)
        )
    ]
    ranked = sorted([*beside, *prior])
    return ranked[int(share * (len(ranked) - 1))]


def settle(scan, surface, margin, near, label):
    """Margins by the mean vote about each return near the surface."""
    tolerance, side = label.ground_tolerance, math.isqrt(len(scan.tiles.at))
    members, obstacles = {}, set()
    for i in np.flatnonzero(near):
        tile = divmod(int(scan.tiles.place[scan.tiles.tile[i]]), side)
        over_lowest = float(scan.xyz[i, 2]) - np.nanmin(surface.mean)
        # The nearest of four layers to the tolerance; after 64 they are counted from 0 again.
        layer = math.floor(4.0 / tolerance * over_lowest + 0.5) % 64
        members.setdefault(tile, []).append((i, layer))
        if margin[i] < 0.0:
            obstacles.add(tile)
    # Votes have 4096 steps to the tolerance.
    vote = np.floor(4096 * np.clip(margin / tolerance, -1.0, 1.0) + 0.5) / 4096 * tolerance
    settled = margin.copy()
    for x, y in obstacles:
        beside = [(x + j, y + k) for j in (-1, 0, 1) for k in (-1, 0, 1)]
        about = [one for tile in beside for one in members.get(tile, [])]
        for i, layer in members[x, y]:
            near_it = [j for j, other in about if (other - layer) % 64 in (63, 0, 1)]
            mean = np.mean(vote[near_it])
            settled[i] = max(margin[i], mean) if mean >= 0.0 else min(margin[i], mean)
    return settled


# The surface corrected by the returns called ground


def correct_surface(surface, labelled, grid, noise_std, slope_std, takes_first=True):
    """Correction, standard deviation of the ground and of its returns, at each knot."""
    n_segments, n_knots = surface.mean.shape
    ground = np.flatnonzero(labelled.label == Label.GROUND)
    cells = {}
    for i in ground:
        cells.setdefault((grid.segment[i], grid.bin[i]), []).append(labelled.height[i])
    result, noises = np.full((3, n_segments, n_knots), np.nan), {}
    seen = []
    for m, k in np.ndindex(n_segments, n_knots):
        if np.isnan(surface.mean[m, k]) or not {(m, k - 1), (m, k)} & set(cells):
            continue
        beside = [(m + j) % n_segments for j in (-1, 0, 1)]
        own = [cells[s, n] for n in (k - 1, k) for s in beside if (s, n) in cells]
        heights = np.concatenate(own)
        means = np.concatenate([np.full(len(one), np.mean(one)) for one in own])
        between, whole = np.var(means), np.var(heights)
        ground, noise = _ground_variance(own, between, whole), whole - between
        if len(own) == 1:
            ground, noise = surface.std[m, k] ** 2, noise_std**2
            whole = ground + noise
        result[:, m, k] = heights.mean(), ground, max(whole, ground)
        noises[m, k] = noise
        seen.append((m, k))
    for m, k in np.ndindex(n_segments, n_knots):
        if np.isnan(surface.mean[m, k]) or (m, k) in seen:
            continue
        own = surface.std[m, k] ** 2
        if not seen:
            result[:, m, k] = 0.0, own, own + noise_std**2
            continue
        # Of several that are equally far the first or the last one.
        far = [round(_between_knots(surface.knots, (m, k), at, n_segments), 9) for at in seen]
        apart = min(far)
        equal = [at for at, its in zip(seen, far, strict=True) if its == apart]
        s, j = equal[0 if takes_first else -1]
        mean, ground, _ = result[:, s, j]
        near = ground + (slope_std * apart) ** 2
        heights = np.array([surface.mean[m, k] + mean, surface.mean[s, j] + mean])
        share = np.array([near, own]) / (near + own)
        fused = share @ heights
        spread = share @ (heights - fused) ** 2
        variance = max(ground, own) + (slope_std * apart) ** 2 + spread
        result[:, m, k] = fused - surface.mean[m, k], variance, variance + noises[s, j]
    return result[0], np.sqrt(result[1]), np.sqrt(result[2])


def _ground_variance(cells, between, whole):
    """Variance of the ground, without bias, from that between the means of its cells."""
    numbers = np.array([len(one) for one in cells])
    n = numbers.sum()
    effective, noise = n**2 / np.sum(numbers**2), (whole - between) / n
    own = max(between - (len(cells) - 1) * noise, 0.0)
    return (effective * own + 0.05 * whole) / (effective - 1 + 0.05) + noise


def _between_knots(knots, one, other, n_segments):
    """Horizontal distance of two knots, each a segment and a range."""
    angle = 2.0 * math.pi * (one[0] - other[0]) / n_segments
    a, b = knots[one[1]], knots[other[1]]
    return math.sqrt((a - b) ** 2 + 2.0 * a * b * (1.0 - math.cos(angle)))


class Reference(NumpyBackend):
    """Plain loops; cells and the plane of the ground are those of the numpy backend."""

    name = 'reference'
    find_faces = staticmethod(find_faces)
    log_likelihood = staticmethod(log_likelihood)
    estimate_surface = staticmethod(estimate_surface)
    label_points = staticmethod(label_points)

    def build_grid(self, xyz, config):
        scan = super().build_grid(xyz, config)
        return scan._replace(candidates=lowest_of_cells(scan, config))

    def find_relief(self, candidates, faces, height, config):
        before, behind, is_behind = find_relief(candidates, faces, height, config)
        pieces = np.where(is_behind[..., None], *(Relief.of(h).pieces for h in (behind, before)))
        relief = Relief(pieces)
        return relief, candidates._replace(z=candidates.z - relief.at(candidates.x, candidates.y))

    def extract_lines(self, candidates, faces, config):
        shows_ground = np.array([not faces.has_occluded_base[t] for t in candidates.tile], bool)
        kept = candidates.where(shows_ground)
        lines = extract_lines(kept, config.lines)
        in_face = np.array([faces.is_face[t] for t in kept.tile], bool)
        continues = continues_line(kept, lines, config)
        return kept, lines, pseudo_inputs(kept, lines, config), continues, in_face
