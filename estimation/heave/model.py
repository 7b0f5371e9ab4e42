"""The heave model as it is reported: the form (3.6) of the seed, its statistics, and its forecasts."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimation.heave import forecast as forecasting
from estimation.heave.bandpass import BandPass, fit_band_pass
from estimation.heave.basis import Basis
from estimation.heave.forecast import Coefficients, Forecast
from estimation.heave.series import WINDOW_S, Window, cut_window
from estimation.heave.sinusoids import fit_sinusoids
from estimation.heave.spectrum import Density, LearnedSpectrum, SpectrumSettings, grid_span, learn
from estimation.one_thread import one_thread

Array = NDArray[np.float64]
Method = Literal["bhr", "sinusoids", "mean"]

SHORTEST_SPAN_S = 5.0
FEWEST_BINS = 16
GROWTHS = (-2.0, -1.5, -1.0, -0.5, 0.0, 0.5, 1.0, 1.5, 2.0)
"""Change of the dominant sinusoid's amplitude over the window, in its mean: from dying out to setting in."""


class Component(NamedTuple):
    """One term A sin(2 pi t / T + phi) of the heave; t counts from the last sample, in seconds."""

    amplitude_m: float
    period_s: float
    phase_rad: float


@dataclass(frozen=True, slots=True)
class HeaveModel:
    """The vertical motion of a deck, up positive: Z(t) = level + drift + sum_i A_i sin(2 pi t / T_i + phi_i).

    Equation (3.6) with a period for every component. t = 0 is the last sample, at ``last_s`` of the series'
    own time. ``method`` is what was fitted: ``bhr``, ``sinusoids``, or ``mean`` where the series could not
    carry a model, with the ``reason`` in words (empty otherwise).
    """

    method: Method
    reason: str
    last_s: float
    span_s: float
    samples: int
    dropped: int
    coefficients: Coefficients
    noise_density_m2ps: float
    learned: LearnedSpectrum | None = None

    @property
    def frequency_hz(self) -> Array:
        """Frequencies of the components (m,), lowest first."""
        return self.coefficients.basis.frequency_hz

    @property
    def power_m2(self) -> Array:
        """Variance of each component in the learned spectrum (m,) [m^2]; else half its squared amplitude."""
        if self.learned is not None:
            return self.learned.power_m2
        return np.array([0.5 * c.amplitude_m**2 for c in self.components])

    @property
    def density_m2ps(self) -> Array:
        """One-sided spectral density of the heave at ``frequency_hz`` (m,) [m^2/Hz]; ``bhr`` only."""
        if self.learned is None:
            raise ValueError(
                f"a model fitted by {self.method!r} has no spectral density; fit with method='bhr'"
            )
        spacing_hz = float(self.frequency_hz[1] - self.frequency_hz[0])
        return self.learned.power_m2 / spacing_hz

    @property
    def components(self) -> list[Component]:
        """(A_i, T_i, phi_i) of the most probable motion, longest period first.

        A learned spectrum has hundreds on a dense grid: their sum counts, not any one of them.
        """
        frequency, mean = self.frequency_hz, self.coefficients.mean
        m = len(frequency)
        cosine, sine = mean[:m], mean[m : 2 * m]
        rows = zip(np.hypot(cosine, sine), 1.0 / frequency, np.arctan2(cosine, sine), strict=True)
        return [Component(float(a), float(t), float(p)) for a, t, p in rows]

    @property
    def noise_scale(self) -> float:
        """Scatter of the samples over the sigma that they were given with; 1 where it was not learned."""
        return self.learned.noise_scale if self.learned is not None else 1.0

    @property
    def sd_m(self) -> float:
        """Standard deviation of the heave about its level [m]: of the spectrum or as seen, whichever is larger."""
        return math.sqrt(self.coefficients.variance_m2)

    @property
    def hs_m(self) -> float:
        """Significant wave height of the deck's own motion in the window [m]: four standard deviations.

        Of what was seen, about its mean and trend, with what is uncertain of it; a spectrum's power is less well known,
        from a few waves of a regular motion most of all.
        """
        if self.learned is None or self.span_s <= 0:
            return 4.0 * self.sd_m
        c = self.coefficients
        time = np.linspace(-self.span_s, 0.0, max(16, int(4.0 * self.span_s)))
        rows = c.basis.values(time)
        rows[:, c.level] = 0.0
        trend, _ = np.linalg.qr(np.column_stack([np.ones_like(time), time]))
        rows -= trend @ (trend.T @ rows)
        variance = np.mean((rows @ c.mean) ** 2) + np.mean((rows @ c.covariance * rows).sum(axis=1))
        return 4.0 * math.sqrt(max(0.0, float(variance)))

    @property
    def tp_s(self) -> float:
        """Peak period [s]: the power-weighted mean about the spectrum's peak; NaN without motion."""
        power = self.power_m2
        if len(power) == 0 or not np.any(power > 0):
            return math.nan
        if self.learned is None:
            return float(1.0 / self.frequency_hz[int(np.argmax(power))])
        near = power >= 0.7 * power.max()
        return float(power[near].sum() / (power[near] @ self.frequency_hz[near]))

    @property
    def dominant_period_s(self) -> float:
        """Period of the one sinusoid (and constant) that explains most of the motion in the window [s].

        Its amplitude may grow or fall with time, linearly and in phase: a swell that sets in would else look longer
        than it is. (A part in quadrature that grows would be another frequency.)
        Sharper than ``tp_s`` for a deck that moves regularly; on an irregular sea it is that of the highest
        group of waves. Searched between 0.5 and 2 times the frequency of ``tp_s``; NaN without motion.
        """
        centre = self.tp_s
        if not math.isfinite(centre) or self.span_s <= 0:
            return math.nan
        time = -np.linspace(0.0, self.span_s, max(32, int(8.0 * self.span_s / centre)))
        basis, mean = self.coefficients.basis, self.coefficients.mean
        motion = basis.values(time)[:, ~self.coefficients.level] @ mean[~self.coefficients.level]
        frequency = np.geomspace(0.5, 2.0, 400) / centre
        explained = np.max([_explained(motion, time, frequency, growth) for growth in GROWTHS], axis=0)
        k = int(np.clip(np.argmax(explained), 1, len(frequency) - 2))
        before, at, after = explained[k - 1 : k + 2]
        bend = before - 2.0 * at + after
        shift = 0.5 * (before - after) / bend if bend < 0 else 0.0
        step = math.log(frequency[1] / frequency[0])
        return float(math.exp(-step * float(np.clip(shift, -0.5, 0.5))) / frequency[k])

    @property
    def level_m(self) -> float:
        """Level, drift included, at the last sample [m]."""
        value, _ = self._level()
        return value

    @property
    def level_sigma_m(self) -> float:
        """1 sigma of ``level_m`` [m]."""
        _, variance = self._level()
        return math.sqrt(max(0.0, variance))

    def predict(self, horizon_s: ArrayLike) -> Forecast:
        """Heave and rate with variances, skill and fallback at ``horizon_s`` [s] after the last sample."""
        return forecasting.forecast(self.coefficients, horizon_s)

    def forecast(self, horizon_s: ArrayLike) -> tuple[Array, Array]:
        """Mean [m] and variance [m^2] of the heave, level included, in the shape of ``horizon_s``.

        Where the forecast knows no more than the mean, the mean and its variance are returned: ``predict``
        says where.
        """
        result = self.predict(horizon_s)
        return result.mean_m, result.variance_m2

    def forecast_rate(self, horizon_s: ArrayLike) -> tuple[Array, Array]:
        """Mean [m/s] and variance [m^2/s^2] of the heave rate, in the shape of ``horizon_s``."""
        result = self.predict(horizon_s)
        return result.rate_mps, result.rate_variance_m2ps2

    def joint(self, horizon_s: ArrayLike) -> tuple[Array, Array]:
        """Mean (2n,) and covariance (2n, 2n) of n heaves [m] and n rates [m/s] at ``horizon_s`` (n,)."""
        return forecasting.joint(self.coefficients, horizon_s)

    def skill(self, horizon_s: ArrayLike) -> Array:
        """1 - variance / variance of the mean predictor: 1 is perfect, 0 knows the level only."""
        return self.predict(horizon_s).skill

    def quiescent(
        self,
        start_s: float,
        duration_s: float = 1.0,
        *,
        rate_limit_mps: float = 0.3,
        height_band_m: float | None = None,
        samples: int = 2000,
        rng: np.random.Generator | None = None,
    ) -> float:
        """Probability that the deck stays quiet from ``start_s`` [s] after the last sample for
        ``duration_s``.

        Quiet: |rate| < ``rate_limit_mps`` throughout and, if given, |heave - level| < ``height_band_m``. The
        draws come from ``rng``, by default a generator of fixed seed: the same model gives the same answer.
        It is 0 where nothing is known of the motion. Raises ValueError for a negative duration or limit.
        """
        if not duration_s >= 0:
            raise ValueError("duration_s: must not be negative")
        if not rate_limit_mps > 0 or (height_band_m is not None and not height_band_m > 0):
            raise ValueError("rate_limit_mps and height_band_m: must be positive")
        c = self.coefficients
        if not math.isfinite(c.variance_m2) or not math.isfinite(c.rate_variance_m2ps2):
            return 0.0
        generator = rng if rng is not None else np.random.default_rng(0)
        return forecasting.quiescent(
            c, start_s, duration_s, rate_limit_mps, height_band_m, samples, generator
        )

    def band_pass(
        self, *, blocks: int = 1, previous: BandPass | None = None, lowest_hz: float = 0.0
    ) -> BandPass:
        """State-space block of the learned spectrum with the motion's standard deviation; ``bhr`` only.

        ``blocks`` is 1 for six states, 2 for eight; ``previous`` is where the search begins. What is slower than
        ``lowest_hz`` is left out. Raises ``ValueError`` where there is no motion.
        """
        density = np.where(self.frequency_hz >= lowest_hz, self.density_m2ps, 0.0)
        if not np.any(density > 0):
            raise ValueError("there is no motion to fit a block to")
        scale = self.coefficients.variance_m2 / float(self.power_m2.sum())
        return fit_band_pass(
            self.frequency_hz, scale * density, self.noise_density_m2ps, blocks=blocks, previous=previous
        )

    def _level(self) -> tuple[float, float]:
        c = self.coefficients
        column = c.basis.values(np.zeros(1))[0, c.level]
        variance = column @ c.covariance[np.ix_(c.level, c.level)] @ column
        return c.offset_m + float(column @ c.mean[c.level]), float(variance)


