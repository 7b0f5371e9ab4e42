"""Chapter 5 of the thesis again: its experiments on rendered pictures, for its own method and for ``rings``.

    python benchmarks/thesis.py [--quick] [--json FILE]

Camera: Raspberry Pi Camera v2, whole view at 640x480. Target: six equally spaced contours, 0.21 m (the thesis
does not say; see ``vision.target.THESIS_DIAMETER_M``). Every pose is drawn several times, each time displaced
by up to 3 mm and turned by up to 0.2 deg with the truth going along, as a rig is never quite where it should
be, so that the pixel grid does not favour a pose; sensor noise is 3 of 255. Metrics: (5.1) mean of | |truth|
- |estimate| |, (5.2) the same in percent of |truth|, (5.3) red pixels in a box against those in the reference
light.
"""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from thesis_tables import STATED, TRIALS, poses, reported

from estimation.frames import R_CB_NOMINAL, euler_to_quat, quat_to_matrix
from simulation.renderer import Conditions, Renderer, Scene
from vision.camera import Camera
from vision.detector import TargetDetector, VisionFix
from vision.redness import HSV_SETS, RGB_SETS, red_by_hsv, red_by_rgb
from vision.target import RingTarget
from vision.thesis import ContourFilter, extremes, passes_filter, thesis_detect, trace_contours

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Detect = Callable[[Image, Array], Array | None]
"""From a picture and R_nc to P^c, or None."""

NOISE = Conditions(read_noise=3.0)

LIGHTS: dict[str, Conditions] = {
    "1 normal": NOISE,
    "2 dusk": replace(NOISE, light=0.12),
    "3 dim": replace(NOISE, light=0.35),
    "4 bright": replace(NOISE, light=1.3),
    "5 over-exposed": replace(NOISE, light=1.9),
    "6 warm lamp": replace(NOISE, cast_rgb=(1.15, 0.95, 0.6)),
    "7 cold sky": replace(NOISE, cast_rgb=(0.8, 0.97, 1.25)),
    "8 green tube": replace(NOISE, cast_rgb=(0.88, 1.12, 0.85)),
    "9 half shadow": replace(NOISE, shadow=0.35),
    "10 cold deep shadow": replace(NOISE, shadow=0.15, cast_rgb=(0.85, 0.98, 1.2)),
    "11 reflection": replace(NOISE, glare=0.8, glare_radius=0.35),
    "12 sun on half": replace(NOISE, light=2.2, shadow=0.3, cast_rgb=(1.1, 1.0, 0.85)),
}
"""Twelve lights in place of the photographs of appendix A; the first is the reference."""


def turn(angles_deg: ArrayLike) -> Array:
    """Return R_nb of roll, pitch and yaw [deg]."""
    roll, pitch, yaw = np.radians(angles_deg)
    return np.asarray(quat_to_matrix(euler_to_quat(roll, pitch, yaw)))


def rotation(roll_deg: float, pitch_deg: float, yaw_deg: float = 0.0) -> Array:
    """Return R_nc of a camera mounted as in seed (2.8)."""
    return np.asarray(turn([roll_deg, pitch_deg, yaw_deg]) @ R_CB_NOMINAL.T)


def methods(camera: Camera, target: RingTarget) -> dict[str, Detect]:
    """Return the methods to be compared."""
    rings = TargetDetector(camera, target)

    def by_rings(image: Image, R_nc: Array) -> Array | None:
        fix = rings.detect(image, R_nc)
        return fix.position_cam_m if isinstance(fix, VisionFix) else None

    def by_thesis(image: Image, R_nc: Array) -> Array | None:
        return thesis_detect(camera, target, image, R_nc).position_cam_m

    return {"thesis": by_thesis, "rings": by_rings}


