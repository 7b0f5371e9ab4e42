"""The renderer against slow and obvious ways to draw the same."""

import math

import cv2
import numpy as np
import pytest

from estimation.frames import R_CB_NOMINAL, euler_to_quat, quat_to_matrix
from simulation.coverage import PlaneMap, disc, half_plane
from simulation.renderer import Conditions, Renderer, Scene
from vision.camera import Camera
from vision.target import RingTarget

SMALL = Camera(96, 72, 90.0, 88.0)
LENS = Camera(96, 72, 90.0, 92.0, 45.0, 38.0, (-0.2, 0.05, 0.002, -0.001, 0.0))
ROLLING = Camera(96, 72, 90.0, 90.0, readout_s=0.03)
THESIS, RECOMMENDED = RingTarget.thesis(1.0), RingTarget.recommended(1.0)
SHARP = Conditions(defocus_px=0.0)
BLACK_SEA = Scene(sea_rgb=(0, 0, 0), sea_contrast=0.0)


def attitude(roll_deg: float, pitch_deg: float, yaw_deg: float) -> np.ndarray:
    return quat_to_matrix(euler_to_quat(*np.radians([roll_deg, pitch_deg, yaw_deg]))) @ R_CB_NOMINAL.T


def brute_force(renderer, R_nc, position, R_nd, rate, samples=16):
    """Return the picture as the mean of samples x samples rays a pixel, each of one colour; float BGR."""
    camera, target, scene = renderer.camera, renderer.target, renderer.scene
    offsets = (np.arange(samples) + 0.5) / samples - 0.5
    total = np.zeros((camera.height, camera.width, 3))
    camera_in_deck = R_nd.T @ position
    for dv in offsets:
        v = np.arange(camera.height) + dv
        turns = np.stack([cv2.Rodrigues(rate * t)[0] for t in camera.row_time_s(v)])
        for du in offsets:
            x, y = camera.rays(*np.meshgrid(np.arange(camera.width) + du, v))
            rays = np.einsum(
                "rij,rcj->rci", R_nd.T @ R_nc @ turns, np.stack([x, y, np.ones_like(x)], axis=-1)
            )
            reach = -camera_in_deck[2] / rays[..., 2]
            point = camera_in_deck[:2] + reach[..., None] * rays[..., :2]
            away, rho = np.abs(point).max(axis=-1), np.hypot(*np.moveaxis(point, -1, 0))
            colour = np.zeros_like(total)
            colour[away < renderer.deck_m / 2] = scene.deck_rgb[::-1]
            colour[away < target.side_m / 2] = target.white_rgb[::-1]
            colour[target.is_red(rho)] = target.red_rgb[::-1]
            total += colour
    return total / samples**2


@pytest.mark.parametrize(
    ("camera", "target", "height", "deck_deg", "rate"),
    [
        (SMALL, THESIS, 1.2, (0, 0, 0), (0, 0, 0)),
        (SMALL, THESIS, 9.0, (0, 0, 0), (0, 0, 0)),
        (SMALL, RECOMMENDED, 3.0, (6, -7, 20), (0, 0, 0)),
        (LENS, THESIS, 1.5, (0, 0, 0), (0, 0, 0)),
        (ROLLING, RECOMMENDED, 2.0, (0, 0, 0), (1.0, -0.8, 2.0)),
    ],
    ids=["near", "far", "tilted deck", "lens", "rolling shutter"],
)
def test_area_coverage_equals_supersampling(camera, target, height, deck_deg, rate):
    renderer = Renderer(camera, target, BLACK_SEA)
    R_nc, R_nd, turn = attitude(17, -11, 40), attitude(*deck_deg) @ R_CB_NOMINAL, np.array(rate, dtype=float)
    position = -R_nc @ (np.array([0.05, 0.02, 1.0]) * height)
    picture = renderer.render(R_nc, position, None, SHARP, R_nd, turn).astype(float)
    error = picture - brute_force(renderer, R_nc, position, R_nd, turn)
    # 16 x 16 samples are themselves wrong by up to 1/32 of a pixel along an edge: 7 of 223 levels.
    assert np.abs(error).max() <= 8.0
    assert np.sqrt((error**2).mean()) < 0.8
    assert abs(error.mean()) < 0.01


def test_half_planes_cover_what_they_should():
    distance = np.array([0.0, 0.5, -0.5, 0.25, 0.8, -0.8, 0.0])
    normal_u = np.array([1.0, 1.0, 1.0, 0.0, math.sqrt(0.5), math.sqrt(0.5), 0.6])
    normal_v = np.array([0.0, 0.0, 0.0, 1.0, math.sqrt(0.5), math.sqrt(0.5), -0.8])
    np.testing.assert_allclose(half_plane(distance, normal_u, normal_v), [0.5, 0.0, 1.0, 0.25, 0.0, 1.0, 0.5])
    corner = half_plane(
        np.array([math.sqrt(0.5) - 0.1]), np.array([math.sqrt(0.5)]), np.array([math.sqrt(0.5)])
    )
    assert corner[0] == pytest.approx(0.01)


