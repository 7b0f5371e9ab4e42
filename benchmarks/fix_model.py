"""Drawn fixes against rendered pictures: is the error model that closed-loop landings are drawn from an honest one?

Vehicles over a deck, at every distance from touchdown to the search altitude, with the attitudes of a flight and the
deck's tilt of Beaufort 2; the same moments are given to ``simulation.fixes`` (what ``benchmarks/landings.py`` flies on)
and, rendered and compressed, to ``TargetDetector`` with the attitude's error and the expectation that a flight has.

    python benchmarks/fix_model.py [--moments 200] [--seed 11] [--jobs 2] [--json FILE] [--no-gate]

For each distance: how often there is a fix, and its error across the line of sight and along it (root mean square and
95th percentile, as shares of the distance), drawn and rendered. The drawn ones carry the filter's floor, the camera's
mounting and the range scale too, which a rendered picture does not have: they must not be more favourable, in any bin.
Low over the deck this is asked once more of vehicles that are so far beside the target that its centre lies about the
picture's border or outside of it, where rings are seen in part.
False fixes (farther from the truth than a fifth of the distance, and 0.1 m) must not occur.
Exit status 1 when a target is missed, unless --no-gate is given.
"""

from __future__ import annotations

import argparse
import json
import sys
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, delayed
from targets import Target, Targets, provenance

from estimation.frames import euler_to_quat, quat_to_matrix
from simulation.exposure import expose, renderer_of
from simulation.fixes import CameraErrors, View, noisy, seen_from
from simulation.instruments import Instant
from simulation.mission import Mission, load_mission
from vision.detector import TargetDetector
from vision.fix import VisionFix

MISSION = "landing_beaufort2_2026_11"
HEIGHTS_M = (0.1, 0.15, 0.2, 0.3, 0.4, 0.6, 0.8, 1.2, 2.0, 3.5, 6.0, 10.0, 16.0)
TILT_RAD, DECK_TILT_RAD, RATE_RADPS = 0.06, 0.02, 0.1
"""1-sigma of roll and pitch, of the deck's slopes, and of the body's rate."""
MISS_M, MISS_SHARE = 0.12, 0.03
"""1-sigma of the place beside the target: constant, and a share of the height."""
ATTITUDE_RAD, EXPECTED_M, EXPECTED_SHARE = 0.004, 0.02, 0.01
"""1-sigma of the attitude that the detector is told, and of the place where it is told to look."""
BESIDE_M, BESIDE_SHARE = 0.2, 0.8
"""Largest distance beside the target of vehicles that see it in part: constant, and a share of the height."""
BESIDE_BELOW_M = 1.2
RATE_MARGIN = 0.03
"""A share of fixes that the drawn ones may have in excess, since both are counted in a finite sample."""


def moment(height: tuple[float, float], beside: bool, rng: np.random.Generator) -> Instant:
    """Draw a moment of a vehicle over the deck, at a height drawn evenly in its logarithm; ``beside`` the target."""
    h = float(np.exp(rng.uniform(*np.log(height))))
    offset = rng.normal(0.0, MISS_M + MISS_SHARE * h, 2)
    if beside:
        distance, bearing = (BESIDE_M + BESIDE_SHARE * h) * rng.uniform(0.3, 1.0), rng.uniform(-np.pi, np.pi)
        offset = distance * np.array([np.cos(bearing), np.sin(bearing)])
    q = euler_to_quat(*rng.normal(0.0, TILT_RAD, 2), rng.uniform(-np.pi, np.pi))
    normal = np.array([*rng.normal(0.0, DECK_TILT_RAD, 2), 1.0])
    place = np.array([*offset, -h])
    return Instant(
        0.0, place, np.zeros(3), q, quat_to_matrix(q), rng.normal(0.0, RATE_RADPS, 3), np.zeros(3), np.zeros(3),
        normal / np.linalg.norm(normal),
    )  # fmt: skip


def look(
    mission: Mission, height: tuple[float, float], beside: bool, count: int, seed: list[int]
) -> dict[str, np.ndarray]:
    """Return for so many moments whether there was a fix, and its errors (along, across, across) over the distance."""
    rng = np.random.default_rng(seed)
    renderer = renderer_of(mission)
    detector = TargetDetector(renderer.camera, renderer.target)
    config, view = mission.drawn.vision, View.of_target(mission.target_m)
    out: dict[str, list[Any]] = {name: [] for name in ("drawn", "rendered", "drawn_error", "rendered_error")}
    for _ in range(count):
        now = moment(height, beside, rng)
        none = np.zeros(3)
        true = seen_from(config, now.position_m[None], now.R_nb[None], now.deck_m[None], none)[0]
        errors = CameraErrors.draw(config, np.zeros(1), rng)
        shown = seen_from(config, now.position_m[None], now.R_nb[None], now.deck_m[None], errors.mount_rad)
        drawn = noisy(config, view, np.zeros(1), shown, errors, rng)
        out["drawn"].append(bool(drawn.seen[0]))
        out["drawn_error"].append(_split(drawn.position_cam_m[0], true))
        found = _rendered(renderer, detector, mission, now, true, rng)
        out["rendered"].append(found is not None)
        out["rendered_error"].append(np.full(3, np.nan) if found is None else _split(found, true))
    return {name: np.array(values) for name, values in out.items()}


