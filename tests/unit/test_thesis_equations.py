"""The thesis's equations, one by one, and its detector on rendered pictures at its own distances."""

import math

import cv2
import numpy as np
import pytest

from estimation.frames import R_CB_NOMINAL, euler_to_quat, quat_to_matrix
from simulation.renderer import Conditions, Renderer, Scene
from vision import thesis
from vision.camera import Camera
from vision.target import RingTarget

CAMERA = Camera.preset("rpi-v2-640x480")
TARGET = RingTarget.thesis()
TABLE_5_4 = thesis.ContourFilter()


@pytest.fixture(scope="module")
def renderer():
    return Renderer(CAMERA, TARGET, Scene(deck_m=0.8))


def disc_mask(diameter: int, hole: int = 0, size: int = 400) -> np.ndarray:
    rows, columns = np.mgrid[:size, :size] - (size - 1) / 2.0
    rho = np.hypot(rows, columns)
    return (((rho < diameter / 2.0) & (rho >= hole / 2.0)) * 255).astype(np.uint8)


@pytest.mark.parametrize("diameter", [40, 80, 140, 200, 270])
def test_a_digital_disc_is_in_the_middle_of_the_windows(diameter):
    """c/d is 2 sqrt 2 (erratum 7) and d the full extent (erratum 6)."""
    (contour,) = thesis.trace_contours(disc_mask(diameter))
    assert thesis.diameter(contour) == diameter  # (4.5)
    assert thesis.area(contour) == pytest.approx(math.pi * diameter**2 / 4)  # (4.6)
    ratio = thesis.circumference(contour) / thesis.diameter(contour)  # (4.3), (4.7)
    assert ratio == pytest.approx(2.0 * math.sqrt(2.0), abs=0.09)
    assert thesis.passes_diameter_ratio(contour, TABLE_5_4.k1, TABLE_5_4.k2)
    assert thesis.passes_area_ratio(contour, TABLE_5_4.k3, TABLE_5_4.k4)  # (4.8)
    halved = ratio * 2.0
    assert not TABLE_5_4.k1 + math.pi <= halved <= TABLE_5_4.k2 + math.pi


@pytest.mark.parametrize(("diameter", "passes"), [(34, False), (38, True), (278, True), (284, False)])
def test_filter_takes_37_to_279_pixels_of_640x480(diameter, passes):
    (contour,) = thesis.trace_contours(disc_mask(diameter))
    assert thesis.passes_filter(contour, 640.0 * 480.0, TABLE_5_4) == passes  # (4.4), (4.9)
    assert thesis.passes_circumference(contour, 100.0) == (diameter != 34)


def test_filter_refuses_what_is_long_or_square():
    bar = np.zeros((400, 400), np.uint8)
    bar[100:130, 50:350] = 255
    box = np.zeros((400, 400), np.uint8)
    box[100:250, 100:250] = 255
    for mask in (bar, box):
        (contour,) = thesis.trace_contours(mask)
        assert not thesis.passes_filter(contour, 640.0 * 480.0, TABLE_5_4)


def test_holes_are_traced_on_their_own_pixels():
    """Extents 120 and 80, where OpenCV's hole contour has 82 (erratum 8)."""
    mask = disc_mask(120, 80)
    contours = thesis.trace_contours(mask)
    assert sorted(thesis.diameter(c) for c in contours) == [80, 120]
    opencv, _ = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    assert sorted(thesis.diameter(c[:, 0]) for c in opencv) == [82, 120]


def test_the_surroundings_are_no_hole_and_an_empty_mask_has_no_contour():
    assert len(thesis.trace_contours(disc_mask(100))) == 1
    assert thesis.trace_contours(np.zeros((50, 50), np.uint8)) == []
    assert len(thesis.trace_contours(np.full((50, 50), 255, np.uint8))) == 1


def test_projection_and_depth_from_two_points_invert_each_other():
    left, right = (0.1, 0.05, 1.6), (0.4, 0.05, 1.6)
    (u1, v1), (u2, v2) = (thesis.project(p, 530.0, (319.5, 239.5)) for p in (left, right))  # (4.10)-(4.12)
    assert v1 == v2
    assert thesis.depth_from_pair(0.3, u1 - u2, 530.0) == pytest.approx(1.6)  # (4.13)-(4.15)
    assert thesis.lateral(1.6, u2, 319.5, 530.0) == pytest.approx(0.4)  # (4.26)
    assert thesis.lateral(1.6, v2, 239.5, 530.0) == pytest.approx(0.05)  # (4.27)
    k = np.array([[530.0, 0.0, 319.5], [0.0, 530.0, 239.5], [0.0, 0.0, 1.0]])
    np.testing.assert_allclose(thesis.back_project((u2, v2), 1.6, k), right)  # (4.28)


def test_extremes_spacings_and_centre_of_drawn_rings():
    masks = [disc_mask(d) for d in (200, 160, 120)]
    boxes = [thesis.extremes(thesis.trace_contours(m)[0]) for m in masks]
    assert boxes[0] == (100.0, 299.0, 100.0, 299.0)  # (4.16), (4.17)
    assert thesis.spacings_u(boxes).tolist() == [20.0] * 4  # (4.18)
    assert thesis.spacings_v(boxes).tolist() == [20.0] * 4  # (4.19)
    assert thesis.target_centre(boxes) == (199.5, 199.5)  # (4.23), (4.24)
    assert thesis.depth_from_spacings(thesis.spacings_u(boxes), 0.02, 500.0) == pytest.approx(0.5)  # (4.20)
    assert thesis.mean_depth(1.0, 3.0) == 2.0  # (4.22)
    assert thesis.optical_centre(CAMERA) == (319.5, 239.5)  # (4.25)


