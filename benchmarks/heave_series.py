"""Seas for the heave benchmark: real buoy records scaled to a small raft's sea, and simulated ones.

A raft 2 m long follows a wave of wave number k by sinc(k) of its height, and heaves with a natural period of
1.4 s and a quarter of critical damping. A deep-water record is scaled to another height by Froude's law: lengths
by a factor, times by its root.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.signal import welch

from simulation.sea import jonswap

Array = NDArray[np.float64]

HORIZONS_S = np.array([0.0, 0.5, 1.0, 2.0, 3.0, 5.0, 10.0])
BUOY_HZ = 1.28
GRAVITY = 9.80665
SIMULATED: dict[str, list[tuple[float, float, float]]] = {
    "swell 0.15 m / 9 s": [(0.15, 9.0, 6.0)],
    "JONSWAP 0.10 m / 2.0 s": [(0.10, 2.0, 3.3)],
    "JONSWAP 0.25 m / 2.8 s": [(0.25, 2.8, 3.3)],
    "JONSWAP 0.60 m / 3.9 s": [(0.60, 3.9, 3.3)],
    "PM 0.60 m / 3.9 s": [(0.60, 3.9, 1.0)],
    "0.5 m / 3.9 s + swell 0.4 m / 9 s": [(0.5, 3.9, 3.3), (0.4, 9.0, 6.0)],
}
"""Significant height [m], peak period [s] and peakedness of the waves that the raft is put on."""


@dataclass(frozen=True, slots=True)
class Observation:
    """What vision sees of one window, what happened after it, and the true one-sided density of the heave.

    Times count from the last sample. ``truth_m`` at ``HORIZONS_S``; ``sd_m`` of the heave of the whole record.
    """

    time_s: Array
    heave_m: Array
    sigma_m: float
    truth_m: Array
    sd_m: float
    frequency_hz: Array
    density: Array


def find_data() -> Path | None:
    """Folder of real records: $DECKFIX_DATA, or the shared data beside the repository."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    path = Path(os.environ.get("DECKFIX_DATA") or beside) / "waverider"
    return path if path.is_dir() else None


def raft_response(frequency_hz: Array) -> NDArray[np.complex128]:
    """Heave of the raft over the height of the wave, at ``frequency_hz`` (m,)."""
    wave_number = (2.0 * np.pi * frequency_hz) ** 2 / GRAVITY
    ratio = frequency_hz * 1.4
    response = np.sinc(wave_number / np.pi) / (1.0 - ratio**2 + 0.5j * ratio)
    return np.asarray(response, np.complex128)


def load_buoy(path: Path) -> Array:
    """Heave [m] of a Datawell raw file (status, heave, north, west in cm), samples with a bad status left out."""
    rows = np.loadtxt(path, delimiter=",")
    return np.asarray(rows[rows[:, 0] == 0, 1] / 100.0, np.float64)


def raft_record(heave_m: Array, hs_m: float = 0.6) -> tuple[Array, Array]:
    """Froude-scale a buoy's record to ``hs_m``, put the raft on it, and resample 16 times as fast: times, heave.

    Band-limited: the resampling pads the spectrum with zeros. Nothing below 0.02 Hz is kept.
    """
    heave = heave_m - heave_m.mean()
    scale = hs_m / (4.0 * heave.std())
    rate = BUOY_HZ / np.sqrt(scale)
    n = len(heave)
    spectrum = np.fft.rfft(scale * heave) * raft_response(np.fft.rfftfreq(n, 1.0 / rate))
    spectrum[np.fft.rfftfreq(n, 1.0 / rate) < 0.02] = 0.0
    padded = np.zeros(8 * n + 1, np.complex128)
    padded[: len(spectrum)] = spectrum
    return np.arange(16 * n) / (16.0 * rate), 16.0 * np.fft.irfft(padded, 16 * n)


def observe(rng: np.random.Generator, span_s: float, rate_hz: float = 20.0, dropped: float = 0.1) -> Array:
    """Times of vision fixes over ``span_s``, some of them dropped; the last one is at 0."""
    times = -np.arange(int(span_s * rate_hz), -1, -1) / rate_hz
    kept = times[rng.random(len(times)) >= dropped]
    return np.asarray(kept - kept[-1], np.float64)


def real_windows(
    folder: Path, per_record: int, span_s: float, sigma_m: float, seed: int
) -> Iterator[Observation]:
    """Windows spread over each record of a folder, with the whole record's Welch density as the truth."""
    rng = np.random.default_rng(seed)
    for path in sorted(folder.glob("*.raw")):
        time, heave = raft_record(load_buoy(path))
        rate = 1.0 / (time[1] - time[0])
        length = int(64.0 * rate)
        frequency, density = welch(heave, rate, nperseg=length, noverlap=length // 2)
        band = frequency < 1.5
        curve = CubicSpline(time, heave)
        latest = time[-1] - HORIZONS_S[-1] - 3.0
        for centre in np.linspace(span_s + 5.0, latest, per_record):
            end = float(np.clip(centre + rng.uniform(-2.0, 2.0), span_s + 1.0, latest))
            t = observe(rng, span_s)
            measured = curve(end + t) + rng.normal(0.0, sigma_m, len(t))
            truth = curve(end + HORIZONS_S)
            yield Observation(t, measured, sigma_m, truth, float(heave.std()), frequency[band], density[band])


def simulated_windows(
    waves: list[tuple[float, float, float]], trials: int, span_s: float, sigma_m: float, seed: int
) -> Iterator[Observation]:
    """Independent Gaussian seas of a known density."""
    rng = np.random.default_rng(seed)
    spacing = 0.002
    frequency = np.arange(0.02, 1.5, spacing)
    omega = 2.0 * np.pi * frequency
    sea = sum((2.0 * np.pi * jonswap(omega, *wave) for wave in waves), np.zeros_like(omega))
    density = sea * np.abs(raft_response(frequency)) ** 2
    sd = float(np.sqrt(density.sum() * spacing))
    for _ in range(trials):
        jittered = 2.0 * np.pi * (frequency + rng.uniform(-0.5, 0.5, len(frequency)) * spacing)
        amplitude = np.sqrt(density * spacing) * rng.standard_normal((2, len(frequency)))
        t = observe(rng, span_s)
        angle = np.outer(np.concatenate([t, HORIZONS_S]), jittered)
        heave = np.cos(angle) @ amplitude[0] + np.sin(angle) @ amplitude[1]
        measured = heave[: len(t)] + rng.normal(0.0, sigma_m, len(t))
        yield Observation(t, measured, sigma_m, heave[len(t) :], sd, frequency, density)
