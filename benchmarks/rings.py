"""The detector against ArUco and AprilTag on one renderer: accuracy, consistency, robustness, time.

    python benchmarks/rings.py [--full] [--frames N] [--only accuracy,nees,second,robust,false,time] [--json FILE]
                               [--baseline]

Camera 640x480, 62.2 deg. Targets and markers 1.0 m (a marker's black border), on a white board; camera
calibrated, attitude known. Roll and pitch uniform in +-25 deg, any yaw, anywhere in the frame; at 1 m
neither fits whole. Markers give their pose by OpenCV's IPPE_SQUARE. Noise 3 of 255. Times are CPU time of
one thread. AprilTag is pupil-apriltags where it is installed, else OpenCV's own (DICT_APRILTAG_36h11,
CORNER_REFINE_APRILTAG).
"""

# ruff: noqa: E402
from __future__ import annotations

import argparse
import json
import math
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(variable, "1")

import cv2
import numpy as np
from marker_renderer import MarkerRenderer, marker_bits
from numpy.typing import NDArray
from raycast import Look, Raycast
from targets import Target, Targets, provenance
from vision_baseline import FILES, compare

from estimation.frames import R_CB_NOMINAL, euler_to_quat, quat_exp, quat_to_matrix
from simulation.renderer import Conditions, Renderer
from vision import Camera, NoFix, RingTarget, TargetDetector, VisionFix

Array = NDArray[np.float64]
Image = NDArray[np.uint8]
Pose = tuple[Array, Array]
"""R_nc and the true P^c."""

CAMERA = Camera.from_fov(640, 480, math.radians(62.2))
TARGETS = {"rings, equal": RingTarget.thesis(1.0), "rings, recommended": RingTarget.recommended(1.0)}
DISTANCES_M = (1.0, 2.0, 5.0, 10.0, 15.0, 20.0, 34.0)
NOISE = Conditions(read_noise=3.0)
SIDE_M = 1.0
CORNERS_M = 0.5 * SIDE_M * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]], dtype=np.float64)


def poses(rng: np.random.Generator, height_m: float, count: int, seen: float = 1.0) -> Iterator[Pose]:
    """Yield poses in which the share ``seen`` of the outermost edge is in the frame (a smaller part, if it
    must)."""
    angle = np.linspace(0.0, 2.0 * np.pi, 48, endpoint=False)
    radius, tries, made = 0.72 if seen == 1.0 else 0.5, 0, 0
    while made < count:
        roll, pitch = rng.uniform(-1.0, 1.0, 2) * math.radians(25.0)
        R_nc = quat_to_matrix(euler_to_quat(roll, pitch, rng.uniform(-np.pi, np.pi))) @ R_CB_NOMINAL.T
        x, y = CAMERA.rays(rng.uniform(0, CAMERA.width), rng.uniform(0, CAMERA.height))
        ray = np.array([float(x), float(y), 1.0])
        truth = ray * height_m / (R_nc @ ray)[2]
        circle = R_nc @ truth + radius * np.stack((np.cos(angle), np.sin(angle), 0.0 * angle), axis=1)
        u, v = CAMERA.project(circle @ R_nc)
        share = float(((u > 2) & (u < CAMERA.width - 3) & (v > 2) & (v < CAMERA.height - 3)).mean())
        tries += 1
        if tries > 400 and seen == 1.0:
            radius, tries = 0.8 * radius, 0
        if share == 1.0 if seen == 1.0 else abs(share - seen) < 0.04:
            made, tries = made + 1, 0
            yield R_nc, truth


class Aruco:
    """OpenCV's detector with sub-pixel corners."""

    def __init__(
        self, refine: int = cv2.aruco.CORNER_REFINE_SUBPIX, book: int = cv2.aruco.DICT_4X4_50
    ) -> None:
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = refine
        self.bits = marker_bits(book, 7)
        self.detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(book), parameters)

    def corners(self, image: Image) -> Array | None:
        """Return the four corners (4, 2), or None."""
        found, ids, _ = self.detector.detectMarkers(image)
        for corner, marker in zip(found, np.asarray([] if ids is None else ids).ravel(), strict=True):
            if marker == 7:
                return np.asarray(corner, dtype=np.float64).reshape(4, 2)
        return None


