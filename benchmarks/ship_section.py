"""A real floating ship section: period of its heave, and the offset between its camera and its accelerometers.

    python benchmarks/ship_section.py [--json FILE]

A camera tracked heave and roll; two accelerometers, to starboard and to port, felt both. The camera's stamps are known
to be off by an amount that nobody stated. The heave model of ``estimation.heave`` is fitted to heave and to roll as the
camera saw them and differentiated twice. Half the sum of the accelerometers is the heave's acceleration, half their
difference the roll's times a lever arm:

    (sb + ps) / 2 = a z''(t + latency) + noise, a > 0        (sb - ps) / 2 = b roll''(t + latency) + noise

Were both mixed freely, two motions a quarter of a period apart could imitate any delay. The latency is positive where
the camera's content is older than its stamp, as everywhere: t_content = t_stamp - latency. Waves of one period look
the same a whole period later: the likelihood has a peak at every period, and only the slow change of the waves' height
tells them apart. All peaks are printed with their probability (flat prior). A factor a near 1 says that camera and
accelerometers agree on the size of the motion.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from realdata import data_folder, table
from targets import Target, Targets, provenance

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
    """Log likelihood over the latency, its peaks (best first), and there the factor of heave and the share of the
    variance of heave and of roll that is left."""

    latency_s: Array
    log_likelihood: Array
    peaks: list[Peak]
    factor: float
    unexplained: tuple[float, float]


def second_derivatives(model: heave.HeaveModel, t_s: Array, latency_s: Array) -> Array:
    """Return the acceleration (n, k) of a model's harmonics at times (n,) of its series, each latency (k,) later."""
    omega = 2.0 * np.pi * model.frequency_hz
    m = len(omega)
    a, b = (omega**2 * part for part in (model.coefficients.mean[:m], model.coefficients.mean[m : 2 * m]))
    angle = np.outer(t_s - model.last_s, omega)
    turn = np.outer(omega, latency_s)
    along = a[:, None] * np.cos(turn) + b[:, None] * np.sin(turn)
    across = b[:, None] * np.cos(turn) - a[:, None] * np.sin(turn)
    out: Array = -(np.cos(angle) @ along) - np.sin(angle) @ across
    return out


def profile(t_s: Array, measured: list[Array], models: list[heave.HeaveModel]) -> Profile:
    """Return the profile of the likelihood over the latency, factors and noise maximised for each.

    ``measured`` and ``models`` are in pairs, heave first, whose factor must be positive.
    """
    grid = np.arange(-REACH_S, REACH_S + STEP_S / 2, STEP_S)
    factor = np.empty((len(models), len(grid)))
    left = np.empty((len(models), len(grid)))
    expected = []
    for row, (model, y) in enumerate(zip(models, measured, strict=True)):
        x = second_derivatives(model, t_s, grid)
        x = x - x.mean(axis=0)
        expected.append(x)
        factor[row] = (x.T @ y) / np.sum(x * x, axis=0)
        if row == 0:
            factor[row] = np.maximum(factor[row], 0.0)
        left[row] = np.sum((y[:, None] - factor[row] * x) ** 2, axis=0)
    best = int(np.argmin(np.log(left).sum(axis=0)))
    counts = [independent(y - factor[row, best] * expected[row][:, best]) for row, y in enumerate(measured)]
    value = -0.5 * sum(n * np.log(row) for n, row in zip(counts, left, strict=True))
    share = left[:, best] / [float(y @ y) for y in measured]
    return Profile(
        grid, value, _peaks(grid, value), float(factor[0, best]), (float(share[0]), float(share[1]))
    )


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
    starboard, port = (columns[name][use][::every][inside] for name in ACCELEROMETERS)
    measured = [0.5 * (starboard + port), 0.5 * (starboard - port)]
    measured = [y - y.mean() for y in measured]
    whole = profile(t[inside], measured, models)
    parts = []
    for rows in np.array_split(np.arange(int(inside.sum())), PARTS):
        part = profile(t[inside][rows], [y[rows] - y[rows].mean() for y in measured], models)
        near = min(part.peaks, key=lambda p: abs(p.latency_s - whole.peaks[0].latency_s))
        parts.append(near.latency_s)
    return models[0], whole, np.array(parts)


def main() -> int:
    """Print the tables; returns 0, or 1 where the stated period is missed."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    targets = Targets()
    folder = data_folder()
    if folder is None or not (folder / "ship_section").is_dir():
        print("no recordings: set DECKFIX_DATA")
        return 0
    for name, period in RECORDS.items():
        model, found, parts = examine(folder / "ship_section" / f"{name}.csv.gz")
        stated = (
            f"stated {period:.2f} s, {100 * (model.dominant_period_s / period - 1):+.1f} %"
            if period
            else "not stated"
        )
        if period:
            off = abs(model.dominant_period_s / period - 1.0)
            targets.add(Target(f"{name}: heave's period off by a share of", off, 0.03))
        print(
            f"{name}: heave of period {model.dominant_period_s:.3f} s ({stated}), Hs {1e3 * model.hs_m:.1f} mm"
        )
        best = found.peaks[0]
        print(
            f"  latency of the camera {1e3 * best.latency_s:+.1f} ms, 1 sigma {1e3 * best.sigma_s:.1f} ms "
            f"(positive: the content is older than its stamp); factor {found.factor:.2f}, "
            f"{100 * found.unexplained[0]:.1f} % of heave and {100 * found.unexplained[1]:.1f} % of roll unexplained"
        )
        scatter = 1e3 * float(np.std(parts, ddof=1)) / np.sqrt(PARTS)
        print(
            f"  by thirds of the record {', '.join(f'{1e3 * p:+.1f}' for p in parts)} ms: 1 sigma {scatter:.1f} ms by "
            "their scatter"
        )
        print("  ambiguous by whole periods of the waves; every peak of the likelihood (flat prior):")
        print(f"    {'latency [ms]':>13} {'periods':>8} {'log-likelihood':>15} {'probability':>12}")
        for peak in sorted(found.peaks, key=lambda p: p.latency_s):
            if peak.below > 500.0:
                continue
            turns = (peak.latency_s - best.latency_s) / model.dominant_period_s
            print(
                f"    {1e3 * peak.latency_s:+13.1f} {turns:+8.2f} {-peak.below:15.1f} {peak.probability:12.2g}"
            )
    good = targets.report()
    if options.json:
        out = {"benchmark": "ship_section", **provenance(), "targets": targets.as_rows()}
        options.json.write_text(json.dumps(out, indent=1) + "\n")
    return 0 if good else 1


if __name__ == "__main__":
    raise SystemExit(main())