class Bench:
    """One camera, one target, one deck, and repeated draws of a pose."""

    def __init__(self, draws: int, seed: int = 5) -> None:
        self.camera = replace(Camera.preset("rpi-v2-640x480"), readout_s=0.0)
        self.target = RingTarget.thesis()
        self.renderer = Renderer(self.camera, self.target, Scene(deck_m=0.8))
        self.methods = methods(self.camera, self.target)
        self.draws = draws
        self.rng = np.random.default_rng(seed)

    def measure(
        self, R_nc: Array, truth_m: Array, light: Conditions = NOISE, sigma_deg: float = 0.0
    ) -> Array:
        """Return truth and estimate of P_rel^n, shape (methods, draws, 2, 3); NaN where nothing was found.

        ``sigma_deg`` is the error of the attitude that the methods are told.
        """
        out = np.full((len(self.methods), self.draws, 2, 3), np.nan)
        for draw in range(self.draws):
            attitude = turn(self.rng.uniform(-0.2, 0.2, 3)) @ R_nc
            position = truth_m + self.rng.uniform(-0.003, 0.003, 3)
            image = self.renderer.render(attitude, position, self.rng, light)
            told = turn(sigma_deg * self.rng.standard_normal(3)) @ attitude
            for k, detect in enumerate(self.methods.values()):
                found = detect(image, told)
                out[k, draw, 0] = position
                if found is not None:
                    out[k, draw, 1] = -told @ found
        return out

    def compare(self, runs: list[Array], axes: str = "XYZ") -> dict[str, Any]:
        """Return metrics (5.1) and (5.2) by method and axis; runs as ``measure`` gives them."""
        every = np.concatenate(runs, axis=1)
        result: dict[str, Any] = {}
        for k, name in enumerate(self.methods):
            truth, estimate = every[k, :, 0], every[k, :, 1]
            found = np.isfinite(estimate[:, 0])
            result[name] = {"detected": float(found.mean()), "n": int(found.size)}
            for axis in axes:
                i = "XYZ".index(axis)
                result[name][axis] = metrics(truth[found, i], estimate[found, i])
        return result


def metrics(truth: Array, estimate: Array) -> dict[str, float]:
    """Return (5.1) [m] and (5.2) [%], mean, 95th percentile and largest; percent only where |truth| is a
    centimetre or more.
    """
    error = np.abs(np.abs(truth) - np.abs(estimate))
    far = np.abs(truth) >= 0.01
    percent = 100.0 * error[far] / np.abs(truth[far])
    return {
        "mean_m": float(error.mean()) if error.size else math.nan,
        "max_m": float(error.max()) if error.size else math.nan,
        "mean_percent": float(percent.mean()) if percent.size else math.nan,
        "p95_percent": float(np.percentile(percent, 95.0)) if percent.size else math.nan,
        "max_percent": float(percent.max()) if percent.size else math.nan,
    }


def illumination(bench: Bench) -> dict[str, Any]:
    """Seed 5.4.1: metric (5.3) of all threshold sets under twelve lights, and the errors of the methods
    beside it.
    """
    R_nc, position = rotation(0.0, 0.0), np.array([0.0, 0.0, -0.6])
    outer = extremes_of_target(bench, R_nc, position)
    box = (slice(outer[2] - 4, outer[3] + 5), slice(outer[0] - 4, outer[1] + 5))
    pictures = {
        name: bench.renderer.render(R_nc, position, bench.rng, light)[box] for name, light in LIGHTS.items()
    }
    sets: dict[str, Callable[[Image], NDArray[np.bool_]]] = {}
    for name, hsv in HSV_SETS.items():
        sets[f"HSV {name}"] = partial(red_by_hsv, thresholds=hsv)
    for name, rgb in RGB_SETS.items():
        sets[f"RGB {name}"] = partial(red_by_rgb, thresholds=rgb)
    pixels: dict[str, Any] = {}
    for name, test in sets.items():
        count = np.array([np.count_nonzero(test(picture)) for picture in pictures.values()])
        pixels[name] = [float(e) for e in 100.0 * np.abs(1.0 - count[1:] / max(count[0], 1))]
    pose = {
        name: bench.compare([bench.measure(R_nc, position, light)], "Z") for name, light in LIGHTS.items()
    }
    return {"lights": list(LIGHTS)[1:], "error_percent": pixels, "pose": pose}


def extremes_of_target(bench: Bench, R_nc: Array, position: Array) -> tuple[int, int, int, int]:
    """Return least and greatest u and v of the target [px] when it is seen from straight above."""
    centre = -R_nc.T @ position
    u, v = bench.camera.project(centre)
    radius = bench.camera.fx * bench.target.edges_m[0] / centre[2]
    return math.floor(u - radius), math.ceil(u + radius), math.floor(v - radius), math.ceil(v + radius)


