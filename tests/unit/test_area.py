"""The fit of all pixels of a small target: its derivatives, its covariance, and both engines."""

import math

import numpy as np
import pytest

from estimation.frames import R_CB_NOMINAL, euler_to_quat, quat_to_matrix
from simulation.renderer import Conditions, Renderer
from vision import Camera, RingTarget, TargetDetector
from vision.area_covariance import sandwich
from vision.area_model import (
    ALL,
    FIRST,
    OUTERMOST,
    PATTERN,
    Blur,
    Pixels,
    offsets,
    pattern_rows,
    share_beyond,
)
from vision.area_pixels import chosen, take_pixels, thinned
from vision.lines import edges_of
from vision.plane import LevelPlane, rotation_xy

CAMERA = Camera.from_fov(640, 480, math.radians(62.2))
RINGS = edges_of(np.array([0.5, 0.4, 0.3, 0.2, 0.12, 0.06]))
IMAGE = np.zeros((480, 640, 3), dtype=np.uint8)


def plane_of(camera=CAMERA, roll_deg=18.0, pitch_deg=-12.0):
    R_nc = quat_to_matrix(euler_to_quat(*np.radians([roll_deg, pitch_deg, 40.0]))) @ R_CB_NOMINAL.T
    return LevelPlane(camera, R_nc)


def place(plane, height, u=300.0, v=260.0):
    """Return centre and kappa of a target whose centre is at a pixel."""
    qx, qy = plane.from_pixels(np.array(u), np.array(v))
    return np.array([float(qx), float(qy)]), 1.0 / height


def test_pattern_of_a_large_ring_is_what_it_covers():
    """Far from all edges the pattern is the sum of the edges outside of which a pixel lies."""
    plane = plane_of(roll_deg=0.0, pitch_deg=0.0)
    centre, kappa = place(plane, 2.0, 320.0, 240.0)
    radius_px = kappa * RINGS.radius_m * CAMERA.fx
    rho = np.array(
        [0.5 * (radius_px[0] + radius_px[1]), radius_px[0] + 9.0, 0.5 * (radius_px[1] + radius_px[2])]
    )
    pixels = Pixels(320.0 + rho, np.full(3, 240.0), rho, rho, np.zeros(2), 640, 480, False)
    rows = pattern_rows(plane.view, pixels, centre, kappa, RINGS, Blur(0.6, 0.0, 0.0))
    np.testing.assert_allclose(rows[:, PATTERN], [-1.0, 0.0, 0.0], atol=1e-5)
    np.testing.assert_allclose(rows[:, OUTERMOST], [0.0, 1.0, 0.0], atol=1e-5)


@pytest.mark.parametrize("spill", [0.0, 0.09])
@pytest.mark.parametrize("width_px", [0.5, 0.8])
def test_derivatives_of_the_pattern_are_its_differences(width_px, spill):
    plane = plane_of()
    centre, kappa = place(plane, 18.0)
    pixels, _ = take_pixels(IMAGE, plane.view, centre, 0.5 * kappa, 4.0)
    assert pixels.filtered
    blur = Blur(width_px, 0.02, spill)
    unit = float(plane.units_per_pixel(*centre))
    rows = pattern_rows(plane.view, pixels, centre, kappa, RINGS, blur)
    steps = np.array([1e-3 * unit, 1e-3 * unit, 1e-4 * kappa, 1e-5, 1e-5, 1e-4, 1e-4, 1e-4])

    def moved(k, step):
        turn = np.zeros(2)
        where, scale, seen, width, growth, extra = centre.copy(), kappa, plane, *blur
        if k < 2:
            where[k] += step
        elif k == 2:
            scale += step
        elif k < 5:
            turn[k - 3] = step
            seen = plane.tilted(rotation_xy(*turn))
        width *= math.exp(step) if k == 6 else 1.0
        growth += step if k == 5 else 0.0
        extra += step if k == 7 else 0.0
        return pattern_rows(seen.view, pixels, where, scale, RINGS, Blur(width, growth, extra))

    for k, step in enumerate(steps):
        difference = (moved(k, step) - moved(k, -step)) / (2.0 * step)
        for at, column in ((ALL, PATTERN), (FIRST, OUTERMOST)):
            size = np.linalg.norm(difference[:, column])
            error = np.linalg.norm(rows[:, at + k] - difference[:, column])
            # The gradient's own change with the place is left out.
            assert error < 0.03 * size, (k, column, error / size)


