"""Write gpy.json: the two processes on drawn segments, computed by GPy. Needs GPy 1.15, and no
code of ours:

python test/core/gpy_table.py
"""

import json
from pathlib import Path

import GPy
import numpy as np
from GPy.core.parameterization import Param

THETA = [0.2, 0.05, 0.9, 3.0, 0.25, 0.8, 0.5, 1.3, 1.0, 0.7, 2.0, 0.9, 1.1, 0.6]
SLOPE_STD, SLOPE_DRIFT = 0.05, 0.01
KNOTS = np.linspace(2.0, 62.0, 21)
JITTER = 1e-8
"""What GPy adds to each variance of the noise."""


class Ground(GPy.kern.Kern):
    """Paciorek's kernel and a line whose slope walks; inputs are range and length-scale."""

    def __init__(self, sill):
        super().__init__(2, None, 'ground')
        self.sill = Param('sill', sill)
        self.link_parameter(self.sill)

    def of_process(self, one, other):
        a, b = one[:, 1:] ** 2, other[:, 1] ** 2
        root = a**0.25 * b**0.25 * ((a + b) / 2.0) ** -0.5
        return root * np.exp(-((one[:, :1] - other[:, 0]) ** 2) / (a + b))

    def K(self, X, X2=None):  # noqa: N802, N803 (names of GPy)
        other = X if X2 is None else X2
        near, far = np.minimum(X[:, :1], other[:, 0]), np.maximum(X[:, :1], other[:, 0])
        line = SLOPE_STD**2 * near * far + SLOPE_DRIFT**2 * near**2 * (3.0 * far - near) / 6.0
        return self.sill * self.of_process(X, other) + line

    def Kdiag(self, X):  # noqa: N802, N803
        return np.diag(self.K(X)).copy()

    def update_gradients_full(self, dL_dK, X, X2=None):  # noqa: N803
        self.sill.gradient = np.sum(dL_dK * self.of_process(X, X if X2 is None else X2))

    def update_gradients_diag(self, dL_dKdiag, X):  # noqa: N803
        self.sill.gradient = np.sum(dL_dKdiag)


def regression(x, y, kernel, sigma):
    return GPy.models.GPRegression(x, y[:, None], kernel, noise_var=sigma**2 - JITTER)


def length_scales(own, theta):
    """Function that gives log length-scales of a segment at ranges, by GPy's own kernel."""
    l_bar = np.array(own['log_extent']) + theta[5 + np.array(own['kind'])]
    sigma_f, sigma_l, sigma_n = np.exp(theta[2:5])
    kernel = GPy.kern.RBF(1, variance=sigma_f**2, lengthscale=sigma_l)
    r_bar = np.array(own['r_bar'])[:, None]
    latent = regression(r_bar, l_bar - l_bar.mean(), kernel, sigma_n)
    return lambda r: latent.predict_noiseless(np.array(r)[:, None])[0][:, 0] + l_bar.mean()


def ground(own, theta):
    u = length_scales(own, theta)(own['r'])
    places = np.column_stack([own['r'], np.exp(u)])
    sigma_f, sigma_n = np.exp(theta[:2])
    return regression(places, np.array(own['z']), Ground(sigma_f**2), sigma_n)


def log_likelihood(segments, theta):
    return sum(ground(own, theta).log_likelihood() for own in segments)


def gradient(segments, theta):
    """By GPy for sigma_f and sigma_n, by differences of its likelihood for the others."""
    found = np.zeros(len(theta))
    for own in segments:
        found[:2] += ground(own, theta).gradient * 2.0 * np.exp(2.0 * theta[:2])
    for k, step in enumerate(1e-4 * np.eye(len(theta))[2:], start=2):
        up, down = (log_likelihood(segments, theta + sign * step) for sign in (1.0, -1.0))
        found[k] = (up - down) / 2e-4
    return found.tolist()


def main():
    rng = np.random.default_rng(6)
    segments, theta = [], np.log(THETA)
    for n, n_bar in [(22, 5), (9, 2), (30, 6), (1, 1)]:
        r = np.sort(rng.uniform(3.0, 60.0, n)).round(3)
        z = 0.3 * np.sin(r / 9.0) + rng.normal(0.0, 0.05, n)
        segments.append({
            'r': r.tolist(),
            'z': z.round(4).tolist(),
            'r_bar': np.sort(rng.uniform(3.0, r[-1], n_bar)).round(3).tolist(),
            'log_extent': rng.uniform(0.4, 2.5, n_bar).round(3).tolist(),
            'kind': rng.integers(0, 9, n_bar).tolist(),
        })  # fmt: skip
    for own in segments:
        u = length_scales(own, theta)(KNOTS)
        mean, variance = ground(own, theta).predict_noiseless(np.column_stack([KNOTS, np.exp(u)]))
        own['expected'] = [u.tolist(), mean[:, 0].tolist(), np.sqrt(variance[:, 0]).tolist()]
    table = {
        'by': f'GPy {GPy.__version__}',
        'theta': THETA,
        'slope': [SLOPE_STD, SLOPE_DRIFT],
        'knots': KNOTS.tolist(),
        'segments': segments,
        'log_likelihood': log_likelihood(segments, theta),
        'gradient': gradient(segments, theta),
    }
    Path(__file__).with_name('gpy.json').write_text(json.dumps(table) + '\n')


if __name__ == '__main__':
    main()
