"""The two Gaussian processes as loops that read like the paper; see `reference`."""

import math

import numpy as np
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.stats import multivariate_normal

from gp_ground_seg.core.frame import GroundSurface
from gp_ground_seg.core.gp.latent import given_theta


def paciorek(r_a, l_a, r_b, l_b, sigma_f):
    """Equation 8 as printed, (A, B) [m^2]; ranges and length-scales [m]."""
    a, b = l_a[:, None] ** 2, l_b**2
    root = a**0.25 * b**0.25 * ((a + b) / 2.0) ** -0.5
    return sigma_f**2 * root * np.exp(-((r_a[:, None] - r_b) ** 2) / (a + b))


def squared_exponential(r_a, r_b, sigma_f, length_scale):
    """Equation 12, (A, B)."""
    return sigma_f**2 * np.exp(-((r_a[:, None] - r_b) ** 2) / (2.0 * length_scale**2))


def line(r_a, r_b, prior):
    """Covariance of heights on a line whose slope walks, (A, B) [m^2].

    A step of the slope at s moves a height at r by r - s: the integral of (r - s)(r' - s) over s.
    """
    a, b, near = r_a[:, None], r_b, np.minimum(r_a[:, None], r_b)
    walked = a * b * near - (a + b) * near**2 / 2.0 + near**3 / 3.0
    return prior.slope_std**2 * np.outer(r_a, r_b) + prior.slope_drift**2 * walked


def posterior(r, z, l, r_star, l_star, sigmas, prior):  # noqa: E741
    """Mean [m] and variance [m^2] of the height at `r_star`, equations 6 and 7."""
    sigma_f, sigma_n = sigmas
    covariance = paciorek(r, l, r, l, sigma_f) + line(r, r, prior)
    factor = cho_factor(covariance + sigma_n**2 * np.eye(len(r)))
    cross = paciorek(r, l, r_star, l_star, sigma_f) + line(r, r_star, prior)
    gain = cho_solve(factor, cross)
    variance = sigma_f**2 + np.diag(line(r_star, r_star, prior)) - np.sum(cross * gain, axis=0)
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
    """Inliers that join until none does (section III-B), and the surface of each segment.

    As the paper has it: without neighbouring segments, ground that carries on, doubt in obstacles,
    or noise that candidates share. The inliers grow under the theta that is given.
    """
    given, prior = given_theta(config), config.observation
    n, first = frame.candidates.n_segments, frame.candidates.offsets
    mean, std, knot_u = np.full((3, n, len(frame.knots)), np.nan)
    inlier, u = np.zeros(first[-1], dtype=bool), np.zeros(first[-1])
    for m in np.flatnonzero(np.diff(first)):
        own = slice(*first[m : m + 2])
        r, z = frame.candidates.r[own], frame.candidates.z[own] - frame.prior_mean
        l_given = np.exp(log_length_scales(frame, given, config, m)[0])
        inlier[own] = chosen = grow(r, z, l_given, np.exp(given[:2]), prior, config.growth)
        u[own], u_star = log_length_scales(frame, theta, config, m)
        knot_u[m, : len(u_star)] = u_star
        if chosen.any() and len(u_star):
            data = r[chosen], z[chosen], np.exp(u[own][chosen])
            knots = frame.knots[: len(u_star)], np.exp(u_star)
            height, variance = posterior(*data, *knots, np.exp(theta[:2]), prior)
            mean[m, : len(u_star)] = height + frame.prior_mean
            std[m, : len(u_star)] = np.sqrt(np.maximum(variance, 1e-6))
    return GroundSurface(frame.knots, mean, std, inlier), knot_u, u


def grow(r, z, length_scale, sigmas, prior, growth):
    """Candidates of a segment that are inliers; `sigmas` are sigma_f and sigma_n."""
    chosen = joining = (r <= growth.seed_range) & (abs(z) <= growth.seed_height_tolerance)
    while joining.any():
        data = r[chosen], z[chosen], length_scale[chosen]
        height, variance = posterior(*data, r, length_scale, sigmas, prior)
        residual = (z - height) / np.sqrt(variance + sigmas[1] ** 2)
        joining = ~chosen & (np.minimum(variance, (z - height) ** 2) <= growth.max_std**2)
        joining &= abs(residual) <= growth.max_standardised_residual
        chosen = chosen | joining
    return chosen


def log_likelihood(theta, inliers, prior, latent_terms):
    """Equation 19, and its gradient (equation 20) by central differences.

    Richardson's extrapolation: the error is of sixth order in the steps, shorter ones round more.
    """
    value = _log_likelihood(theta, inliers, prior, latent_terms)
    gradient = np.zeros(len(theta))
    for i in range(len(theta) if math.isfinite(value) else 0):
        for step, weight in ((5e-3, 64 / 45), (1e-2, -20 / 45), (2e-2, 1 / 45)):
            for sign in (-1.0, 1.0):
                aside = theta + sign * step * (np.arange(len(theta)) == i)
                other = _log_likelihood(aside, inliers, prior, latent_terms)
                gradient[i] += sign * weight * other / (2.0 * step)
    return value, gradient


def _log_likelihood(theta, inliers, prior, latent_terms):
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
            a = paciorek(r, np.exp(u), r, np.exp(u), sigma_f) + line(r, r, prior)
            a += sigma_n**2 * np.eye(len(r))
            value += multivariate_normal(cov=a).logpdf(inliers.z[own])
        except LinAlgError:  # not positive definite
            return -math.inf
    return value if math.isfinite(value) else -math.inf