def test_considered_columns_are_those_of_the_camera():
    """A longer focal length and a moved principal point change the picture as the columns say."""
    plane = plane_of()
    centre, kappa = place(plane, 18.0)
    pixels, _ = take_pixels(IMAGE, plane.view, centre, 0.5 * kappa, 4.0)
    blur = Blur(0.6, 0.0, 0.05)
    rows = pattern_rows(plane.view, pixels, centre, kappa, RINGS, blur)

    def through(focal, du, dv):
        cx, cy = CAMERA.centre
        other = Camera(640, 480, CAMERA.fx * focal, CAMERA.fy * focal, cx + du, cy + dv)
        return pattern_rows(LevelPlane(other, plane.rotation).view, pixels, centre, kappa, RINGS, blur)

    for k, change in enumerate(((1e-5, 0.0, 0.0), (0.0, 1e-3, 0.0), (0.0, 0.0, 1e-3))):
        step = max(change)
        plus = through(1.0 + change[0], change[1], change[2])[:, PATTERN]
        minus = through(1.0 - change[0], -change[1], -change[2])[:, PATTERN]
        difference = (plus - minus) / (2.0 * step)
        column = rows[:, ALL + 8 + k]
        assert np.linalg.norm(column - difference) < 0.03 * np.linalg.norm(difference), k


def test_light_from_beyond_the_board_is_told_by_the_distance_to_it():
    """Half of it on the border, 2.3 % two blurs within, in pixels whatever the slant; none in the middle."""
    plane = plane_of()
    centre, kappa = place(plane, 20.0)
    pixels, _ = take_pixels(IMAGE, plane.view, centre, 0.5 * kappa, 4.0)
    radius = 0.5 * kappa
    share = share_beyond(plane.view, pixels, centre, radius, 0.6)
    ex, ey = offsets(plane.view, pixels, centre)
    rho = np.hypot(ex, ey)
    u, v = plane.to_pixels(centre[0] + radius * ex / rho, centre[1] + radius * ey / rho)
    away = np.hypot(u - pixels.u, v - pixels.v) * np.sign(radius - rho)
    on, within = np.abs(away) < 0.1, np.abs(away - 1.2) < 0.1
    assert on.any() and within.any()
    assert np.abs(share[on] - 0.5).max() < 0.08
    assert np.abs(share[within] - 0.023).max() < 0.012
    assert share[rho < 0.3 * radius].max() < 1e-4


def test_thinning_keeps_pixels_evenly():
    plane = plane_of()
    centre, kappa = place(plane, 8.0)
    pixels, _ = take_pixels(IMAGE, plane.view, centre, 0.5 * kappa, 4.0)
    few = thinned(pixels, 500)
    assert 450 < len(few.u) < 550
    left = few.u < np.median(pixels.u)
    assert 0.42 < left.mean() < 0.58
    assert not few.filtered


