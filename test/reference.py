"""The stages as loops that read like the paper: slow oracles of both backends.

`Reference` has the methods of `gp_ground_seg.backend.Backend`; shapes and units are those of
its values. One point, one tile or one segment at a time; each fit is made anew.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from gp_ground_seg.backend import NumpyBackend
from gp_ground_seg.frame import (
    NOT_FINITE,
    Candidates,
    Faces,
    GroundSurface,
    Label,
    Labelled,
    Lines,
    PseudoInputs,
    Scan,
)

LOG_2PI = math.log(2.0 * math.pi)


class Reference(NumpyBackend):
    """Plain loops; cells and the plane of the ground are those of the numpy backend."""

    name = 'reference'

    def build_grid(self, xyz, config):
        scan = super().build_grid(xyz, config)
        return scan._replace(candidates=lowest_of_cells(scan, config))

    def find_faces(self, scan, config):
        return find_faces(scan, config)

    def extract_lines(self, candidates, faces, config):
        shows_ground = np.array([not faces.has_occluded_base[t] for t in candidates.tile], bool)
        kept = candidates.where(shows_ground)
        lines = extract_lines(kept, config.lines)
        return kept, lines, pseudo_inputs(kept, lines, config), continues_line(kept, lines, config)

    def log_likelihood(self, theta, inliers, slope_std, latent_terms):
        return log_likelihood(theta, inliers, slope_std, latent_terms)

    def estimate_surface(self, frame, theta, config, segment_step=1):
        return estimate_surface(frame, theta, config, segment_step)

    def label_points(self, scan, faces, surface, config):
        return label_points(scan, faces, surface, config)


# Polar grid (section II)


def place_of(x, y, grid):
    """Bin of a point, or None beyond the grid, and its azimuth in segments, 0 to M."""
    r = math.sqrt(x * x + y * y)
    steps = np.arange(grid.n_bins + 1) / grid.n_bins
    edges = grid.r_min + (grid.r_max - grid.r_min) * steps**grid.bin_growth
    # The origin counts as lying on +x, also where its x is -0.
    turn = (math.atan2(y, x if r > 0.0 else 1.0) / (2.0 * math.pi) + 0.5) * grid.n_segments
    if not r < edges[-1]:
        return None, turn
    return next(n for n in range(grid.n_bins) if r < edges[n + 1]), turn


def lowest_of_cells(scan: Scan, config) -> Candidates:
    """Lowest point of each cell; of equally low ones the nearest, then the first tile."""
    members = {}
    for i in np.flatnonzero(scan.grid.cell >= 0):
        members.setdefault(int(scan.grid.cell[i]), []).append(i)
    rows, counts = [], np.zeros(scan.grid.n_segments, dtype=np.int64)
    for cell, own in sorted(members.items()):
        z = scan.xyz[own, 2].astype(np.float64)
        low, r, tile = min(zip(z, scan.grid.r[own], scan.tiles.tile[own], strict=True))
        segment, n = divmod(cell, scan.grid.n_bins)
        extent = max(max(z) - low, config.lines.min_density_extent)
        width = scan.grid.edges[n + 1] - scan.grid.edges[n]
        rows.append((r, low, n, len(own) / (width * extent), tile))
        counts[segment] += 1
    r, z, own_bin, density, tile = np.array(rows, dtype=np.float64).reshape(-1, 5).T
    offsets = np.concatenate([[0], np.cumsum(counts)])
    return Candidates(r, z, own_bin.astype(np.int64), density, offsets, tile.astype(np.int32))


# Vertical faces


def find_faces(scan: Scan, config) -> Faces:
    """Tall tiles whose returns have a level normal; of those, faces down to the lowest return."""
    faces, limit = config.faces, config.label.obstacle_max_height
    result = Faces(*np.zeros((2, len(scan.tiles.extremes)), dtype=bool))
    for t in np.unique(scan.tiles.tile[scan.tiles.tile >= 0]):
        own = scan.xyz[scan.tiles.tile == t].astype(np.float64)
        above = own[:, 2] - own[:, 2].min()
        own, above = own[above <= limit], above[above <= limit]
        if len(own) < 4 or above.max() <= faces.min_height:
            continue
        value, vector = np.linalg.eigh(np.cov(own.T))
        # Each eigenvector is a normal with the product of the other two eigenvalues.
        weight = np.array([value[1] * value[2], value[0] * value[2], value[0] * value[1]])
        weight = np.maximum(weight, 0.0)
        square = (weight * vector[2] ** 2).sum() / weight.sum() if weight.sum() > 0.0 else 1.0
        result.is_face[t] = math.sqrt(square) <= faces.max_normal_z
        result.has_occluded_base[t] = result.is_face[t] and _is_occluded(own, above, faces)
    return result


def _is_occluded(own, above, faces):
    low, high = own[above <= faces.tolerance, :2], own[above > faces.tolerance, :2]
    if len(high) < 2 or faces.max_foot_distance <= 0.0:
        return False
    # The direction in which the returns above scatter least, across the face.
    across = np.linalg.eigh(np.cov(high.T))[1][:, 0]
    distance = (low - high.mean(axis=0)) @ across
    densities = len(low) / faces.tolerance, len(high) / (above.max() - faces.tolerance)
    is_sparse = densities[0] <= faces.max_foot_density * densities[1]
    return is_sparse and np.mean(distance**2) <= faces.max_foot_distance**2


# Lines and pseudo-inputs (sections III-C, III-D, Algorithm 1)


def fit_line(r, z, error_ratio):
    """Slope of the line of least distance, and the middle of the points, by SVD."""
    if len(r) == 1:
        return math.nan, r[0], z[0]
    scale = math.sqrt(error_ratio)
    centred = np.column_stack([r - r.mean(), (z - z.mean()) / scale])
    direction = np.linalg.svd(centred, full_matrices=False)[2][0]
    return scale * direction[1] / direction[0], r.mean(), z.mean()


def extract_lines(candidates: Candidates, lines) -> Lines:
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


def pseudo_inputs(candidates: Candidates, lines: Lines, config) -> PseudoInputs:
    """One pseudo-input in the middle of each of equal shares of a line's candidates."""
    latent, limits = config.latent, config.length_scale
    r_bar, classes, places, extents = [], [], [], [[] for _ in range(9)]
    for q, slope in enumerate(lines.slope):
        first, stop = lines.start[q], lines.start[q + 1]
        extent = candidates.r[stop - 1] - candidates.r[first]
        steepness = math.inf if math.isnan(slope) else abs(slope)
        length = sum(extent >= one for one in (latent.medium_extent, latent.long_extent))
        tilt = sum(steepness >= one for one in (latent.sloped_gradient, latent.steep_gradient))
        extents[3 * tilt + length].append(math.log(min(max(extent, limits.min), limits.max)))
        number = max(round((stop - first) / latent.candidates_per_pseudo_input), 1)
        for k in range(number):
            place = first + int((stop - first) * (k + 0.5) / number)
            r_bar.append(candidates.r[place])
            classes.append(3 * tilt + length)
            places.append(place)
    everything = sum(extents, []) or [math.log(limits.min)]
    return PseudoInputs(
        np.array(r_bar),
        np.array(classes, np.int64),
        np.array([sum(p < o for p in places) for o in candidates.offsets], np.int64),
        np.array([np.mean(own or everything) for own in extents]),
    )