def contour_filter(bench: Bench) -> dict[str, Any]:
    """Seed 5.4.2: what passes the contour filter, and what becomes of the position, with red clutter and
    without.
    """
    frames = 6 * bench.draws
    as_printed = ContourFilter(max_offset=math.inf, max_uneven=math.inf)
    result: dict[str, Any] = {}
    for name, light in (("clean", NOISE), ("with red clutter", replace(NOISE, distractors=8))):
        counts = {"traced": 0, "passed": 0, "passed_not_of_target": 0}
        runs: dict[str, list[float]] = {"thesis as printed": [], "thesis": [], "rings": []}
        for _ in range(frames):
            roll, pitch, yaw = bench.rng.uniform(-1.0, 1.0, 3) * (5.0, 5.0, 180.0)
            R_nc = rotation(roll, pitch, yaw)
            height = bench.rng.uniform(0.5, 1.5)
            position = -R_nc @ (np.array([*bench.rng.uniform(-0.2, 0.2, 2), 1.0]) * height)
            image = bench.renderer.render(R_nc, position, bench.rng, light)
            mask = red_by_rgb(image).astype(np.uint8) * np.uint8(255)
            traced = trace_contours(mask)
            passed = [c for c in traced if passes_filter(c, float(mask.size), as_printed)]
            counts["traced"] += len(traced)
            counts["passed"] += len(passed)
            u, v = bench.camera.project(-R_nc.T @ position)
            for c in passed:
                b = extremes(c)
                aside = math.hypot(0.5 * (b.u_min + b.u_max) - u, 0.5 * (b.v_min + b.v_max) - v)
                counts["passed_not_of_target"] += aside > 10.0
            printed = thesis_detect(bench.camera, bench.target, image, limits=as_printed).position_cam_m
            found = {"thesis as printed": printed}
            found.update({method: detect(image, R_nc) for method, detect in bench.methods.items()})
            for method, place in found.items():
                depth = np.nan if place is None else 100.0 * abs(place[2] / (-R_nc.T @ position)[2] - 1.0)
                runs[method].append(float(depth))
        result[name] = {key: count / frames for key, count in counts.items()}
        for method, errors in runs.items():
            e = np.array(errors)
            known = e[np.isfinite(e)]
            result[name][method] = {
                "detected": float(np.isfinite(e).mean()),
                "median_percent": float(np.median(known)) if known.size else math.nan,
                "wrong_by_10_percent": float((known > 10.0).sum() / frames),
            }
    return result


def vertical(bench: Bench) -> dict[str, Any]:
    """Seed 5.5.2: 0.2 to 2 m in steps of 0.1 m, straight above."""
    R_nc = rotation(0.0, 0.0)
    heights = np.linspace(0.2, 2.0, 19)
    runs = [bench.measure(R_nc, np.array([0.0, 0.0, -height])) for height in heights]
    result = bench.compare(runs, "Z")
    for name in bench.methods:
        one = [bench.compare([run], "Z")[name]["Z"]["mean_percent"] for run in runs]
        result[name]["by_height"] = {f"{h:.1f}": e for h, e in zip(heights, one, strict=True)}
    return result


def horizontal(bench: Bench) -> dict[str, Any]:
    """Seed 5.5.3: +-0.3 m in steps of 0.05 m at 0.8 m, along each axis of the picture; the camera is turned
    for y.
    """
    result = {}
    for axis, yaw in (("X", 90.0), ("Y", 0.0)):
        R_nc = rotation(0.0, 0.0, yaw)
        i = "XY".index(axis)
        runs = []
        for offset in np.linspace(-0.3, 0.3, 13):
            position = np.array([0.0, 0.0, -0.8])
            position[i] = offset
            runs.append(bench.measure(R_nc, position))
        result[axis] = bench.compare(runs, axis)
    return result


