"""Gaussian processes over range: kernels, posterior, inlier growth."""