class AprilTag:
    """AprilTag 3 with quad_decimate 1; corners are ordered as OpenCV's."""

    def __init__(self) -> None:
        from pupil_apriltags import Detector

        self.bits = marker_bits(cv2.aruco.DICT_APRILTAG_36h11, 7)
        self.detector = Detector(families="tag36h11", nthreads=1, quad_decimate=1.0)

    def corners(self, image: Image) -> Array | None:
        """Return the four corners (4, 2), or None."""
        for tag in self.detector.detect(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)):
            if tag.tag_id == 7:
                return np.asarray(tag.corners, dtype=np.float64)
        return None


def apriltag() -> tuple[str, Any]:
    try:
        return "AprilTag 3 (d1)", AprilTag()
    except ImportError:
        book = cv2.aruco.DICT_APRILTAG_36h11
        return "AprilTag (OpenCV)", Aruco(cv2.aruco.CORNER_REFINE_APRILTAG, book)


def marker_centre(corners: Array) -> Array | None:
    """Return P^c of a marker from its corners; all orders of the corners are tried and the best fit taken."""
    matrix = CAMERA.matrix
    best: tuple[float, Array] | None = None
    for turned in [np.roll(c, k, axis=0) for c in (corners, corners[::-1]) for k in range(4)]:
        done, _, centres, errors = cv2.solvePnPGeneric(
            CORNERS_M, turned, matrix, None, flags=cv2.SOLVEPNP_IPPE_SQUARE
        )
        if done:
            error = float(np.asarray(errors).ravel()[0])
            if best is None or error < best[0]:
                best = error, np.asarray(centres[0]).ravel()
    return None if best is None else best[1]


def spread(values: list[float]) -> dict[str, float]:
    """Return rms, 95th percentile, maximum and mean of errors."""
    a = np.asarray(values)
    if not len(a):
        return {}
    return {
        "rms": float(np.sqrt(np.mean(a**2))),
        "p95": float(np.quantile(np.abs(a), 0.95)),
        "max": float(np.abs(a).max()),
        "mean": float(a.mean()),
    }


def summary(truths: list[Array], found: list[Array | None]) -> dict[str, Any]:
    """Return detection rate and errors of Z (percent of Z) and of the whole position (percent of
    distance)."""
    pairs = [(t, p) for t, p in zip(truths, found, strict=True) if p is not None]
    return {
        "n": len(truths),
        "detected": len(pairs) / len(truths),
        "z_percent": spread([100.0 * (p[2] - t[2]) / t[2] for t, p in pairs]),
        "position_percent": spread(
            [100.0 * float(np.linalg.norm(p - t)) / float(np.linalg.norm(t)) for t, p in pairs]
        ),
    }


def position(result: VisionFix | NoFix) -> Array | None:
    return result.position_cam_m if isinstance(result, VisionFix) else None