def continues_line(candidates: Candidates, lines: Lines, config):
    """Candidates of lines that are long and flat, or start at a slope break."""
    r, z, growth, result = (
        candidates.r,
        candidates.z,
        config.growth,
        np.zeros(len(lines.line), bool),
    )
    tolerance = config.lines.offset_tolerance
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
        if (over_last <= tolerance and over_first >= -tolerance) or (
            over_last >= -tolerance and over_first <= tolerance
        ):
            result[own] = True
    return result


# Gaussian processes (section III)


def paciorek(r_a, l_a, r_b, l_b, sigma_f):
    """Equation 8, (A, B) [m^2]; ranges and length-scales [m]."""
    spread = l_a[:, None] ** 2 + l_b**2
    ratio = 2.0 * l_a[:, None] * l_b / spread
    return sigma_f**2 * np.sqrt(ratio) * np.exp(-((r_a[:, None] - r_b) ** 2) / spread)


def squared_exponential(r_a, r_b, sigma_f, length_scale):
    """Equation 12, (A, B)."""
    return sigma_f**2 * np.exp(-((r_a[:, None] - r_b) ** 2) / (2.0 * length_scale**2))


def posterior(r, z, l, r_star, l_star, sigma_f, sigma_n, slope_std=0.0):  # noqa: E741
    """Mean [m] and variance [m^2] of the height at `r_star`, equations 6 and 7."""
    covariance = paciorek(r, l, r, l, sigma_f) + slope_std**2 * np.outer(r, r)
    factor = cho_factor(covariance + sigma_n**2 * np.eye(len(r)))
    cross = paciorek(r, l, r_star, l_star, sigma_f) + slope_std**2 * np.outer(r, r_star)
    gain = cho_solve(factor, cross)
    variance = sigma_f**2 + slope_std**2 * r_star**2 - np.sum(cross * gain, axis=0)
    return gain.T @ z, np.maximum(variance, 0.0)