def attitude(bench: Bench, sigma_deg: float = 0.0) -> dict[str, Any]:
    """Seed 5.6: the poses of Tables 5.5 to 5.7, with errors of the attitude as its IMU had (5.6.4) or
    none.
    """
    result: dict[str, Any] = {}
    for trial in TRIALS:
        angles, truths = poses(trial)
        runs = [
            bench.measure(rotation(*np.degrees(angle)), truth, sigma_deg=sigma_deg)
            for angle, truth in zip(angles, truths, strict=True)
        ]
        result[trial] = bench.compare(runs)
        estimate, truth = reported(trial)
        result[trial]["reported"] = {
            axis: metrics(truth[:, i], estimate[:, i]) for i, axis in enumerate("XYZ")
        }
    return result


def experiments(draws: int) -> Iterator[tuple[str, dict[str, Any]]]:
    """Run all experiments and yield their names and results."""
    bench = Bench(draws)
    yield "illumination", illumination(bench)
    yield "contour_filter", contour_filter(bench)
    yield "vertical", vertical(bench)
    yield "horizontal", horizontal(bench)
    yield "attitude", attitude(bench)
    yield "attitude_0.5deg", attitude(bench, 0.5)


def show(name: str, result: dict[str, Any]) -> None:
    """Print one experiment as a table."""
    print(f"\n== {name.replace('_', ' ')}")
    if name == "illumination":
        print(f"metric (5.3) [%] against normal light; the thesis for RGB G: {STATED['illumination, set G']}")
        print("set     mean    max  " + " ".join(f"{light.split()[0]:>5}" for light in result["lights"]))
        for key, errors in result["error_percent"].items():
            print(
                f"{key}  {np.mean(errors):6.1f} {np.max(errors):6.1f}  "
                + " ".join(f"{e:5.1f}" for e in errors)
            )
        print("(5.2) of Z [%], mean, by light:")
        for light, each in result["pose"].items():
            row = (
                f"{m} {r['Z']['mean_percent']:6.3f} ({100 * r['detected']:.0f} %)" for m, r in each.items()
            )
            print(f"  {light:20} " + "   ".join(row))
        return
    if name == "contour_filter":
        for noise, each in result.items():
            print(
                f"{noise}: {each['traced']:.1f} contours a frame, {each['passed']:.1f} pass the filter, "
                f"{each['passed_not_of_target']:.2f} of them not the target's"
            )
            for method in ("thesis as printed", "thesis", "rings"):
                r = each[method]
                wrong = f"more than 10 % wrong in {100 * r['wrong_by_10_percent']:.1f} %"
                error = f"error of Z: median {r['median_percent']:.3f} %, {wrong}"
                print(f"  {method:18} found {100 * r['detected']:5.1f} %, {error}")
        return
    print("(5.1) mean [mm], (5.2) mean (95th percentile, largest) [%]")
    groups = {"": result} if name == "vertical" else result
    for group, each in groups.items():
        for method, r in each.items():
            found = (
                f"found {100 * r['detected']:5.1f} % of {r['n']}"
                if "detected" in r
                else "thesis's tables    "
            )
            cells = []
            for axis, e in ((axis, r[axis]) for axis in "XYZ" if axis in r):
                percent = f"{e['mean_percent']:6.3f} % ({e['p95_percent']:.2f}, {e['max_percent']:.2f})"
                cells.append(f"{axis} {e['mean_m'] * 1e3:7.3f} mm {percent}")
            print(f"{group:15} {method:9} {found:20} " + "   ".join(cells))
    stated = STATED.get(name.removesuffix("_0.5deg"))
    if stated:
        print(f"the thesis states: {stated}")


def without_nan(value: Any) -> Any:
    """Return the results with null for what was not measured: JSON has no NaN."""
    if isinstance(value, dict):
        return {key: without_nan(each) for key, each in value.items()}
    if isinstance(value, list):
        return [without_nan(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="two draws of each pose instead of ten")
    parser.add_argument("--json", metavar="FILE", help="write all results")
    arguments = parser.parse_args()
    results = {}
    for name, result in experiments(2 if arguments.quick else 10):
        show(name, result)
        results[name] = result
    if arguments.json:
        record = {
            "benchmark": "thesis",
            "draws": 2 if arguments.quick else 10,
            "results": without_nan(results),
        }
        Path(arguments.json).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