def test_one_ratio_of_sums_is_unbiased_where_the_mean_of_reciprocals_is_not():
    """Erratum 9: integers 4 and 5 that stand for 4.5, and a zero."""
    pixels = np.array([4.0, 5.0, 4.0, 5.0])
    assert thesis.depth_from_spacings(pixels, 0.045, 100.0) == pytest.approx(1.0)
    assert np.mean(100.0 * 0.045 / pixels) > 1.01
    assert math.isfinite(thesis.depth_from_spacings(np.array([0.0, 5.0]), 0.02, 100.0))
    assert thesis.depth_from_spacings(np.zeros(4), 0.02, 100.0) == math.inf


def test_frames_of_the_relative_position_are_consistent():
    R_nb = quat_to_matrix(euler_to_quat(0.2, -0.1, 0.7))
    P_c = np.array([0.3, -0.2, 4.0])
    relative = thesis.vehicle_relative(R_nb, R_CB_NOMINAL, P_c)  # (4.31)
    R_nc = R_nb @ R_CB_NOMINAL.T
    np.testing.assert_allclose(relative, thesis.camera_relative(R_nc, P_c))  # (4.30)
    np.testing.assert_allclose(thesis.camera_position(R_nc.T, P_c), relative)  # (4.29), target at the origin
    assert relative[2] < 0.0


@pytest.mark.parametrize("height", np.arange(0.2, 2.01, 0.3))
def test_vertical_trial_stays_within_the_reported_error(renderer, height):
    """Seed 5.5.2 reports less than 6 % from 0.2 m to 2 m."""
    rng = np.random.default_rng(round(height * 10))
    R_nc = R_CB_NOMINAL.T
    errors = []
    for _ in range(4):
        position = np.array([*rng.uniform(-0.003, 0.003, 2), -height])
        result = thesis.thesis_detect(CAMERA, TARGET, renderer.render(R_nc, position, rng), R_nc)
        assert result.position_cam_m is not None, result.reason
        np.testing.assert_allclose(result.relative_ned_m, -R_nc @ result.position_cam_m)
        errors.append(abs(result.position_cam_m[2] / height - 1.0))
    assert np.mean(errors) < 0.06


def test_tilted_views_stay_within_the_reported_error(renderer):
    """Seed 5.6 reports up to 8 % with roll and pitch of 25 deg at about 1.2 m."""
    rng = np.random.default_rng(3)
    errors = []
    for roll, pitch in [(25.0, 0.0), (0.0, -25.0), (-25.0, 25.0), (25.0, 25.0)] * 3:
        R_nc = quat_to_matrix(euler_to_quat(math.radians(roll), math.radians(pitch), 0.0)) @ R_CB_NOMINAL.T
        position = -R_nc @ np.array([*rng.uniform(-0.15, 0.15, 2), 1.3])
        result = thesis.thesis_detect(CAMERA, TARGET, renderer.render(R_nc, position, rng), R_nc)
        assert result.relative_ned_m is not None, result.reason
        errors.append(np.abs(result.relative_ned_m / position - 1.0).max())
    assert np.median(errors) < 0.08


def test_clutter_that_passes_the_filter_is_refused_not_measured(renderer):
    rng = np.random.default_rng(7)
    R_nc, position = R_CB_NOMINAL.T, np.array([0.1, 0.05, -0.9])
    image = renderer.render(R_nc, position, rng, Conditions(target=False))
    cv2.circle(image, (150, 120), 40, (30, 30, 200), -1)
    cv2.circle(image, (450, 330), 60, (30, 30, 200), -1)
    careful = thesis.thesis_detect(CAMERA, TARGET, image)
    assert careful.position_cam_m is None
    assert "concentric" in careful.reason
    printed = thesis.ContourFilter(max_offset=math.inf, max_uneven=math.inf)
    assert thesis.thesis_detect(CAMERA, TARGET, image, limits=printed).position_cam_m is not None


def test_a_missing_contour_is_noticed_by_its_spacing():
    """Erratum 10: every distance is taken for the same real one."""
    boxes = [thesis.extremes(thesis.trace_contours(disc_mask(d))[0]) for d in (240, 160, 120)]
    assert "equally spaced" in thesis.doubt(boxes, TABLE_5_4)
    assert thesis.doubt(boxes[1:], TABLE_5_4) == ""


def test_nothing_to_see_is_a_reason():
    result = thesis.thesis_detect(CAMERA, TARGET, np.zeros((480, 640, 3), np.uint8))
    assert result.position_cam_m is None
    assert result.relative_ned_m is None
    assert "0 of 0" in result.reason


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"image_bgr": np.zeros((480, 640), np.uint8)}, "image"),
        ({"image_bgr": np.zeros((480, 640, 3), np.uint16)}, "image"),
        ({"R_nc": np.ones((3, 3))}, "R_nc"),
        ({"target": RingTarget.recommended(0.3)}, "target"),
    ],
)
def test_bad_arguments_are_refused_by_name(arguments, named):
    good = {"camera": CAMERA, "target": TARGET, "image_bgr": np.zeros((480, 640, 3), np.uint8)}
    with pytest.raises(ValueError, match=rf"^{named}:"):
        thesis.thesis_detect(**{**good, **arguments})


@pytest.mark.parametrize(
    "parameters",
    [{"k1": 1.0}, {"min_area": 0.0}, {"max_area": 2.0}, {"min_contours": 1}, {"max_uneven": 0.5}],
)
def test_filters_that_let_nothing_pass_are_refused(parameters):
    with pytest.raises(ValueError, match=next(iter(parameters))):
        thesis.ContourFilter(**parameters)