def log_length_scale(r_bar, l_bar, r_star, sigma_f_bar, sigma_l_bar, sigma_n_bar):
    """Mean of the latent process at `r_star` [log m], equations 10 and 11."""
    b = squared_exponential(r_bar, r_bar, sigma_f_bar, sigma_l_bar)
    b += sigma_n_bar**2 * np.eye(len(r_bar))
    weight = cho_solve(cho_factor(b), l_bar - l_bar.mean())
    return l_bar.mean() + squared_exponential(r_star, r_bar, sigma_f_bar, sigma_l_bar) @ weight


def log_length_scales(frame, theta, config, m):
    """Log length-scales of segment m at its candidates and at the knots wanted [log m]."""
    own, bar = (slice(*a.offsets[m : m + 2]) for a in (frame.candidates, frame.pseudo))
    r = frame.candidates.r[own]
    knots = frame.knots[: frame.candidates.bin[own][-1] + 2]
    if config.length_scale.model == 'latent':
        l_bar = theta[m, 5 + frame.pseudo.surface_class[bar]]
        both = np.concatenate([r, knots])
        u = log_length_scale(frame.pseudo.r_bar[bar], l_bar, both, *np.exp(theta[m, 2:5]))
        return u[: len(r)], u[len(r) :]
    limits = config.length_scale
    slope = frame.lines.slope[frame.lines.line[own]]
    value = -limits.gradient_gain * np.log(np.maximum(np.abs(slope), limits.flat_gradient))
    u = np.log(np.clip(np.where(np.isnan(slope), 0.0, value), limits.min, limits.max))
    if config.length_scale.model == 'constant':
        u = np.full(len(r), math.log(limits.constant))
    return u, np.interp(knots, r, u)


def estimate_surface(frame, theta, config, segment_step=1):
    """Inliers that join until none does, and the surface fused over neighbours."""
    growth, slope_std = config.growth, config.observation.slope_std
    shape = len(theta), len(frame.knots)
    mean, std, knot_u = np.full((3, *shape), np.nan)
    inlier = np.zeros(len(frame.candidates.r), dtype=bool)
    for m in range(len(theta)):
        own = slice(*frame.candidates.offsets[m : m + 2])
        r, z = frame.candidates.r[own], frame.candidates.z[own] - frame.prior_mean
        if len(r) == 0:
            continue
        u, u_star = log_length_scales(frame, theta, config, m)
        knot_u[m, : len(u_star)] = u_star
        sigma_f, sigma_n = np.exp(theta[m, :2])
        gate = max(sigma_n, config.observation.sigma_n)
        chosen = np.zeros(len(r), dtype=bool)
        joining = (r <= growth.seed_range) & (abs(z) <= growth.seed_height_tolerance)
        joining &= m % segment_step == 0
        while joining.any():
            chosen |= joining
            data = r[chosen], z[chosen], np.exp(u[chosen])
            height, variance = posterior(*data, r, np.exp(u), sigma_f, sigma_n, slope_std)
            residual = (z - height) / np.sqrt(variance + gate**2)
            joining = variance <= growth.max_std**2
            joining &= residual <= growth.max_standardised_residual
            joining &= residual >= -growth.max_standardised_depth
            joining[1:] |= frame.continues_line[own][1:] & chosen[:-1]
            joining &= ~chosen
        inlier[own] = chosen
        if chosen.any():
            at = frame.knots[: len(u_star)], np.exp(u_star), sigma_f, sigma_n, slope_std
            mean[m, : len(u_star)], variance = posterior(*data, *at)
            std[m, : len(u_star)] = np.sqrt(variance)
    mean, std = fuse(mean, std, frame.knots, config.surface.n_neighbours, slope_std)
    return GroundSurface(frame.knots, mean + frame.prior_mean, std, inlier), knot_u


