"""A real floating ship section: period of its heave, and the offset between its camera and its accelerometers.

    python benchmarks/ship_section.py

A camera tracked heave and roll, two accelerometers on the section felt both; the camera's stamps are known to be off
by an amount that nobody stated. The heave model of ``estimation.heave`` is fitted to heave and roll as the camera saw
them and differentiated twice; each accelerometer is explained by both, with free factors, for every offset:

    acc(t) = a z''(t + latency) + b roll''(t + latency) + c + noise

The latency is positive where the camera's content is older than its stamp, as everywhere: t_content = t_stamp -
latency. Waves of one period look the same a whole period later: the likelihood has a peak at every period, and only the
slow change of the waves' height tells them apart. All peaks are printed with their probability (flat prior).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from realdata import data_folder, table

from estimation import heave

Array = NDArray[np.float64]

RECORDS = {"3061_1": 1.16, "6041_1": None}
"""Record and the stated period of its waves [s], where one is stated."""
CAMERA_HZ = 20.0
FROM_S, LOWEST_HZ, HIGHEST_HZ = 15.0, 0.3, 4.0
REACH_S, STEP_S, MARGIN_S = 2.6, 0.002, 3.0
ACCELEROMETERS = ("ACC_Heave_SB [m/s2]", "ACC_HEAVE_PS [m/s2]")
PARTS = 3


@dataclass(frozen=True, slots=True)
class Peak:
    """One candidate: latency [s], 1 sigma from the curvature [s], log likelihood below the best, probability."""

    latency_s: float
    sigma_s: float
    below: float
    probability: float


@dataclass(frozen=True, slots=True)
class Profile:
    """Log likelihood over the latency, its peaks (best first), and the share of the variance that is left there."""

    latency_s: Array
    log_likelihood: Array
    peaks: list[Peak]
    unexplained: float


def second_derivative(model: heave.HeaveModel, t_s: Array) -> Array:
    """Return the acceleration of a model's harmonics at times of its series (n,)."""
    frequency = model.frequency_hz
    omega = 2.0 * np.pi * frequency
    angle = np.outer(t_s - model.last_s, omega)
    m = len(frequency)
    mean = model.coefficients.mean
    out: Array = -(np.cos(angle) @ (omega**2 * mean[:m])) - np.sin(angle) @ (omega**2 * mean[m : 2 * m])
    return out


def profile(t_s: Array, accelerations: list[Array], models: list[heave.HeaveModel]) -> Profile:
    """Return the profile of the likelihood over the latency, factors and noise maximised for each."""
    grid = np.arange(-REACH_S, REACH_S + STEP_S / 2, STEP_S)
    left = np.empty((len(accelerations), len(grid)))
    for k, latency in enumerate(grid):
        columns = [second_derivative(model, t_s + latency) for model in models]
        design = np.column_stack([*columns, np.ones(len(t_s))])
        for c, measured in enumerate(accelerations):
            left[c, k] = np.sum(residual(design, measured) ** 2)
    best = int(np.argmin(np.log(left).sum(axis=0)))
    columns = [second_derivative(model, t_s + grid[best]) for model in models]
    design = np.column_stack([*columns, np.ones(len(t_s))])
    counts = [independent(residual(design, measured)) for measured in accelerations]
    value = -0.5 * sum(n * np.log(row) for n, row in zip(counts, left, strict=True))
    total = sum(float(np.sum((a - a.mean()) ** 2)) for a in accelerations)
    return Profile(grid, value, _peaks(grid, value), float(left[:, best].sum()) / total)


def residual(design: Array, measured: Array) -> Array:
    """Return what the best factors leave."""
    return np.asarray(measured - design @ np.linalg.lstsq(design, measured, rcond=None)[0], np.float64)


