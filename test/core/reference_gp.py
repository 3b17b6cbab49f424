"""The two Gaussian processes as loops that read like the paper; see `reference`."""

import math

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.stats import multivariate_normal, norm

from gp_ground_seg.core.frame import GroundSurface


def paciorek(r_a, l_a, r_b, l_b, sigma_f):
    """Equation 8 as printed, (A, B) [m^2]; ranges and length-scales [m]."""
    a, b = l_a[:, None] ** 2, l_b**2
    root = a**0.25 * b**0.25 * ((a + b) / 2.0) ** -0.5
    return sigma_f**2 * root * np.exp(-((r_a[:, None] - r_b) ** 2) / (a + b))


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
        l_bar = theta[5 + frame.pseudo.kind[bar]] + frame.pseudo.log_extent[bar]
        both = np.concatenate([r, knots])
        u = log_length_scale(frame.pseudo.r_bar[bar], l_bar, both, *np.exp(theta[2:5]))
        return u[: len(r)], u[len(r) :]
    limits = config.length_scale
    slope = frame.lines.slope[frame.lines.line[own]]
    value = -limits.gradient_gain * np.log(np.maximum(np.abs(slope), limits.flat_gradient))
    u = np.log(np.clip(np.where(np.isnan(slope), 0.0, value), limits.min, limits.max))
    if limits.model == 'constant':
        u = np.full(len(r), math.log(limits.constant))
    return u, np.interp(knots, r, u)


def estimate_surface(frame, theta, config):
    """Inliers that join until none does, and the surface, with what the segments beside show."""
    growth, slope_std = config.growth, config.observation.slope_std
    n = frame.candidates.n_segments
    looks_aside = config.surface.look_aside and slope_std > 0.0 and len(frame.knots) > 0
    z, first = frame.candidates.z - frame.prior_mean, frame.candidates.offsets
    seed = (frame.candidates.r <= growth.seed_range) & (abs(z) <= growth.seed_height_tolerance)
    nothing = np.zeros((2, n, max(len(frame.knots), 1)))
    evidence, odds = nothing, 0.25
    if looks_aside:
        seed, odds = unlifted(frame, z, seed, np.exp(theta[1]), config)
        rows = [(m, grow(frame, theta, config, m, z, seed, odds, nothing)) for m in range(0, n, 4)]
        evidence = evidence_beside(dict(rows), theta, frame.knots, slope_std, n)
    own = {m: grow(frame, theta, config, m, z, seed, odds, evidence) for m in range(n)}
    mean, std, knot_u = np.full((3, n, len(frame.knots)), np.nan)
    inlier, u_all = np.zeros(len(z), dtype=bool), np.zeros(len(z))
    if looks_aside:
        evidence = evidence_beside(own, theta, frame.knots, slope_std, n)
    for m, (chosen, u, u_star, height, deviation) in own.items():
        inlier[first[m] : first[m + 1]], u_all[first[m] : first[m + 1]] = chosen, u
        knot_u[m, : len(u_star)] = u_star
        for j in range(len(u_star)):
            known = [(height[j], deviation[j] ** 2)] if chosen.any() else []
            if looks_aside and evidence[1, m, j] > 0.0:
                prior = 0.0, np.exp(2 * theta[0]) + (slope_std * frame.knots[j]) ** 2
                known = (known or [prior]) + [(evidence[0, m, j], 1 / evidence[1, m, j])]
            if known:
                weights = [1 / max(variance, 1e-6) for _, variance in known]
                mean[m, j] = np.average([height for height, _ in known], weights=weights)
                std[m, j] = sum(weights) ** -0.5
    return GroundSurface(frame.knots, mean + frame.prior_mean, std, inlier), knot_u, u_all


