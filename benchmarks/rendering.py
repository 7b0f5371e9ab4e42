"""How fast pictures are rendered, on one thread: frames a second at 640x480 over the heights of a landing.

    python benchmarks/rendering.py [--frames N] [--json FILE]

CPU time of the process, not wall time, so that other work on the machine counts little; every frame has
another pose (roll and pitch up to 25 deg, any yaw). The plain case is geometry, sea, lens blur of half a
pixel and noise.
"""

from __future__ import annotations

import argparse
import json
import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from estimation.frames import R_CB_NOMINAL, euler_to_quat, quat_to_matrix
from simulation.renderer import Conditions, Renderer
from vision.camera import Camera
from vision.target import RingTarget

LENS = (-0.27, -0.04, 0.0018, -0.0003, 0.24)
HEIGHTS_M = (0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 34.0)


def cases() -> dict[str, tuple[Camera, Conditions]]:
    """Return camera and conditions of each case."""
    camera = Camera.preset("rpi-v2-640x480")
    still = replace(camera, readout_s=0.0)
    return {
        "plain": (still, Conditions()),
        "lens distortion": (replace(still, distortion=LENS), Conditions()),
        "rolling shutter": (camera, Conditions()),
        "gamma, motion, shot noise, JPEG": (
            still,
            Conditions(gamma=2.2, motion_px=6.0, shot_noise=0.05, jpeg_quality=90),
        ),
    }


def measure(camera: Camera, conditions: Conditions, height_m: float, frames: int) -> float:
    """Return CPU milliseconds a frame."""
    renderer = Renderer(camera, RingTarget.recommended(1.0))
    rng = np.random.default_rng(1)
    poses = []
    for _ in range(frames + 3):
        roll, pitch, yaw = rng.uniform(-1.0, 1.0, 3) * (0.436, 0.436, math.pi)
        R_nc = quat_to_matrix(euler_to_quat(roll, pitch, yaw)) @ R_CB_NOMINAL.T
        poses.append((R_nc, -R_nc @ (np.array([*rng.uniform(-0.2, 0.2, 2), 1.0]) * height_m)))
    started = 0.0
    for k, (R_nc, position) in enumerate(poses):
        if k == 3:
            started = time.process_time()
        renderer.render(R_nc, position, rng, conditions, rate_c_radps=(0.3, -0.2, 0.1))
    return (time.process_time() - started) / frames * 1e3


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--frames", type=int, default=40, help="at each height")
    parser.add_argument("--json", metavar="FILE", help="write the results")
    arguments = parser.parse_args()
    import cv2

    cv2.setNumThreads(1)
    rows: dict[str, Any] = {}
    print("CPU ms a frame at   " + " ".join(f"{h:>5g} m" for h in HEIGHTS_M) + "   slowest")
    for name, (camera, conditions) in cases().items():
        each = {f"{h:g}": measure(camera, conditions, h, arguments.frames) for h in HEIGHTS_M}
        slowest = max(each.values())
        rows[name] = each
        cells = " ".join(f"{ms:7.1f}" for ms in each.values())
        print(f"{name[:18]:18} {cells}   {1e3 / slowest:.0f} frames/s")
    if arguments.json:
        record = {"benchmark": "rendering", "frames": arguments.frames, "cpu_ms": rows}
        Path(arguments.json).write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
