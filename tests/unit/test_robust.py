"""Weighted least squares on displacements: whether the covariance is the scatter of the estimates."""

import numpy as np

from vision.robust import least_squares, scatter_covariance


def test_covariance_is_the_scatter_where_weights_differ_by_chance():
    """Rows of equal noise whose variances are estimated from three pixels each, with a prior on the last parameter."""
    rng = np.random.default_rng(4)
    angle = np.linspace(0.0, 6.28, 60, endpoint=False)
    a = np.stack((np.cos(angle), np.sin(angle), np.where(angle < 3.0, 1.0, 2.0)), axis=1)
    precision, valid = np.array([0.0, 0.0, 50.0]), np.ones(60, dtype=np.bool_)
    estimates, claimed, plain = [], np.zeros((3, 3)), np.zeros((3, 3))
    for _ in range(1500):
        own = 0.04 * np.maximum(rng.chisquare(3, 60) / 2.37, 1.0)
        start = rng.standard_normal() / np.sqrt(50.0)
        delta = 0.2 * rng.standard_normal(60) + a[:, 2] * start
        solved = least_squares(a, delta, own, valid, precision, np.zeros(3))
        estimates.append(solved.change - np.array([0.0, 0.0, start]))
        claimed += scatter_covariance(a, solved, precision, np.full(60, 0.04)) / 1500.0
        plain += solved.inverse * solved.chi2 / 1500.0
    scatter = np.diag(np.cov(np.array(estimates).T))
    ratio = np.diag(claimed) / scatter
    # Huber's weights cost 5 % of which the residuals say nothing; the scatter itself is known to 4 %.
    assert (ratio > 0.87).all() and (ratio < 1.05).all(), ratio
    assert (np.diag(plain) / scatter)[:2].max() < 0.87