def unlifted(frame, z, seed, sigma_n, config):
    """Seeds that do not stand higher over a seed than noise and prior slope explain, and the odds.

    The odds are those of obstacles among the candidates as near as seeds, faces left out.
    """
    candidates, n = frame.candidates, len(frame.candidates.offsets) - 1
    slope, noise = 2 * config.observation.slope_std, 2 * math.sqrt(2) * sigma_n
    stands, segment, r = np.zeros_like(seed), candidates.segment, frame.knots[candidates.bin]
    near = candidates.bin <= candidates.bin[seed].max(initial=-1)
    for i in np.flatnonzero(near):
        lowest = math.inf
        for k in np.flatnonzero(seed):
            steps = abs(segment[i] - segment[k])
            turn = min(steps, n - steps) * 2 * math.pi / n
            # The arc is shortest at the nearest bin with a seed, on the way from one to the other.
            arcs = (
                abs(r[i] - at) + abs(r[k] - at) + turn * at
                for at in frame.knots[: candidates.bin[seed].max() + 1]
            )
            lowest = min(lowest, z[k] + slope * min(arcs))
        stands[i] = z[i] > lowest + noise
    n_ground, n_standing = (
        int((near & ~frame.in_face & is_it).sum()) for is_it in (~stands, stands)
    )
    return seed & ~stands, max((n_standing + 1) / (n_ground + 4), 0.25)


def grow(frame, theta, config, m, z, seed, odds, evidence):
    """Inliers of a segment, log length-scales, height and deviation at the knots."""
    growth, slope_std = config.growth, config.observation.slope_std
    own = slice(*frame.candidates.offsets[m : m + 2])
    r, z, seed = frame.candidates.r[own], z[own], seed[own]
    if len(r) == 0:
        return np.zeros(0, dtype=bool), [], [], [], []
    u, u_star = log_length_scales(frame, theta, config, m)
    sigma_f, sigma_n = np.exp(theta[:2])
    shown, weight = np.zeros((2, len(r)))
    if evidence.any():
        shown, weight = (np.interp(r, frame.knots, row) for row in evidence[:, m])
    is_above = np.array([
        w > 0 and height - s > 2 * math.sqrt(1 / w + sigma_n**2)
        for height, s, w in zip(z, shown, weight, strict=True)
    ], bool)  # fmt: skip
    in_face, continues = frame.in_face[own], frame.continues_line[own] & ~is_above
    # Candidates within sigma_l_bar of each other show together as much as one.
    reach = np.exp(theta[3]) if config.label.rule == 'roughness' else 0.0
    noise = np.array([sigma_n * math.sqrt(sum(abs(r - own) <= reach)) for own in r])
    chosen = np.zeros(len(r), dtype=bool)
    joining, in_doubt = seed & ~is_above, seed & in_face
    height, variance = np.zeros(len(r)), sigma_f**2 + slope_std**2 * r**2
    while True:
        precision = 1 / np.maximum(variance, 1e-12) + weight
        height = (height / np.maximum(variance, 1e-12) + shown * weight) / precision
        if chosen.any() or not joining.any():
            residual = (z - height) / np.sqrt(1 / precision + sigma_n**2)
            in_doubt = (1 / precision <= growth.max_std**2) & ~chosen
            in_doubt &= residual <= growth.max_standardised_residual
            in_doubt &= residual >= -growth.max_standardised_depth
            in_doubt &= chosen.any() | (weight > 0)
            follows = np.append(False, continues[1:] & chosen[:-1]) & ~chosen
            joining, in_doubt = in_doubt | follows, in_doubt & ~follows
        for i in np.flatnonzero(joining & in_doubt & (config.label.rule == 'roughness')):
            own_odds = max(odds, 4.0) if in_face[i] else odds
            noise[i] = doubtful_noise(z[i] - height[i], 1 / precision[i], noise[i], own_odds)
        if not joining.any():
            break
        chosen |= joining
        data = r[chosen], z[chosen], np.exp(u[chosen])
        height, variance = posterior(*data, r, np.exp(u), sigma_f, noise[chosen], slope_std)
    if not chosen.any():
        return chosen, u, u_star, [], []
    at = frame.knots[: len(u_star)], np.exp(u_star), sigma_f, noise[chosen], slope_std
    height, variance = posterior(r[chosen], z[chosen], np.exp(u[chosen]), *at)
    return chosen, u, u_star, height, np.sqrt(variance)


