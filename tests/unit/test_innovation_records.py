"""The records' logarithm of the innovation covariance's determinant: a law, and both engines alike."""

from __future__ import annotations

import numpy as np
from small_flight import small_events

from estimation.config import Config
from estimation.estimator import LandingEstimator
from estimation.events import EventBatch


def test_log_determinant_of_the_innovation_covariance() -> None:
    batch = EventBatch.from_events(small_events(4.0))
    reference, compiled = (
        LandingEstimator(Config(), engine=engine).run(batch).records for engine in ("filterpy", "compiled")
    )
    tried = reference["dof"] > 0
    assert np.count_nonzero(tried) > 50
    np.testing.assert_allclose(compiled["log_det"], reference["log_det"], rtol=0.0, atol=1e-9)
    assert np.isnan(reference["log_det"][~tried]).all()
    # Hadamard: no more than the product of the variances, and equal to it in one dimension.
    product = 2.0 * np.nansum(np.log(reference["sigma"]), axis=1)
    single = reference["dof"] == 1
    np.testing.assert_allclose(reference["log_det"][single], product[single], atol=1e-9)
    assert (reference["log_det"][tried] <= product[tried] + 1e-9).all()
    assert (reference["dof"][tried] == 3).any()