def _rendered(
    renderer: Any,
    detector: TargetDetector,
    mission: Mission,
    now: Instant,
    true: np.ndarray,
    rng: np.random.Generator,
) -> np.ndarray | None:
    from deckfix.pipeline import body_to_camera, decode

    data = expose(renderer, mission.drawn.vision, now, rng, np.zeros(3))
    picture = None if data is None else decode(data)
    if picture is None:
        return None
    turned = quat_to_matrix(euler_to_quat(*rng.normal(0.0, ATTITUDE_RAD, 3)))
    R_nc = turned @ now.R_nb @ body_to_camera(mission.config).T
    distance = float(np.linalg.norm(true))
    expected = true + rng.normal(0.0, EXPECTED_M + EXPECTED_SHARE * distance, 3)
    found = detector.detect(picture, R_nc, expected, now.angular_velocity_radps)
    return found.position_cam_m if isinstance(found, VisionFix) else None


def _split(found: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Return the error along the line of sight and along two axes across it, over the distance."""
    distance = float(np.linalg.norm(true))
    ray = true / distance
    first = np.cross(ray, [1.0, 0.0, 0.0])
    first /= np.linalg.norm(first)
    error = (found - true) / distance
    return np.array([error @ ray, error @ first, error @ np.cross(ray, first)])


def summary(seen: dict[str, np.ndarray]) -> dict[str, float]:
    """Return rates and errors, drawn and rendered; errors where there was a fix."""
    out: dict[str, float] = {"n": float(len(seen["drawn"]))}
    for name in ("drawn", "rendered"):
        there = seen[name]
        e = seen[f"{name}_error"][there]
        out[f"{name}_rate"] = float(there.mean())
        for axis, part in (("along", e[:, :1]), ("across", e[:, 1:])):
            out[f"{name}_{axis}_rms"] = float(np.sqrt(np.mean(part**2))) if len(e) else float("nan")
            out[f"{name}_{axis}_p95"] = float(np.percentile(np.abs(part), 95)) if len(e) else float("nan")
    both = seen["drawn"] & ~seen["rendered"]
    out["drawn_alone"] = float(both.mean())
    return out


def false_fixes(seen: dict[str, np.ndarray], height: tuple[float, float]) -> int:
    """Return how many rendered fixes are far from the truth."""
    size = np.linalg.norm(seen["rendered_error"][seen["rendered"]], axis=1)
    return int(np.sum((size > 0.2) & (size * height[1] > 0.1)))


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--moments", type=int, default=200, help="at each distance")
    parser.add_argument("--seed", type=int, default=11)
    parser.add_argument("--jobs", type=int, default=-1)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--no-gate", action="store_true", help="exit with 0 in any case")
    a = parser.parse_args()
    mission = load_mission(MISSION)
    bins = list(pairwise(HEIGHTS_M))
    low = [b for b in bins if b[1] <= BESIDE_BELOW_M]
    over = [(b, False) for b in bins] + [(b, True) for b in low]
    jobs = (delayed(look)(mission, *each, a.moments, [a.seed, k]) for k, each in enumerate(over))
    seen = Parallel(n_jobs=a.jobs)(jobs)
    targets = Targets()
    rows = {}
    print(f"{a.moments} moments at each height; errors as shares of the distance, per mille: rms (p95)")
    print("| beside the target, seen in part")
    print("height [m]    fixes drawn rendered   along: drawn      rendered        across: drawn     rendered")
    excess, ratios, false = 0.0, [], 0
    for (b, beside), one in zip(over, seen, strict=True):
        s = summary(one)
        rows[f"{b[0]:g}-{b[1]:g}{' beside' if beside else ''}"] = s
        false += false_fixes(one, b)
        excess = max(excess, s["drawn_rate"] - s["rendered_rate"])
        if s["drawn_rate"] > 0.05 and s["rendered_rate"] > 0.05:
            ratios += [s[f"rendered_{x}_rms"] / s[f"drawn_{x}_rms"] for x in ("along", "across")]
        parts = [f"{1e3 * s[f'{n}_{x}_rms']:6.2f} ({1e3 * s[f'{n}_{x}_p95']:6.2f})"
                 for x in ("along", "across") for n in ("drawn", "rendered")]  # fmt: skip
        print(
            f"{b[0]:4g} to {b[1]:4g} {'|' if beside else ' '}  {100 * s['drawn_rate']:5.0f} % "
            f"{100 * s['rendered_rate']:6.0f} %   " + "  ".join(parts)
        )
    targets.add(Target("largest excess of the drawn rate of fixes", excess, RATE_MARGIN))
    targets.add(Target("largest ratio of the error, rendered over drawn", max(ratios), 1.0))
    targets.add(Target("false fixes", float(false), 0.0))
    met = targets.report()
    if a.json:
        document = {"benchmark": "fix_model", **provenance(), "moments": a.moments, "bins": rows,
                    "targets": targets.as_rows()}  # fmt: skip
        a.json.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    return 0 if met or a.no_gate else 1


if __name__ == "__main__":
    sys.exit(main())
