"""The camera: rays, projection, files, and what it refuses."""

import math

import cv2
import numpy as np
import pytest

from vision.camera import PRESETS, Camera, check_rotation

LENS = (-0.27, -0.04, 0.0018, -0.0003, 0.24)


def test_default_principal_point_is_the_middle_of_the_pixel_grid():
    camera = Camera(640, 480, 500.0, 500.0)
    assert camera.centre == (319.5, 239.5)
    x, y = camera.rays([0.0, 639.0], [0.0, 479.0])
    assert x[0] == -x[1]
    assert y[0] == -y[1]


def test_field_of_view_of_the_thesis_camera_and_its_native_crop():
    whole, crop = Camera.preset("rpi-v2-640x480"), Camera.preset("rpi-v2-640x480-crop")
    assert math.degrees(whole.hfov_rad) == pytest.approx(62.2)
    assert math.degrees(whole.vfov_rad) == pytest.approx(48.7, abs=0.05)  # Table 5.1 prints 48.2
    assert whole.fx == pytest.approx(530.47, abs=0.01)
    assert math.degrees(crop.hfov_rad) == pytest.approx(26.5, abs=0.05)
    assert crop.fx / whole.fx == pytest.approx(2.5625)
    assert Camera.from_fov(640, 480, math.radians(62.2)).fx == pytest.approx(whole.fx)
    assert all(0.0 < camera.readout_s < 0.05 for camera in PRESETS.values())


@pytest.mark.parametrize("lens", [(), LENS[:4], LENS, (*LENS, 0.01, -0.02, 0.005)])
def test_projection_agrees_with_opencv_and_rays_invert_it(lens):
    camera = Camera(640, 480, 535.0, 540.0, 342.0, 236.0, lens)
    points = np.random.default_rng(3).uniform((-0.5, -0.4, 1.0), (0.5, 0.4, 1.0001), (500, 3)) * 7.0
    u, v = camera.project(points)
    expected, _ = cv2.projectPoints(
        points, np.zeros(3), np.zeros(3), camera.matrix, np.array(lens or (0.0,) * 4)
    )
    np.testing.assert_allclose(np.stack([u, v], axis=-1), expected[:, 0], atol=1e-9)
    x, y = camera.rays(u, v)
    np.testing.assert_allclose(np.stack([x, y], axis=-1), points[:, :2] / points[:, 2:], atol=1e-9)


def test_ray_table_is_of_pixel_centres_cached_and_read_only():
    camera = Camera(64, 48, 50.0, 51.0, distortion=LENS)
    table = camera.ray_table
    assert table.shape == (48, 64, 2)
    assert table.dtype == np.float32
    assert camera.ray_table is table
    x, y = camera.rays(10.0, 40.0)
    np.testing.assert_allclose(table[40, 10], [x, y], rtol=1e-6)
    with pytest.raises(ValueError, match="read-only"):
        table[0, 0] = 0.0


def test_points_behind_the_camera_have_no_pixel():
    u, v = Camera(64, 48, 50.0, 50.0).project([[0.0, 0.0, -1.0], [0.1, 0.1, 0.0], [0.0, 0.0, 1.0]])
    assert np.isnan(u).tolist() == [True, True, False]
    assert np.isnan(v).tolist() == [True, True, False]


def test_row_times_are_symmetric_about_the_middle_and_span_the_readout():
    camera = Camera(64, 48, 50.0, 50.0, readout_s=0.024)
    times = camera.row_time_s(np.arange(48))
    assert times[0] == -times[-1]
    assert times[1] - times[0] == pytest.approx(0.024 / 48)


@pytest.mark.parametrize(
    "camera", [*PRESETS.values(), Camera(640, 480, 535.9, 536.1, 342.3, 235.6, LENS, 0.02)]
)
def test_toml_and_camera_info_round_trip(camera):
    assert Camera.from_toml(camera.to_toml()) == camera
    assert Camera.from_camera_info(camera.to_camera_info(), camera.readout_s) == camera


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"width": 0}, "width"),
        ({"width": 640.5}, "width"),
        ({"height": 100_000}, "height"),
        ({"fx": 0.0}, "fx"),
        ({"fy": -3.0}, "fy"),
        ({"fx": math.nan}, "fx"),
        ({"fy": math.inf}, "fy"),
        ({"cx": math.nan}, "cx"),
        ({"cy": 1e9}, "cy"),
        ({"distortion": (0.1, 0.2, 0.3)}, "distortion"),
        ({"distortion": (0.1, math.nan, 0.0, 0.0)}, "distortion"),
        ({"readout_s": -0.1}, "readout_s"),
        ({"readout_s": "soon"}, "readout_s"),
    ],
)
def test_what_is_no_camera_is_refused_by_name(change, named):
    with pytest.raises(ValueError, match=f"^{named}:"):
        Camera(**{"width": 640, "height": 480, "fx": 500.0, "fy": 500.0, **change})