def fuse(mean, std, knots, n_neighbours, slope_std):
    """Mean weighted by inverse variances, which grow with the arc to the neighbour [m]."""
    if n_neighbours == 0:
        return mean, std
    n_segments, fused = len(mean), np.full((2, *mean.shape), np.nan)
    for m in range(n_segments):
        for j, r in enumerate(knots):
            others = [(m + k) % n_segments for k in range(-n_neighbours, n_neighbours + 1)]
            arcs = abs(np.arange(-n_neighbours, n_neighbours + 1)) * r * 2 * np.pi / n_segments
            variance = np.maximum(std[others, j] ** 2 + (slope_std * arcs) ** 2, 1e-8)
            known = np.isfinite(variance)
            if known.any():
                weight = 1.0 / variance[known]
                fused[0, m, j] = (weight * mean[others, j][known]).sum() / weight.sum()
                fused[1, m, j] = weight.sum() ** -0.5
    return fused


def log_likelihood(theta, inliers, slope_std, latent_terms):
    """Equations 19 and 20; the gradient matrix by matrix, one hyper-parameter at a time."""
    value, gradient = 0.0, np.zeros(len(theta))
    for m in range(len(inliers.offsets) - 1):
        own = slice(*inliers.offsets[m : m + 2])
        bar = slice(*inliers.bar_offsets[m : m + 2])
        data = inliers.r[own], inliers.z[own], inliers.log_length_scale[own]
        latent = inliers.r_bar[bar], inliers.surface_class[bar]
        if len(data[0]) > 0:
            try:
                value += _add_segment(theta, gradient, data, latent, slope_std, latent_terms)
            except (LinAlgError, ValueError):  # not positive definite, or not finite
                return -math.inf, np.zeros(len(theta))
    return value, gradient


def _log_density(covariance, z):
    """log N(z | 0, covariance), its gradient in the covariance, and the Cholesky factor."""
    factor = cho_factor(covariance, lower=True)
    alpha = cho_solve(factor, z)
    log_determinant = 2.0 * np.log(np.diagonal(factor[0])).sum()
    g = 0.5 * (np.outer(alpha, alpha) - cho_solve(factor, np.eye(len(z))))
    return -0.5 * (z @ alpha + log_determinant + len(z) * LOG_2PI), g, factor