def accuracy(frames: int, targets: Targets) -> dict[str, Any]:
    """Every distance, rings and markers at the same poses."""
    tag_name, tag = apriltag()
    markers = {"ArUco 4x4, sub-pixel": Aruco(), tag_name: tag}
    rows: dict[str, Any] = {}
    print(f"\naccuracy: {frames} frames a distance; Z error in % of Z: rms (p95, max), detection")
    for height in DISTANCES_M:
        rng = np.random.default_rng(int(100 * height))
        places = list(poses(rng, height, frames))
        row: dict[str, Any] = {}
        truths = [truth for _, truth in places]
        for name, target in TARGETS.items():
            renderer, detector = Renderer(CAMERA, target), TargetDetector(CAMERA, target)
            found, nees = [], []
            for R_nc, truth in places:
                result = detector.detect(renderer.render(R_nc, -R_nc @ truth, rng, NOISE), R_nc)
                found.append(position(result))
                if isinstance(result, VisionFix):
                    nees.append(normalised(result, truth))
            row[name] = summary(truths, found) | {"nees": float(np.mean(nees)) if nees else None}
        for name, marker in markers.items():
            drawn = MarkerRenderer(CAMERA, marker.bits, SIDE_M, 1.3 * SIDE_M)
            found = []
            for R_nc, truth in places:
                corners = marker.corners(drawn.render(R_nc, -R_nc @ truth, rng, NOISE))
                found.append(None if corners is None else marker_centre(corners))
            row[name] = summary(truths, found)
        rows[f"{height:g}"] = row
        for name, cell in row.items():
            z = cell["z_percent"]
            errors = f"{z['rms']:8.4f} ({z['p95']:8.4f}, {z['max']:8.4f})" if z else f"{'-':>28}"
            print(f"{height:4g} m  {name:22} {errors} %  {100 * cell['detected']:4.0f} %")
        for name in TARGETS:
            cell = row[name]
            targets.add(Target(f"{name}, {height:g} m: detection", cell["detected"], 0.99, at_least=True))
            bound = 0.1 if height <= 15.0 else 0.5
            targets.add(Target(f"{name}, {height:g} m: Z rms %", cell["z_percent"].get("rms"), bound))
            low, high = band(cell["n"])
            targets.add(Target(f"{name}, {height:g} m: NEES above band", cell["nees"], high))
            targets.add(Target(f"{name}, {height:g} m: NEES below band", cell["nees"], low, at_least=True))
            for other in markers:
                if row[other]["z_percent"]:
                    ratio = cell["z_percent"]["rms"] / row[other]["z_percent"]["rms"]
                    targets.add(Target(f"{name}, {height:g} m: Z rms over {other}", ratio, 1.0))
    return rows


def normalised(fix: VisionFix, truth: Array) -> float:
    error = fix.position_cam_m - truth
    return float(error @ np.linalg.solve(fix.covariance_m2, error))


def band(n: int) -> tuple[float, float]:
    """Return the 95 % band of the mean NEES of n fixes with 3 degrees of freedom (normal approximation)."""
    half = 1.96 * math.sqrt(6.0 / n)
    return 3.0 - half, 3.0 + half


CASES: dict[str, tuple[Conditions, dict[str, float], float, float]] = {
    "clipped white": (replace(NOISE, light=1.5), {}, 0.0, 0.0),
    "gamma 2.2": (replace(NOISE, gamma=2.2), {}, 0.0, 0.0),
    "defocus 1.5 px": (replace(NOISE, defocus_px=1.5), {}, 0.0, 0.0),
    "motion 4 px": (replace(NOISE, motion_px=4.0, motion_angle_rad=0.6), {}, 0.0, 0.0),
    "attitude 0.5 deg": (NOISE, {"attitude_sigma_rad": math.radians(0.5)}, math.radians(0.5), 0.0),
    "focal length 0.3 %": (NOISE, {"focal_sigma": 0.003}, 0.0, 0.003),
}
"""Conditions, what the configuration states, and the errors that are made: attitude [rad], focal length."""


def consistency(frames: int, targets: Targets) -> dict[str, Any]:
    """NEES where the picture or the knowledge about the camera is imperfect."""
    rows: dict[str, Any] = {}
    print(f"\nNEES (3 dof; mean, median) with what is stated in the configuration, {frames} frames each")
    target = TARGETS["rings, equal"]
    renderer = Renderer(CAMERA, target)
    for case, (conditions, stated, attitude_rad, focal) in CASES.items():
        cells = []
        for height in (2.0, 5.0, 10.0, 20.0):
            rng = np.random.default_rng(int(100 * height) + 1)
            nees = []
            for R_nc, truth in poses(rng, height, frames):
                image = renderer.render(R_nc, -R_nc @ truth, rng, conditions)
                scale = 1.0 + focal * rng.standard_normal()
                camera = Camera(CAMERA.width, CAMERA.height, CAMERA.fx * scale, CAMERA.fy * scale)
                wrong = quat_to_matrix(quat_exp(attitude_rad * rng.standard_normal(3))) @ R_nc
                fix = TargetDetector(camera, target, **stated).detect(image, wrong)
                if isinstance(fix, VisionFix):
                    nees.append(normalised(fix, truth))
            cell = (
                {"n": len(nees), "mean": float(np.mean(nees)), "median": float(np.median(nees))}
                if nees
                else {}
            )
            rows[f"{case}, {height:g} m"] = cell
            cells.append(
                f"{height:g} m: {cell['mean']:6.2f} {cell['median']:5.2f}" if cell else f"{height:g} m: -"
            )
            targets.add(Target(f"NEES {case}, {height:g} m", cell.get("mean"), 3.5))
        print(f"{case:20} " + "   ".join(cells))
    return rows


