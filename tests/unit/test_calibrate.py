"""Calibration from real chessboards and from drawn ChArUco boards."""

import itertools

import cv2
import numpy as np
import pytest

from vision.calibrate import Charuco, Chessboard, calibrate, coverage_picture
from vision.camera import Camera

REFERENCE_FOCAL_PX = 535.9157  # left_intrinsics.yml
TRUE = Camera(640, 480, 520.0, 524.0, 322.0, 236.0, (-0.12, 0.03, 0.0008, -0.0005, 0.0))


@pytest.fixture(scope="module")
def real(data_dir):
    files = sorted((data_dir / "camera_calibration").glob("left*.jpg"))
    if not files:
        pytest.skip("real data not found: set DECKFIX_DATA")
    return calibrate(((f.name, cv2.imread(str(f))) for f in files), Chessboard(9, 6, 0.025))


def test_real_chessboards_give_the_reference_focal_length(real):
    assert real.camera.fx == pytest.approx(REFERENCE_FOCAL_PX, rel=0.01)
    assert real.camera.fy == pytest.approx(REFERENCE_FOCAL_PX, rel=0.01)
    assert real.rms_px < 0.39  # what the reference reports
    assert len(real.views) + len(real.skipped) == 13


def test_the_result_says_how_well_it_is_known(real):
    assert 0.0 < real.sigma["fx"] < 3.0
    assert real.focal_sigma >= 0.5 * (real.sigma["fx"] + real.sigma["fy"]) / real.camera.fx
    assert 0.0005 < real.focal_sigma < 0.01
    text = real.summary()
    assert f"{100 * real.focal_sigma:.2f} %" in text
    assert "13 views" in text


def test_coverage_picture_marks_where_corners_were(real):
    picture = coverage_picture(real)
    assert picture.shape == (480, 640, 3)
    assert tuple(picture[20, 20]) == (235, 235, 255)  # nothing in the upper left corner
    assert picture[240, 320].max() < 250
    assert 0.5 < real.coverage < 0.9


def draw(board: Charuco, turn: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Return a picture of the board through TRUE, by looking up every pixel's ray on the board."""
    per_metre = 4000.0
    size = (round(board.columns * board.square_m * per_metre), round(board.rows * board.square_m * per_metre))
    flat = board.board().generateImage(size, marginSize=0)
    rotation = cv2.Rodrigues(turn)[0]
    rays = np.concatenate([TRUE.ray_table.astype(float), np.ones((480, 640, 1))], axis=-1) @ rotation
    origin = -rotation.T @ place
    reach = -origin[2] / rays[..., 2]
    on_board = ((origin[:2] + reach[..., None] * rays[..., :2]) * per_metre - 0.5).astype(np.float32)
    image = cv2.remap(flat, on_board, None, cv2.INTER_AREA, borderMode=cv2.BORDER_CONSTANT, borderValue=255)
    return cv2.GaussianBlur(image, (0, 0), 0.7)


@pytest.fixture(scope="module")
def charuco_pictures():
    board = Charuco(7, 5, 0.04, 0.03)
    middle = np.array([0.14, 0.10, 0.0])
    pictures = []
    for k, (x, y) in enumerate(itertools.product((-0.5, 0.0, 0.5), (-0.5, 0.5))):
        turn = np.array([0.55 * (-1) ** k, 0.5 * (1 if x <= 0 else -1), 0.1 * k])
        centre = np.array([x * 0.25, y * 0.2, 0.42 + 0.03 * k])
        pictures.append((f"picture {k}", draw(board, turn, centre - cv2.Rodrigues(turn)[0] @ middle)))
    return board, pictures


def test_charuco_boards_partly_out_of_view_give_the_camera_back(charuco_pictures):
    board, pictures = charuco_pictures
    result = calibrate(pictures, board)
    assert len(result.views) == 6
    assert any(len(view.pixels) < 24 for view in result.views)
    assert result.camera.fx == pytest.approx(TRUE.fx, rel=0.005)
    assert result.camera.fy == pytest.approx(TRUE.fy, rel=0.005)
    assert abs(result.camera.fx - TRUE.fx) < 4.0 * result.focal_sigma * TRUE.fx
    assert result.rms_px < 0.3


def test_a_picture_with_wrong_corners_is_left_out_and_named(charuco_pictures):
    board, pictures = charuco_pictures
    squeezed = cv2.resize(pictures[2][1], None, fx=0.8, fy=1.0)
    squeezed = cv2.copyMakeBorder(squeezed, 0, 0, 0, 640 - squeezed.shape[1], cv2.BORDER_CONSTANT, value=255)
    result = calibrate(
        [*pictures, ("squeezed", squeezed), ("blank", np.full((480, 640), 255, np.uint8))], board
    )
    assert "residual" in result.skipped["squeezed"]
    assert "not found" in result.skipped["blank"]
    assert result.camera.fx == pytest.approx(TRUE.fx, rel=0.005)


def test_too_few_or_mixed_pictures_are_refused(charuco_pictures):
    board, pictures = charuco_pictures
    with pytest.raises(ValueError, match="found in 2 pictures, 4 or more"):
        calibrate(pictures[:2], board)
    with pytest.raises(ValueError, match="found in 0 pictures"):
        calibrate([], board)
    with pytest.raises(ValueError, match="320x240"):
        calibrate([*pictures, ("small", np.zeros((240, 320), np.uint8))], board)
    with pytest.raises(ValueError, match="deep is not"):
        calibrate([("deep", np.zeros((480, 640), np.uint16))], board)


@pytest.mark.parametrize(
    ("make", "named"),
    [
        (lambda: Chessboard(2, 6, 0.025), "columns"),
        (lambda: Chessboard(9, 6, 0.0), "square_m"),
        (lambda: Charuco(7, 5, 0.04, 0.05), "marker_m"),
        (lambda: Charuco(7, 5, 0.04, 0.03, "DICT_9X9"), "dictionary"),
        (lambda: Charuco(20, 20, 0.04, 0.03), "dictionary"),
    ],
)
def test_impossible_boards_are_refused_by_name(make, named):
    with pytest.raises(ValueError, match=named):
        make()