def _add_segment(theta, gradient, data, latent, slope_std, latent_terms):
    """Value of one segment; adds to `gradient`. Letters are those of the paper."""
    (r, z, u), (r_bar, surface_class) = data, latent
    sigma_f, sigma_n, sigma_f_bar, sigma_l_bar, sigma_n_bar = np.exp(theta[:5])
    value = 0.0
    if len(r_bar):
        l_bar, one = theta[5 + surface_class], np.eye(len(r_bar))
        k_bar = squared_exponential(r_bar, r_bar, sigma_f_bar, sigma_l_bar)
        k_star = squared_exponential(r, r_bar, sigma_f_bar, sigma_l_bar)
        # The density of the pseudo-inputs at their mean: the quadratic term is left out.
        printed, g_b, factor = _log_density(k_bar + sigma_n_bar**2 * one, 0.0 * l_bar)
        beta = cho_solve(factor, l_bar - l_bar.mean())
        u, value = l_bar.mean() + k_star @ beta, printed if latent_terms else 0.0
    length = np.exp(u)
    k = paciorek(r, length, r, length, sigma_f)
    density, g, _ = _log_density(
        k + slope_std**2 * np.outer(r, r) + sigma_n**2 * np.eye(len(r)), z
    )
    gradient[0] += np.sum(g * 2.0 * k)
    gradient[1] += 2.0 * sigma_n**2 * np.trace(g)
    if len(r_bar):
        spread = length[:, None] ** 2 + length**2
        share = length[:, None] ** 2 / spread
        distance2 = (r[:, None] - r) ** 2
        g_u = 2.0 * np.sum(g * k * (0.5 - share + 2.0 * share * distance2 / spread), axis=1)
        weight = cho_solve(factor, k_star.T @ g_u)
        np.add.at(gradient, 5 + surface_class, weight + (g_u.sum() - weight.sum()) / len(r_bar))
        for q, dk_star, db in (
            (2, 2.0 * k_star, 2.0 * k_bar),
            (
                3,
                k_star * (r[:, None] - r_bar) ** 2 / sigma_l_bar**2,
                k_bar * (r_bar[:, None] - r_bar) ** 2 / sigma_l_bar**2,
            ),
            (4, 0.0 * k_star, 2.0 * sigma_n_bar**2 * one),
        ):
            gradient[q] += g_u @ dk_star @ beta - weight @ db @ beta
            gradient[q] += np.sum(g_b * db) if latent_terms else 0.0
    return value + density


# Labels (Algorithm 2, line 14)


def label_points(scan: Scan, faces: Faces, surface: GroundSurface, config) -> Labelled:
    """Label each point by its height over the surface, against the band of its cell."""
    grid, label, n = scan.grid, config.label, len(scan.xyz)
    height, margin = np.full((2, n), np.nan)
    roughness = np.zeros((grid.n_segments, grid.n_bins))
    result = np.full(n, Label.OBSTACLE, np.uint8)
    for i in range(n):
        if grid.inside[i]:
            r = max(float(grid.r[i]), grid.edges[0])
            mean = surface.mean[grid.segment[i], grid.bin[i] : grid.bin[i] + 2]
            share = (r - grid.edges[grid.bin[i]]) / np.diff(grid.edges)[grid.bin[i]]
            height[i] = scan.xyz[i, 2] - (mean[0] + share * (mean[1] - mean[0]))
    in_face = np.array([grid.inside[i] and faces.is_face[scan.tiles.tile[i]] for i in range(n)])
    near = np.abs(height) < label.obstacle_min_height
    stands = (height >= label.obstacle_min_height) & (height <= label.obstacle_max_height)
    for m in range(grid.n_segments):
        for k in range(grid.n_bins):
            aside = np.isin(grid.segment, [(m + s) % grid.n_segments for s in (-1, 0, 1)])
            about = near & ~in_face.astype(bool) & aside & (abs(grid.bin - k) <= 1) & grid.inside
            if about.any():
                roughness[m, k] = math.sqrt(np.mean(height[about] ** 2))
    for i in np.flatnonzero(grid.inside):
        rough = roughness[grid.segment[i], grid.bin[i]]
        band = label.ground_tolerance + label.roughness_gain * rough
        if stands[grid.cell == grid.cell[i]].any():
            strict = label.obstacle_tolerance + label.obstacle_roughness_gain * rough
            band = min(band, strict)
        band = min(band, label.obstacle_min_height)
        margin[i] = min(band - height[i], height[i] + label.below_tolerance)
        t = scan.tiles.tile[i]
        if in_face[i]:
            sign = -1.0 if faces.has_occluded_base[t] else 1.0
            over_base = max(height[i], float(scan.xyz[i, 2]) - float(scan.tiles.lowest_z[t]))
            margin[i] = min(margin[i], sign * config.faces.tolerance - over_base)
        if margin[i] >= 0.0:
            result[i] = Label.GROUND
    result[grid.cell == NOT_FINITE] = Label.UNKNOWN
    return Labelled(result, height, margin, roughness)