LOOKS = {
    "second renderer": Look(),
    "second renderer, no lens blur": Look(spread_px=0.0),
    "second renderer, clipped white": Look(light=1.5),
    "second renderer, gamma 2.2": Look(gamma=2.2),
    "second renderer, JPEG quality 85": Look(jpeg=85),
    "second renderer, motion 4 px": Look(motion_px=4.0, motion_angle_rad=0.6),
}


def second_renderer(frames: int, targets: Targets) -> dict[str, Any]:
    """Errors and NEES on pictures of a renderer that shares nothing with the first (``raycast``)."""
    rows: dict[str, Any] = {}
    print(f"\nsecond renderer, {frames} frames each: detection, Z rms in % of Z, NEES")
    for name, target in TARGETS.items():
        renderer, detector = Raycast(CAMERA, target), TargetDetector(CAMERA, target)
        for case, look in LOOKS.items():
            for height in (5.0, 10.0, 20.0, 34.0):
                rng = np.random.default_rng(int(100 * height) + 4)
                truths, found, nees = [], [], []
                for R_nc, truth in poses(rng, height, frames):
                    result = detector.detect(renderer.render(R_nc, truth, rng, look), R_nc)
                    truths.append(truth)
                    found.append(position(result))
                    if isinstance(result, VisionFix):
                        nees.append(normalised(result, truth))
                cell = summary(truths, found) | {"nees": float(np.mean(nees)) if nees else None}
                rows[f"{name}, {case}, {height:g} m"] = cell
                print(
                    f"{name:20} {case:32} {height:4g} m  {100 * cell['detected']:4.0f} %  "
                    f"{cell['z_percent'].get('rms', math.nan):.4f} %  NEES {cell['nees'] or math.nan:.2f}"
                )
                clean = case == "second renderer"
                bound = band(len(nees))[1] if clean and nees else 3.5
                targets.add(Target(f"NEES {name}, {case}, {height:g} m", cell["nees"], bound))
    return rows


def _bar(rng: np.random.Generator) -> Conditions:
    return replace(NOISE, bar_px=1.0, bar_offset=rng.uniform(-0.7, 0.7), bar_angle_rad=rng.uniform(0.0, 3.14))


ROBUST: dict[str, tuple[Callable[[np.random.Generator], Conditions], float, float]] = {
    "bar 17 % of D": (_bar, 1.0, 0.95),
    "hard shadow": (
        lambda rng: replace(
            NOISE, shadow=0.4, shadow_offset=rng.uniform(-0.6, 0.6), shadow_angle_rad=rng.uniform(0.0, 6.28)
        ),
        1.0,
        0.95,
    ),
    "saturated glare": (
        lambda rng: replace(NOISE, glare=2.7, glare_offset=tuple(rng.uniform(-0.6, 0.6, 2))),
        1.0,
        0.8,
    ),
    "40 % out of frame": (lambda rng: NOISE, 0.6, 0.8),
}