def fit(
    t_s: ArrayLike,
    heave_m: ArrayLike,
    sigma_m: ArrayLike,
    *,
    method: Method = "bhr",
    components: int = 3,
    window_s: float = WINDOW_S,
    settings: SpectrumSettings | None = None,
    previous: HeaveModel | None = None,
    wander: Density | None = None,
) -> HeaveModel:
    """Fit a heave model to a series.

    ``t_s`` (n,) [s], oldest first, irregular; ``heave_m`` (n,) [m], up positive; ``sigma_m`` 1 sigma [m],
    scalar or (n,). Methods: ``bhr`` learns a smooth spectrum (``estimation.heave.spectrum``); ``sinusoids``
    is the plain sum of ``components`` sinusoids by least squares; ``mean`` only the level. Samples older than
    ``window_s`` before the last are not used. ``previous`` lets ``bhr`` start its search from an earlier
    model. ``wander`` tells ``bhr`` of noise that is not white, such as the wander of a vehicle that the heave is
    seen from: its one-sided density [m^2/Hz], a function of frequencies (m,) [Hz].

    A series too short for a model (one sample, less than 5 s, fewer than 16 bins) gives ``method="mean"``
    with the reason; nothing is known about a motion never seen, so its variance is then infinite unless
    ``previous`` tells it. Raises ValueError naming the argument that cannot be used.
    """
    if method not in {"bhr", "sinusoids", "mean"}:
        raise ValueError(f"method: {method!r} is not known; use 'bhr', 'sinusoids' or 'mean'")
    if components < 1:
        raise ValueError("components: must be at least 1")
    settings = settings or SpectrumSettings()
    window = cut_window(t_s, heave_m, sigma_m, window_s=window_s)
    reason = _too_little(window, settings)
    learned = None
    with one_thread():
        if reason or method == "mean":
            method = "mean"
            coefficients = _level_only(window, reason, previous)
        elif method == "sinusoids":
            coefficients = fit_sinusoids(window, components, settings.lowest_hz, settings.highest_hz)
        else:
            learned = learn(window, settings, previous.learned if previous is not None else None, wander)
            coefficients = _of_spectrum(window, learned, settings)
    return HeaveModel(
        method,
        reason,
        window.last_s,
        window.span_s,
        window.samples,
        window.dropped,
        coefficients,
        window.noise_density_m2ps * (learned.noise_scale**2 if learned is not None else 1.0),
        learned,
    )


