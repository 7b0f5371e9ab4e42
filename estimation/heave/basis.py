"""The functions of time that a heave model is a weighted sum of: harmonics, a level and a slow drift."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Basis:
    """Columns: cos and sin of 2 pi f t for m frequencies, one constant, and ``drift_count`` of a random walk.

    The drift columns are the first terms of the Karhunen-Loeve series of a random walk of 1 m per root second
    that starts at ``drift_start_s`` and lasts ``drift_span_s``: with unit variances their sum is that walk,
    smoothed to periods longer than those of the harmonics.
    """

    frequency_hz: Array
    drift_start_s: float = 0.0
    drift_span_s: float = 1.0
    drift_count: int = 0

    @property
    def size(self) -> int:
        """Number of columns."""
        return 2 * len(self.frequency_hz) + 1 + self.drift_count

    def values(self, t_s: Array) -> Array:
        """Columns at times ``t_s`` (n,): (n, size)."""
        turned = phasors(t_s, self.frequency_hz)
        rate, scale = self._drift()
        drift = scale * np.sin(np.outer(t_s - self.drift_start_s, rate))
        return np.hstack([turned.real, turned.imag, np.ones((len(t_s), 1)), drift])

    def rates(self, t_s: Array) -> Array:
        """Time derivatives of the columns at ``t_s`` (n,): (n, size) [1/s]."""
        omega = 2.0 * np.pi * self.frequency_hz
        turned = omega * phasors(t_s, self.frequency_hz)
        rate, scale = self._drift()
        drift = scale * rate * np.cos(np.outer(t_s - self.drift_start_s, rate))
        return np.hstack([-turned.imag, turned.real, np.zeros((len(t_s), 1)), drift])

    def _drift(self) -> tuple[Array, Array]:
        """Angular rates and scales of the drift columns."""
        order = np.asarray(np.arange(1, self.drift_count + 1) - 0.5, np.float64) * np.pi
        scale: Array = np.sqrt(2.0 * self.drift_span_s) / order
        return order / self.drift_span_s, scale


def phasors(t_s: Array, frequency_hz: Array) -> NDArray[np.complex128]:
    """Return exp(2 pi i f t) for times (n,) [s] and frequencies (m,) [Hz]: (n, m).

    Of evenly spaced frequencies every one is the product of a coarse and a fine one, which spares most of the sines.
    """
    m = len(frequency_hz)
    step = float(frequency_hz[-1] - frequency_hz[0]) / (m - 1) if m > 1 else 0.0
    even = m > 1 and np.allclose(frequency_hz, frequency_hz[0] + step * np.arange(m), rtol=1e-12, atol=0.0)
    if not even:
        return np.asarray(np.exp(2j * np.pi * np.outer(t_s, frequency_hz)))
    each = math.ceil(math.sqrt(m))
    coarse = np.exp(2j * np.pi * np.outer(t_s, frequency_hz[::each]))
    fine = np.exp(2j * np.pi * np.outer(t_s, step * np.arange(each)))
    out = (coarse[:, :, None] * fine[:, None, :]).reshape(len(t_s), -1)[:, :m]
    return np.asarray(out)


def dense_basis(
    span_s: float, interval_s: float, lowest_hz: float, highest_hz: float, horizon_s: float
) -> Basis:
    """Harmonics spaced 1 / (2 (span + horizon)), so that nothing in the window or the horizon wraps round.

    The highest frequency is held below 0.45 / interval. Drift columns fill the gap below ``lowest_hz``.
    """
    spacing = 1.0 / (2.0 * (span_s + horizon_s))
    top = min(highest_hz, 0.45 / interval_s) if interval_s > 0 else highest_hz
    first, last = max(1, round(lowest_hz / spacing)), int(top / spacing)
    frequency = np.arange(first, last + 1, dtype=np.float64) * spacing
    reach = span_s + horizon_s + 10.0
    count = max(1, round(2.0 * reach * lowest_hz))
    return Basis(frequency, -span_s - 5.0, reach, count)