def robustness(frames: int, targets: Targets) -> dict[str, Any]:
    """Detection and error where part of the target is covered."""
    rows: dict[str, Any] = {}
    print(f"\nrobustness, {frames} frames each: detection, position error in % of distance rms (max)")
    for name, target in TARGETS.items():
        renderer, detector = Renderer(CAMERA, target), TargetDetector(CAMERA, target)
        for case, (draw, seen, bound) in ROBUST.items():
            for height in (2.0, 5.0, 10.0, 20.0):
                rng = np.random.default_rng(int(10 * height) + 2)
                truths, found = [], []
                for R_nc, truth in poses(rng, height, frames, seen):
                    conditions = draw(rng)
                    if conditions.bar_px:
                        conditions = replace(
                            conditions, bar_px=0.17 * CAMERA.fx / float(np.linalg.norm(truth))
                        )
                    image = renderer.render(R_nc, -R_nc @ truth, rng, conditions)
                    truths.append(truth)
                    found.append(position(detector.detect(image, R_nc)))
                cell = summary(truths, found)
                rows[f"{name}, {case}, {height:g} m"] = cell
                p = cell["position_percent"] or {"rms": math.nan, "max": math.nan}
                print(
                    f"{name:20} {case:18} {height:4g} m  {100 * cell['detected']:4.0f} %   "
                    f"{p['rms']:.4f} ({p['max']:.4f}) %"
                )
                targets.add(Target(f"{name}, {case}, {height:g} m", cell["detected"], bound, at_least=True))
    return rows


def false_fixes(frames: int, targets: Targets) -> dict[str, Any]:
    """Pictures full of red things, and real sea, without a target."""
    count, wrong = 0, []
    detectors = {name: TargetDetector(CAMERA, target) for name, target in TARGETS.items()}
    renderer = Renderer(CAMERA, TARGETS["rings, equal"])
    rng = np.random.default_rng(77)
    for R_nc, truth in poses(rng, 10.0, frames):
        conditions = replace(
            NOISE, target=False, distractors=int(rng.integers(2, 8)), boats=int(rng.integers(0, 4))
        )
        image = renderer.render(R_nc, -R_nc @ truth, rng, conditions)
        for name, detector in detectors.items():
            count += 1
            if detector.detect(image, R_nc):
                wrong.append(name)
    print(f"\nfalse fixes: {len(wrong)} in {frames} cluttered frames x {len(detectors)} targets {wrong[:5]}")
    targets.add(Target("false fixes in clutter", float(len(wrong)), 0.0))
    data = (
        Path(os.environ.get("DECKFIX_DATA") or Path(__file__).parents[2] / "shared" / "data") / "sea_photos"
    )
    photos = sorted(data.glob("*.jpg"))
    on_sea = 0
    for photo in photos:
        image = np.asarray(cv2.imread(str(photo)), dtype=np.uint8)
        camera = Camera.from_fov(image.shape[1], image.shape[0], math.radians(62.2))
        for target in TARGETS.values():
            on_sea += sum(
                bool(TargetDetector(camera, target).detect(image, r)) for r in (None, R_CB_NOMINAL.T)
            )
    if photos:
        print(f"false fixes: {on_sea} on {len(photos)} sea photos, with and without attitude")
        targets.add(Target("false fixes on sea photos", float(on_sea), 0.0))
    else:
        print("sea photos not found: set DECKFIX_DATA")
    return {"frames": frames, "tried": count, "false": len(wrong), "photos": len(photos), "on_photos": on_sea}


def cpu_ms(work: Callable[[], object], repeats: int) -> float:
    """Return the least CPU time [ms] of a call."""
    best = math.inf
    for _ in range(repeats):
        start = time.process_time()
        work()
        best = min(best, time.process_time() - start)
    return 1e3 * best


def relative_spread(values: list[float]) -> float:
    """Return half the distance between the quartiles over the median."""
    low, middle, high = np.quantile(values, [0.25, 0.5, 0.75])
    return float(0.5 * (high - low) / middle)