@pytest.mark.parametrize("radius", [0.3, 0.8, 2.0, 4.0, 9.0, 30.0])
def test_discs_have_their_area(radius):
    """On a plane seen without perspective, in pixels."""
    side = math.ceil(radius) + 2
    v, u = (axis.ravel().astype(float) for axis in np.mgrid[-side : side + 1, -side : side + 1])
    value = np.stack([u + 0.21, v - 0.37, np.ones_like(u)])
    plane = PlaneMap(value, np.array([[1.0], [0.0], [0.0]]), np.array([[0.0], [1.0], [0.0]]))
    assert disc(plane, radius).sum() == pytest.approx(math.pi * radius**2, rel=3e-4)


def test_rings_are_where_the_camera_model_puts_them():
    """Sub-pixel: the red share on a row crosses one half at the projection of the outer edge."""
    camera = Camera.preset("rpi-v2-640x480")
    renderer = Renderer(camera, THESIS, BLACK_SEA)
    R_nc = attitude(12, -9, 30)
    position = -R_nc @ np.array([0.3, -0.1, 4.0])
    picture = renderer.render(R_nc, position, None, SHARP).astype(float)
    for angle in np.linspace(0.0, 2.0 * np.pi, 16, endpoint=False):
        edge = THESIS.edges_m[0] * np.array([math.cos(angle), math.sin(angle), 0.0])
        steps = np.linspace(0.95, 1.05, 401)
        u, v = camera.project((steps[:, None] * edge - position) @ R_nc)
        profile = cv2.remap(picture[..., 1], u.astype(np.float32), v.astype(np.float32), cv2.INTER_LINEAR)
        crossing = steps[np.argmin(np.abs(profile.ravel() - (22 + 245) / 2))]
        px_per_step = math.hypot(u[-1] - u[0], v[-1] - v[0]) / 0.1
        assert abs(crossing - 1.0) * px_per_step < 0.1


def test_light_clips_white_and_keeps_geometry():
    renderer = Renderer(SMALL, THESIS)
    R_nc, position = attitude(0, 0, 0), np.array([0.0, 0.0, -1.0])
    bright = renderer.render(R_nc, position, None, Conditions(light=1.5))
    dark = renderer.render(R_nc, position, None, Conditions(light=0.25))
    assert (bright[36, 47:49] == 255).all()
    np.testing.assert_array_less(np.abs(dark[36, 48].astype(float) - 245 * 0.25), 1.0)


def test_gamma_keeps_flat_colours_and_lightens_edges():
    renderer = Renderer(SMALL, THESIS)
    R_nc, position = attitude(0, 0, 0), np.array([0.013, 0.0, -1.3])
    linear = renderer.render(R_nc, position, None, SHARP).astype(int)
    encoded = renderer.render(R_nc, position, None, Conditions(defocus_px=0.0, gamma=2.2)).astype(int)
    difference = encoded - linear
    assert np.median(np.abs(difference)) <= 1
    assert difference[..., 1].max() > 25
    assert difference[..., 1].min() >= -3


def test_noise_has_the_stated_size_and_follows_the_generator():
    renderer = Renderer(SMALL, THESIS, Scene(sea_contrast=0.0))
    R_nc, position = attitude(0, 0, 0), np.array([0.0, 0.0, -30.0])
    clean = renderer.render(R_nc, position, None, SHARP).astype(float)
    for settings, sigma in (
        (Conditions(defocus_px=0.0, read_noise=3.0), np.full(3, 3.0)),
        (
            Conditions(defocus_px=0.0, read_noise=2.0, shot_noise=0.1),
            np.sqrt(4.0 + 0.1 * np.array([120, 82, 38])),
        ),
    ):
        first, again = (renderer.render(R_nc, position, np.random.default_rng(4), settings) for _ in range(2))
        assert (first == again).all()
        other = renderer.render(R_nc, position, np.random.default_rng(5), settings)
        assert (first != other).mean() > 0.5
        noise = first - clean
        np.testing.assert_allclose(noise.reshape(-1, 3).std(axis=0), np.hypot(sigma, 0.29), rtol=0.08)


def test_motion_blur_moves_light_along_its_direction_only():
    renderer = Renderer(SMALL, THESIS, BLACK_SEA)
    R_nc, position = attitude(0, 0, 0), np.array([0.0, 0.0, -3.0])
    sharp = renderer.render(R_nc, position, None, SHARP).astype(float)
    moved = renderer.render(R_nc, position, None, Conditions(defocus_px=0.0, motion_px=8.0)).astype(float)
    assert moved.sum() == pytest.approx(sharp.sum(), rel=2e-3)
    np.testing.assert_allclose(moved.sum(axis=1)[20:50], sharp.sum(axis=1)[20:50], rtol=0.02)
    assert np.abs(moved - sharp).max() > 40