def independent(values: Array) -> float:
    """Return how many independent samples a correlated residual is worth: n / (1 + 2 sum of squared correlations)."""
    n, power = len(values), float(values @ values)
    longest = min(n // 4, round(REACH_S * 2.0 / (1.0 / CAMERA_HZ)))
    correlation = np.array([values[k:] @ values[:-k] for k in range(1, longest)]) / power
    return n / (1.0 + 2.0 * float(np.sum(correlation**2)))


def _peaks(grid: Array, value: Array) -> list[Peak]:
    inner = np.flatnonzero((value[1:-1] > value[:-2]) & (value[1:-1] >= value[2:])) + 1
    found = []
    for k in inner:
        before, at, after = value[k - 1 : k + 2]
        bend = (before - 2.0 * at + after) / STEP_S**2
        shift = 0.5 * (before - after) / (before - 2.0 * at + after) * STEP_S
        found.append((float(grid[k] + shift), 1.0 / np.sqrt(-bend), float(at)))
    found.sort(key=lambda f: -f[2])
    top = found[0][2]
    weight = np.array([np.exp(f[2] - top) * f[1] for f in found])
    weight /= weight.sum()
    return [Peak(t, s, top - v, float(w)) for (t, s, v), w in zip(found, weight, strict=True)]


def examine(path: Path) -> tuple[heave.HeaveModel, Profile, Array]:
    """Return the heave's model, the profile of the whole record, and the latency by thirds of it [s].

    The thirds give the peak nearest to the whole record's: what they say of the ambiguity is in the profile.
    """
    columns = table(path)
    every = round(200.0 / CAMERA_HZ)
    use = columns["Time [s]"] >= FROM_S
    t = columns["Time [s]"][use][::every]
    settings = heave.SpectrumSettings(lowest_hz=LOWEST_HZ, highest_hz=HIGHEST_HZ)
    models = [
        heave.fit(t, columns[name][use][::every], sigma, window_s=120.0, settings=settings)
        for name, sigma in (("Heave [m]", 5e-4), ("Roll [rad]", 2e-3))
    ]
    inside = (t >= t[0] + MARGIN_S) & (t <= t[-1] - MARGIN_S)
    measured = [columns[name][use][::every][inside] for name in ACCELEROMETERS]
    whole = profile(t[inside], measured, models)
    parts = []
    for rows in np.array_split(np.arange(int(inside.sum())), PARTS):
        part = profile(t[inside][rows], [a[rows] for a in measured], models)
        near = min(part.peaks, key=lambda p: abs(p.latency_s - whole.peaks[0].latency_s))
        parts.append(near.latency_s)
    return models[0], whole, np.array(parts)


def main() -> int:
    """Print the tables; returns 0, or 1 where the stated period is missed."""
    folder = data_folder()
    if folder is None or not (folder / "ship_section").is_dir():
        print("no recordings: set DECKFIX_DATA")
        return 0
    missed = 0
    for name, period in RECORDS.items():
        model, found, parts = examine(folder / "ship_section" / f"{name}.csv.gz")
        stated = (
            f"stated {period:.2f} s, {100 * (model.dominant_period_s / period - 1):+.1f} %"
            if period
            else "not stated"
        )
        missed += bool(period) and abs(model.dominant_period_s / (period or 1.0) - 1.0) > 0.03
        print(
            f"{name}: heave of period {model.dominant_period_s:.3f} s ({stated}), Hs {1e3 * model.hs_m:.1f} mm"
        )
        best = found.peaks[0]
        print(
            f"  latency of the camera {1e3 * best.latency_s:+.1f} ms, 1 sigma {1e3 * best.sigma_s:.1f} ms "
            f"(positive: the content is older than its stamp); {100 * found.unexplained:.1f} % of the variance left"
        )
        print(f"  by thirds of the record [ms]: {', '.join(f'{1e3 * p:+.1f}' for p in parts)}")
        print("  ambiguous by whole periods of the waves; every peak of the likelihood (flat prior):")
        print(f"    {'latency [ms]':>13} {'periods':>8} {'log-likelihood':>15} {'probability':>12}")
        for peak in sorted(found.peaks, key=lambda p: p.latency_s):
            if peak.below > 500.0:
                continue
            turns = (peak.latency_s - best.latency_s) / model.dominant_period_s
            print(
                f"    {1e3 * peak.latency_s:+13.1f} {turns:+8.2f} {-peak.below:15.1f} {peak.probability:12.2g}"
            )
    return int(missed > 0)


if __name__ == "__main__":
    raise SystemExit(main())