def _too_little(window: Window, settings: SpectrumSettings) -> str:
    """Why the series cannot carry a model, or nothing."""
    if window.samples == 1:
        return "one sample only"
    if window.span_s < SHORTEST_SPAN_S or len(window.time_s) < FEWEST_BINS:
        return f"{len(window.time_s)} bins over {window.span_s:.1f} s are too few"
    if 0.45 / window.interval_s < 4.0 * settings.lowest_hz:
        return f"samples every {window.interval_s:.1f} s are too far apart"
    return ""


def _level_only(window: Window, reason: str, previous: HeaveModel | None) -> Coefficients:
    """The mean predictor: motion as scattered as in the series, or as ``previous`` knew where it is too
    short.
    """
    if previous is not None and reason:
        variance, rate = previous.coefficients.variance_m2, previous.coefficients.rate_variance_m2ps2
    elif reason:
        variance = rate = math.inf
    else:
        variance, rate = window.signal_variance_m2, math.inf
    level_variance = 1.0 / float(np.sum(1.0 / window.variance_m2))
    if math.isfinite(variance):
        level_variance += variance / max(1.0, window.span_s / 10.0)
    return Coefficients(
        Basis(np.zeros(0)),
        np.zeros(1),
        np.full((1, 1), level_variance),
        window.offset_m,
        variance,
        rate,
        -math.inf,
    )