def test_shadow_bar_and_glare_touch_their_places():
    renderer = Renderer(SMALL, THESIS)
    R_nc, position = attitude(0, 0, 0), np.array([0.0, 0.0, -2.0])
    plain = renderer.render(R_nc, position, None, SHARP).astype(float)
    shadow = renderer.render(
        R_nc, position, None, Conditions(defocus_px=0.0, shadow=0.4, shadow_angle_rad=0.0)
    )
    np.testing.assert_allclose(shadow[:, 50:], 0.4 * plain[:, 50:], atol=1.0)
    np.testing.assert_array_equal(shadow[:, :46], plain[:, :46])
    bar = renderer.render(
        R_nc, position, None, Conditions(defocus_px=0.0, bar_px=6.0, bar_offset=0.0, bar_angle_rad=0.0)
    )
    assert (bar[35:37] == (28, 25, 25)).all()
    np.testing.assert_array_equal(bar[:30], plain[:30])
    glare = renderer.render(
        R_nc, position, None, Conditions(defocus_px=0.0, glare=1.0, glare_offset=(0.0, 0.0))
    )
    assert (glare[35:37, 47:49] == 255).all()


def test_pictures_without_a_target_hold_only_clutter():
    renderer = Renderer(Camera(320, 240, 300.0, 300.0), THESIS)
    R_nc, position = attitude(0, 0, 0), np.array([0.0, 0.0, -2.0])
    empty = renderer.render(R_nc, position, None, Conditions(target=False))
    assert (empty[..., 2] < 1.3 * empty[..., :2].max(axis=-1)).all()
    cluttered = renderer.render(
        R_nc, position, np.random.default_rng(1), Conditions(target=False, distractors=6, boats=2)
    )
    red = cluttered[..., 2] > 1.6 * cluttered[..., :2].max(axis=-1).astype(float)
    assert 50 < red.sum() < red.size / 2


def test_out_of_sight_and_above_the_horizon_are_drawn_without_fuss():
    renderer = Renderer(SMALL, THESIS)
    away = renderer.render(attitude(0, 0, 0), np.array([30.0, 0.0, -2.0]), np.random.default_rng(0))
    assert away.shape == (72, 96, 3)
    horizon = renderer.render(attitude(0, 75, 0), np.array([0.0, 0.0, -2.0]))
    sky = (horizon == np.array(renderer.scene.sky_rgb[::-1])).all(axis=-1)
    assert sky.mean() == pytest.approx(0.5 - SMALL.fy * math.tan(math.radians(15.0)) / SMALL.height, abs=0.03)
    grazing = renderer.render(attitude(60, 0, 0), np.array([0.2, 1.0, -0.6]))
    assert grazing.dtype == np.uint8


def test_jpeg_changes_little_and_keeps_the_size():
    renderer = Renderer(SMALL, THESIS)
    R_nc, position = attitude(0, 0, 0), np.array([0.0, 0.0, -2.0])
    plain = renderer.render(R_nc, position)
    packed = renderer.render(R_nc, position, None, Conditions(jpeg_quality=90))
    assert packed.shape == plain.shape
    assert 0.0 < np.abs(packed.astype(float) - plain).mean() < 8.0


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"R_nc": np.ones((3, 3))}, "R_nc"),
        ({"R_nd": np.diag([1.0, 1.0, -1.0])}, "R_nd"),
        ({"position_m": [0.0, 0.0, 1.0]}, "position_m"),
        ({"position_m": [0.0, math.nan, -1.0]}, "position_m"),
        ({"position_m": [0.0, -1.0]}, "position_m"),
        ({"rate_c_radps": [math.inf, 0.0, 0.0]}, "rate_c_radps"),
    ],
)
def test_bad_arguments_are_refused_by_name(arguments, named):
    good = {"R_nc": attitude(0, 0, 0), "position_m": [0.0, 0.0, -1.0]}
    with pytest.raises(ValueError, match=rf"^{named}:"):
        Renderer(SMALL, THESIS).render(**{**good, **arguments})


@pytest.mark.parametrize(
    ("kind", "arguments", "named"),
    [
        (Conditions, {"light": 0.0}, "light"),
        (Conditions, {"gamma": math.nan}, "gamma"),
        (Conditions, {"motion_px": -1.0}, "motion_px"),
        (Conditions, {"cast_rgb": (1.0, 1.0)}, "cast_rgb"),
        (Conditions, {"jpeg_quality": 101}, "jpeg_quality"),
        (Scene, {"deck_m": 0.0}, "deck_m"),
        (Scene, {"freeboard_m": -1.0}, "freeboard_m"),
    ],
)
def test_bad_conditions_are_refused_by_name(kind, arguments, named):
    with pytest.raises(ValueError, match=rf"^{named}:"):
        kind(**arguments)


def test_a_deck_smaller_than_the_board_is_refused():
    with pytest.raises(ValueError, match=r"^deck_m:"):
        Renderer(SMALL, THESIS, Scene(deck_m=1.0))