def test_field_of_view_in_degrees_and_unknown_presets_are_refused():
    with pytest.raises(ValueError, match=r"hfov_rad.*degrees"):
        Camera.from_fov(640, 480, 62.2)
    with pytest.raises(ValueError, match="rpi-v2-640x480"):
        Camera.preset("gopro")


@pytest.mark.parametrize(
    "matrix",
    [
        np.zeros((3, 3)),
        np.full((3, 3), np.nan),
        np.eye(2),
        [[500.0, 3.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]],
        [[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 2.0]],
    ],
)
def test_camera_matrices_with_zeros_nan_or_skew_are_refused(matrix):
    with pytest.raises(ValueError, match=r"^matrix:"):
        Camera.from_matrix(640, 480, matrix)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("width = 640", "height"),
        ("width = 640\nheight = 480\nfx = 1.0\nfy = 1.0\nzoom = 2.0", "zoom"),
        ("width = '640'\nheight = 480\nfx = 1.0\nfy = 1.0", "width"),
        ("width = ", "camera"),
        ("width = 640\nheight = 480\nfx = nan\nfy = 1.0", "fx"),
    ],
)
def test_camera_files_are_strict(tmp_path, text, said):
    path = tmp_path / "camera.toml"
    path.write_text(text)
    with pytest.raises(ValueError, match=said) as caught:
        Camera.load(path)
    assert str(path) in str(caught.value)


def test_fisheye_and_uncalibrated_camera_info_are_refused():
    info = Camera(640, 480, 500.0, 500.0).to_camera_info()
    with pytest.raises(ValueError, match="equidistant"):
        Camera.from_camera_info({**info, "distortion_model": "equidistant"})
    with pytest.raises(ValueError, match="calibrated"):
        Camera.from_camera_info({**info, "k": [0.0] * 9})
    with pytest.raises(ValueError, match="info"):
        Camera.from_camera_info({"width": 640})


@pytest.mark.parametrize(
    ("image", "said"),
    [
        (np.zeros((48, 64), np.uint8), "grey"),
        (np.zeros((48, 64, 1), np.uint8), "shape"),
        (np.zeros((48, 64, 4), np.uint8), "shape"),
        (np.zeros((48, 64, 3), np.uint16), "uint16"),
        (np.zeros((48, 64, 3), np.float32), "float32"),
        (np.zeros((0, 64, 3), np.uint8), "empty"),
        (np.zeros((64, 48, 3), np.uint8), "48x64"),
        (np.zeros((3000, 4000, 3), np.uint8), "4000x3000"),
        (np.zeros((48, 128, 3), np.uint8)[:, ::2], "contiguous"),
        (np.zeros((48, 64, 3), np.uint8)[..., ::-1], "contiguous"),
        (None, "NoneType"),
        ([[1, 2, 3]], "list"),
    ],
)
def test_images_that_are_not_the_cameras_are_refused(image, said):
    with pytest.raises(ValueError, match=f"^image:.*{said}"):
        Camera(64, 48, 50.0, 50.0).check_image(image)


def test_a_good_image_passes_as_it_is():
    image = np.zeros((48, 64, 3), np.uint8)
    assert Camera(64, 48, 50.0, 50.0).check_image(image) is image


@pytest.mark.parametrize(
    "matrix",
    [
        np.eye(2),
        np.diag([1.0, 1.0, -1.0]),
        2.0 * np.eye(3),
        np.full((3, 3), np.nan),
        "north",
        np.zeros((3, 3)),
    ],
)
def test_what_is_no_rotation_is_refused_by_name(matrix):
    with pytest.raises(ValueError, match=r"^R_nc:"):
        check_rotation(matrix, "R_nc")