def doubtful_noise(residual, variance, noise, odds):
    """Deviation of the noise with which the variance shrinks by the probability of ground."""
    if residual <= 0.0:
        return noise
    spread = variance + noise**2
    ground = norm.pdf(residual, scale=math.sqrt(spread))
    probability = ground / (ground + odds)
    left = variance - probability * variance**2 / spread
    return math.sqrt(1 / (1 / left - 1 / variance))


def evidence_beside(own, theta, knots, slope_std, n):
    """Height and precision at every knot, by the nearest segment on either side that knows."""
    shown = {}
    for m, (chosen, _, _, height, deviation) in own.items():
        for j in range(len(height) if chosen.any() else 0):
            square = max(deviation[j], 1e-3) ** 2
            precision = 1 / square - 1 / (np.exp(2 * theta[0]) + (slope_std * knots[j]) ** 2)
            if precision > 1e-3:
                shown[m, j] = height[j] / square / precision, precision**-0.5
    result = np.zeros((2, n, len(knots)))
    for m in range(n):
        for j, r in enumerate(knots):
            both = []
            for side in (-1, 1):
                # A whole turn comes back to the segment itself.
                away = [
                    (shown[other, j][1] + k * slope_std * 2 * math.pi / n * r, shown[other, j][0])
                    for k in range(1, n + 1)
                    if ((other := (m + side * k) % n), j) in shown
                ]
                both += [min(away)] if away else []
            weights = [deviation**-2 for deviation, _ in both]
            if both:
                heights = [height for _, height in both]
                result[:, m, j] = np.average(heights, weights=weights), sum(weights)
    return result


def log_likelihood(theta, inliers, slope_std, latent_terms):
    """Equation 19, and its gradient (equation 20) by central differences.

    Richardson's extrapolation: the error is of sixth order in the steps.
    """
    value = _log_likelihood(theta, inliers, slope_std, latent_terms)
    gradient = np.zeros(len(theta))
    for i in range(len(theta) if math.isfinite(value) else 0):
        for step, weight in ((2e-3, 64 / 45), (4e-3, -20 / 45), (8e-3, 1 / 45)):
            for sign in (-1.0, 1.0):
                aside = theta + sign * step * (np.arange(len(theta)) == i)
                other = _log_likelihood(aside, inliers, slope_std, latent_terms)
                gradient[i] += sign * weight * other / (2.0 * step)
    return value, gradient


def _log_likelihood(theta, inliers, slope_std, latent_terms):
    """Value of equation 19; letters are those of the paper."""
    sigma_f, sigma_n, *latent = np.exp(theta[:5])
    value = 0.0
    for m in range(len(inliers.offsets) - 1):
        own, bar = (slice(*o[m : m + 2]) for o in (inliers.offsets, inliers.bar_offsets))
        r, u, r_bar = inliers.r[own], inliers.log_length_scale[own], inliers.r_bar[bar]
        if len(r) == 0:
            continue
        try:
            if len(r_bar):
                l_bar = theta[5 + inliers.kind[bar]] + inliers.log_extent[bar]
                u = log_length_scale(r_bar, l_bar, r, *latent)
            if len(r_bar) and latent_terms:
                # Density at its mean: the quadratic term, which the paper leaves out, is zero.
                b = squared_exponential(r_bar, r_bar, *latent[:2])
                b += latent[2] ** 2 * np.eye(len(r_bar))
                value += multivariate_normal(cov=b).logpdf(np.zeros(len(r_bar)))
            a = paciorek(r, np.exp(u), r, np.exp(u), sigma_f) + slope_std**2 * np.outer(r, r)
            a += sigma_n**2 * np.eye(len(r))
            value += multivariate_normal(cov=a).logpdf(inliers.z[own])
        except LinAlgError:  # not positive definite
            return -math.inf
    return value if math.isfinite(value) else -math.inf