@pytest.mark.parametrize("together", [False, True], ids=["independent", "neighbours alike"])
def test_covariance_is_the_scatter_of_the_estimate(together):
    """Of many draws of noise, equal and independent or shared by neighbouring pixels and larger at the edges."""
    plane = plane_of()
    centre, kappa = place(plane, 20.0)
    pixels, _ = take_pixels(IMAGE, plane.view, centre, 0.5 * kappa, 4.0)
    pattern = pattern_rows(plane.view, pixels, centre, kappa, RINGS, Blur(0.6, 0.0, 0.0))
    rows = np.concatenate((100.0 * pattern[:, ALL : ALL + 3], pattern[:, PATTERN : PATTERN + 1]), axis=1)
    rows = np.concatenate((rows, np.ones((len(rows), 1))), axis=1)
    scale = 1.0 / np.linalg.norm(rows, axis=0)
    rows = rows * scale
    plain = np.linalg.inv(rows.T @ rows)
    rng = np.random.default_rng(3)
    shape = (pixels.down, pixels.across)
    estimates, claimed = [], np.zeros((5, 5))
    edge = 1.0 + 2.0 * np.abs(rows[:, 2]) / np.abs(rows[:, 2]).max()
    for _ in range(400):
        noise = rng.standard_normal(shape)
        if together:
            noise = 0.7 * noise + 0.5 * (np.roll(noise, 1, 1) + np.roll(noise, 1, 0))
        noise = noise.ravel() * (edge if together else 1.0)
        change = plain @ (rows.T @ noise)
        residual = noise - rows @ change
        variance = float(residual @ residual) / (len(noise) - 5)
        weight = np.ones(len(noise))
        claimed += sandwich(rows, weight, residual, plain * variance, variance, np.zeros(5), pixels) / 400.0
        estimates.append(change)
    scatter = np.cov(np.array(estimates).T)
    ratio = np.diag(claimed)[:3] / np.diag(scatter)[:3]
    # A window of three pixels does not see all that neighbours share.
    low = 0.65 if together else 0.8
    assert (ratio > low).all() and (ratio < 1.25).all(), ratio


@pytest.mark.parametrize(
    ("height", "conditions", "options"),
    [
        (20.0, Conditions(read_noise=3.0), {}),
        (30.0, Conditions(read_noise=3.0), {"deck_tilt_sigma_rad": 0.05}),
        (15.0, Conditions(read_noise=3.0, bar_px=5.0, bar_offset=0.3), {}),
        (18.0, Conditions(read_noise=3.0, light=1.5), {}),
    ],
    ids=["plain", "tilt", "bar", "clipped"],
)
def test_compiled_and_numpy_give_the_same_fix(height, conditions, options):
    pytest.importorskip("numba")
    target = RingTarget.recommended(1.0)
    lens = Camera(640, 480, 520.0, 524.0, 322.0, 236.0, (-0.12, 0.03, 0.001, -0.0005, 0.0), readout_s=0.02)
    for camera in (CAMERA, lens):
        R_nc = plane_of(camera).rotation
        x, y = camera.rays(300.0, 250.0)
        ray = np.array([float(x), float(y), 1.0])
        truth = ray * height / (R_nc @ ray)[2]
        image = Renderer(camera, target).render(R_nc, -R_nc @ truth, np.random.default_rng(5), conditions)
        a, b = (
            TargetDetector(camera, target, engine=e, **options).detect(image, R_nc)
            for e in ("compiled", "numpy")
        )
        assert a and b
        np.testing.assert_allclose(a.position_cam_m, b.position_cam_m, rtol=1e-9)
        np.testing.assert_allclose(a.covariance_m2, b.covariance_m2, rtol=1e-6)
        assert np.linalg.norm(a.position_cam_m - truth) < 5e-3 * height


def test_pixels_outside_the_picture_are_not_taken():
    plane = plane_of()
    centre, kappa = place(plane, 15.0, 3.0, 200.0)
    pixels, _ = take_pixels(IMAGE, plane.view, centre, 0.5 * kappa, 4.0)
    assert len(pixels.u) and pixels.u.min() >= 0.0
    far, _ = take_pixels(IMAGE, plane.view, centre + 50.0, 0.5 * kappa, 4.0)
    assert not len(far.u)
    assert not len(chosen(pixels, np.zeros(len(pixels.u), dtype=bool)).u)