def _of_spectrum(window: Window, learned: LearnedSpectrum, settings: SpectrumSettings) -> Coefficients:
    """The learned coefficients. The motion's own variance is the larger of the spectrum's and that seen.

    A smooth spectrum holds less than a regular motion has: its harmonics then add up in phase.
    """
    omega = 2.0 * np.pi * learned.basis.frequency_hz
    harmonics = learned.mean.copy()
    harmonics[2 * len(omega) :] = 0.0
    time = np.linspace(-window.span_s, 0.0, max(16, int(4.0 * window.span_s)))
    columns, m = learned.basis.values(time), len(omega)
    cosine, sine = harmonics[:m], harmonics[m : 2 * m]
    heave = columns @ harmonics
    rate = columns[:, : 2 * m] @ np.concatenate([omega * sine, -omega * cosine])
    return Coefficients(
        learned.basis,
        learned.mean,
        learned.covariance,
        window.offset_m,
        max(float(learned.power_m2.sum()), float(np.mean(heave**2))),
        max(float(learned.power_m2 @ omega**2), float(np.mean(rate**2))),
        settings.horizon_s + 0.5 * grid_span(window),
    )


def _explained(motion: Array, time: Array, frequency: Array, growth: float) -> Array:
    """Return how much of motion (n,) at times (n,) [s] a sinusoid whose amplitude grows, and a constant, explain: for
    each frequency (f,) [Hz] the squared length of its projection, (f,).
    """
    envelope = 1.0 + growth * ((time - time.mean()) / (time.max() - time.min()))
    angle = 2.0 * np.pi * frequency[:, None] * time
    columns = np.stack([envelope * np.cos(angle), envelope * np.sin(angle), np.ones_like(angle)], axis=1)
    right = columns @ motion
    out: Array = np.sum(
        right * np.linalg.solve(columns @ columns.swapaxes(1, 2), right[..., None])[..., 0], axis=1
    )
    return out
