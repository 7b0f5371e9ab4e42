"""The command ``deckfix detect``: fixes of single pictures, as a table, as JSON, and drawn into the
picture."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    from vision import NoFix, RingTarget, VisionFix


@click.command()
@click.argument("files", nargs=-1, required=True, metavar="IMAGE...")
@click.option("--camera", "camera_path", metavar="C.toml", help="The camera.  [default: HFOV 62.2 deg]")
@click.option("--target", "target_path", metavar="T.toml", help="The target.  [default: recommended, 1 m]")
@click.option("--method", type=click.Choice(["rings", "thesis"]), default="rings", show_default=True)
@click.option(
    "--attitude", nargs=3, type=float, default=None, metavar="ROLL PITCH YAW",
    help="Of the vehicle, in degrees, for a camera that looks straight down.  [default: unknown]",
)  # fmt: skip
@click.option("--json", "json_path", metavar="S.json", help="Write the fixes; - for standard output.")
@click.option("--overlay", metavar="O.png|DIR", help="Draw what was seen; a folder for several images.")
@click.option("--force", is_flag=True, help="Overwrite output files that exist.")
def detect(
    files: tuple[str, ...],
    camera_path: str | None,
    target_path: str | None,
    method: str,
    attitude: tuple[float, float, float] | None,
    json_path: str | None,
    overlay: str | None,
    force: bool,
) -> None:
    """Find the target in pictures: its position in the camera frame (X right, Y down, Z ahead) and 1-sigma.

    Where there is no fix the reason is printed; that is no error. The exit code is 1 if a file cannot be
    read.
    """
    from deckfix.files import check_output, loaded, output_file
    from vision import RingTarget

    places = _overlay_paths(files, overlay)
    for place in [*places.values(), *([json_path] if json_path not in (None, "-") else [])]:
        check_output(str(place), force=force, inputs=files)
    target = loaded(RingTarget, target_path) if target_path is not None else RingTarget.recommended()
    rows: list[dict[str, Any]] = []
    failures: list[str] = []
    for name in files:
        try:
            row, picture = _one(name, camera_path, target, method, attitude, drawn=name in places)
        except ValueError as error:
            failures.append(str(error))
            rows.append({"image": name, "fix": None, "reason": f"not read: {error}"})
            continue
        rows.append(row)
        if picture is not None:
            _save(picture, places[name], files, force)
    if json_path is not None:
        text = json.dumps(rows, indent=2, allow_nan=False)
        if json_path == "-":
            click.echo(text)
        else:
            with output_file(json_path, force=force, inputs=files) as partial:
                partial.write_text(text + "\n", encoding="utf-8")
    if json_path != "-":
        click.echo(_table(rows))
    for failure in failures:
        click.echo(f"deckfix: {failure}", err=True)
    if failures:
        raise SystemExit(1)


def _one(
    name: str,
    camera_path: str | None,
    target: RingTarget,
    method: str,
    attitude: tuple[float, float, float] | None,
    drawn: bool,
) -> tuple[dict[str, Any], Any]:
    """Return the row of one image and, where asked for, the picture with the overlay."""
    import math

    import numpy as np

    from deckfix.files import InputError, existing, loaded
    from estimation.frames import R_CB_NOMINAL, euler_to_quat, quat_to_matrix
    from vision import Camera, TargetDetector
    from vision.overlay import draw_overlay

    image = _decoded(existing(name))
    if image is None:
        raise InputError(f"{name}: not a picture that can be decoded; give PNG or JPEG")
    height, width = image.shape[:2]
    if camera_path is not None:
        camera = loaded(Camera, camera_path)
    else:
        camera = Camera.from_fov(width, height, math.radians(62.2))
    rotation = None
    if attitude is not None:
        rotation = quat_to_matrix(euler_to_quat(*(math.radians(a) for a in attitude))) @ R_CB_NOMINAL.T
    image = np.ascontiguousarray(image)
    try:
        # A few pictures do not repay loading the compiled code.
        result = TargetDetector(camera, target, method=method, engine="numpy").detect(image, rotation)
    except ValueError as error:
        raise InputError(f"{name}: {error}") from error
    picture = draw_overlay(camera, target, image, result) if drawn else None
    return _row(name, result), picture


def _decoded(path: Path) -> Any:
    """Return the picture of a file as OpenCV reads it, or None."""
    import cv2
    import numpy as np

    data = np.fromfile(path, dtype=np.uint8)
    return cv2.imdecode(data, cv2.IMREAD_COLOR) if data.size else None


def _row(name: str, result: VisionFix | NoFix) -> dict[str, Any]:
    """Return a result as it is written to JSON: metres, square metres, radians; numbers that are none are
    null."""
    import math

    from vision import NoFix

    if isinstance(result, NoFix):
        return {"image": name, "fix": None, "reason": result.reason}
    finite = {
        key: value if math.isfinite(value) else None
        for key, value in (("residual_px", result.residual_px), ("blur_px", result.blur_px))
    }
    fix = {
        "position_cam_m": [float(v) for v in result.position_cam_m],
        "covariance_m2": [[float(v) for v in row] for row in result.covariance_m2],
        "rings": list(result.rings),
        "share": result.share,
        "tilt_rad": None if result.tilt_rad is None else [float(v) for v in result.tilt_rad],
        "method": result.method,
        **finite,
    }
    return {"image": name, "fix": fix, "reason": None}


def _table(rows: list[dict[str, Any]]) -> str:
    lines = [f"{'image':32} {'x m':>9} {'y m':>9} {'z m':>9}   {'1-sigma mm':>20}  edges"]
    for row in rows:
        name = Path(row["image"]).name
        fix = row["fix"]
        if fix is None:
            lines.append(f"{name:32} no fix: {row['reason']}")
            continue
        x, y, z = fix["position_cam_m"]
        sigma = " ".join(f"{1e3 * fix['covariance_m2'][i][i] ** 0.5:6.1f}" for i in range(3))
        lines.append(f"{name:32} {x:9.3f} {y:9.3f} {z:9.3f}   {sigma:>20}  {len(fix['rings'])}")
    return "\n".join(lines)


def _overlay_paths(files: tuple[str, ...], overlay: str | None) -> dict[str, Path]:
    """Return the picture to write for each image; several images need a folder."""
    from deckfix.files import OutputError

    if overlay is None:
        return {}
    place = Path(overlay)
    if place.is_dir():
        names = [Path(name).stem for name in files]
        if len(set(names)) < len(names):
            raise OutputError(f"{overlay}: two images have the same name; give them different folders")
        return {name: place / f"{Path(name).stem}.overlay.png" for name in files}
    if len(files) > 1:
        raise OutputError(f"{overlay}: not a folder, but there are {len(files)} images; create a folder")
    if place.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise OutputError(f"{overlay}: cannot tell what to draw; end the name in .png or .jpg")
    return {files[0]: place}


def _save(picture: Any, place: Path, inputs: tuple[str, ...], force: bool) -> None:
    import cv2

    from deckfix.files import output_file

    with output_file(place, force=force, inputs=inputs) as partial:
        encoded = cv2.imencode(place.suffix, picture)[1]
        partial.write_bytes(encoded.tobytes())