def times(frames: int, targets: Targets) -> dict[str, Any]:
    """Time per frame, all in this process and one thread; the least of several calls for each frame."""
    tag_name, tag = apriltag()
    aruco = Aruco()
    rows: dict[str, Any] = {}
    print(f"\ntime per frame [ms], median over {frames} frames of the least of 7 calls")
    for height in (2.0, 5.0, 10.0):
        rng = np.random.default_rng(int(height) + 3)
        places = list(poses(rng, height, frames))
        taken: dict[str, list[float]] = {}
        markers = [
            (label, marker, MarkerRenderer(CAMERA, marker.bits, SIDE_M, 1.3 * SIDE_M))
            for label, marker in (("ArUco", aruco), (tag_name, tag))
        ]
        rings = [
            (name, Renderer(CAMERA, target), TargetDetector(CAMERA, target))
            for name, target in TARGETS.items()
        ]
        # All of a frame one after the other, so that a processor that slows down slows all.
        for R_nc, truth in places:
            for label, marker, drawn in markers:
                image = drawn.render(R_nc, -R_nc @ truth, rng, NOISE)
                least = cpu_ms(lambda i=image, m=marker: m.corners(i), 7)
                taken.setdefault(label, []).append(least)
            for name, renderer, detector in rings:
                image = renderer.render(R_nc, -R_nc @ truth, rng, NOISE)
                prior = truth * (1.0 + 0.002 * rng.standard_normal(3))
                full = cpu_ms(lambda i=image, r=R_nc, d=detector: d.detect(i, r), 7)
                tracked = cpu_ms(lambda i=image, r=R_nc, d=detector, p=prior: d.detect(i, r, p), 7)
                taken.setdefault(f"{name}: full", []).append(full)
                taken.setdefault(f"{name}: tracked", []).append(tracked)
        cell: dict[str, Any] = {name: float(np.median(values)) for name, values in taken.items()}
        spreads = {name: relative_spread(values) for name, values in taken.items()}
        for name in TARGETS:
            for limit, label, key in (
                (1.0 / 3.0, "ArUco", "full"),
                (1.0 / 10.0, tag_name, "full"),
                (1.0 / 7.0, "ArUco", "tracked"),
            ):
                ratio = cell[f"{name}: {key}"] / cell[label]
                targets.add(Target(f"{name}, {height:g} m: {key} time over {label}", ratio, limit))
        print(f"{height:4g} m  " + "  ".join(f"{k} {v:.2f}" for k, v in cell.items()))
        rows[f"{height:g}"] = cell | {"spread": spreads}
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--full", action="store_true", help="200 frames a cell, 1000 cluttered frames")
    parser.add_argument("--frames", type=int, default=None, help="frames a cell (default 25)")
    parser.add_argument("--only", default="accuracy,nees,second,robust,false,time", help="parts to run")
    parser.add_argument("--json", metavar="FILE", help="write the results")
    parser.add_argument("--baseline", action="store_true", help="fail where a committed baseline is missed")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    frames = arguments.frames or (200 if arguments.full else 25)
    parts = {
        "time": lambda t: times(min(frames, 20), t),
        "accuracy": lambda t: accuracy(frames, t),
        "nees": lambda t: consistency(frames, t),
        "second": lambda t: second_renderer(max(frames // 2, 10), t),
        "robust": lambda t: robustness(frames, t),
        "false": lambda t: false_fixes(1000 if arguments.full else 4 * frames, t),
    }
    wanted = arguments.only.split(",")
    unknown = [part for part in wanted if part not in parts]
    if unknown:
        parser.error(f"--only: no part {unknown[0]!r}; there are {', '.join(parts)}")
    targets = Targets()
    results: dict[str, Any] = {}
    record = {"benchmark": "vision", **provenance(), "frames": frames}

    def write() -> None:
        if arguments.json:
            whole = {**record, **results, "targets": targets.as_rows()}
            Path(arguments.json).write_text(json.dumps(whole, indent=1) + "\n", encoding="utf-8")

    # A full run takes the better part of an hour: what is done is written, should it be broken off.
    for part, run in parts.items():
        if part in wanted:
            results[part] = run(targets)
            write()
    if arguments.baseline:
        for part, result in results.items():
            if part in FILES:
                compare(part, result, targets)
    kept = targets.report()
    write()
    return 0 if kept else 1


if __name__ == "__main__":
    raise SystemExit(main())
