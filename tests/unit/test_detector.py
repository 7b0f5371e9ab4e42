"""The target detector on rendered pictures, and its refusals."""

import json
import math
from functools import partial

import cv2
import numpy as np
import pytest

from deckfix.cli import main
from estimation.frames import R_CB_NOMINAL, euler_to_quat, quat_to_matrix
from simulation.renderer import Conditions, Renderer
from vision import Camera, NoFix, RingTarget, TargetDetector, VisionFix
from vision.overlay import centre_ellipse, draw_overlay

CAMERA = Camera.from_fov(640, 480, math.radians(62.2))
THESIS, RECOMMENDED = RingTarget.thesis(1.0), RingTarget.recommended(1.0)
NOISY = Conditions(read_noise=3.0)
detector_of = partial(TargetDetector, engine="numpy")


def attitude(roll_deg, pitch_deg, yaw_deg):
    return quat_to_matrix(euler_to_quat(*np.radians([roll_deg, pitch_deg, yaw_deg]))) @ R_CB_NOMINAL.T


def scene(target, height, roll, pitch, yaw, pixel, conditions=NOISY, camera=CAMERA, seed=1, **kw):
    """Return image, R_nc and true P^c of a target whose centre is at ``pixel``."""
    R_nc = attitude(roll, pitch, yaw)
    x, y = camera.rays(*pixel)
    ray = np.array([float(x), float(y), 1.0])
    truth = ray * height / (R_nc @ ray)[2]
    image = Renderer(camera, target).render(
        R_nc, -R_nc @ truth, np.random.default_rng(seed), conditions, **kw
    )
    return image, R_nc, truth


@pytest.mark.parametrize("target", [THESIS, RECOMMENDED], ids=["thesis", "recommended"])
@pytest.mark.parametrize(
    ("height", "bound"), [(0.3, 1e-3), (1.0, 1e-3), (5.0, 1e-3), (10.0, 1e-3), (15.0, 1e-3), (34.0, 1.5e-2)]
)
def test_finds_the_target_near_and_far(target, height, bound):
    image, R_nc, truth = scene(target, height, 20.0, -15.0, 70.0, (330.0, 250.0))
    fix = detector_of(CAMERA, target).detect(image, R_nc)
    assert isinstance(fix, VisionFix)
    assert np.linalg.norm(fix.position_cam_m - truth) < bound * np.linalg.norm(truth)
    error = fix.position_cam_m - truth
    assert error @ np.linalg.solve(fix.covariance_m2, error) < 40.0
    assert np.linalg.eigvalsh(fix.covariance_m2).min() > 0.0


@pytest.mark.parametrize("engine", ["numpy", "compiled"])
def test_near_the_deck_a_few_degrees_of_its_rings_are_enough(engine):
    """0.3 m above a tilted one, its centre 0.15 or 0.18 m outside of the picture, with an error of the attitude."""
    if engine == "compiled":
        pytest.importorskip("numba")
    detector, errors = TargetDetector(CAMERA, RECOMMENDED, engine=engine), []
    wrong = quat_to_matrix(euler_to_quat(0.005, -0.004, 0.0))
    for out in (260.0, 320.0):
        beside = ((100, -out), (500, 480 + out), (-out, 100), (640 + out, 400), (320, -out), (-out, 240))
        for k, pixel in enumerate(beside):
            for turn, tilt in ((0.0, (1.5, -1.0)), (77.0, (-1.0, 1.5)), (160.0, (2.0, 1.0))):
                deck = quat_to_matrix(euler_to_quat(*np.radians([*tilt, 0.0])))
                image, R_nc, truth = scene(RECOMMENDED, 0.3, 3.0, -2.0, 50.0 * k + turn, pixel, R_nd=deck)
                fix = detector.detect(image, wrong @ R_nc, truth)
                if isinstance(fix, VisionFix):
                    errors.append(np.linalg.norm(fix.position_cam_m - truth) / np.linalg.norm(truth))
    assert len(errors) >= 24
    assert np.median(errors) < 2e-3
    assert max(errors) < 1e-2


def test_covariance_grows_with_distance():
    sigmas = []
    for height in (1.0, 3.0, 10.0, 30.0):
        image, R_nc, _ = scene(THESIS, height, 10.0, 5.0, 0.0, (320.0, 240.0))
        sigmas.append(detector_of(CAMERA, THESIS).detect(image, R_nc).covariance_m2[2, 2] ** 0.5)
    assert sigmas == sorted(sigmas)


def test_prior_gives_the_same_fix_as_the_search():
    image, R_nc, truth = scene(THESIS, 6.0, 12.0, 8.0, 30.0, (300.0, 200.0))
    detector = detector_of(CAMERA, THESIS)
    found = detector.detect(image, R_nc)
    tracked = detector.detect(image, R_nc, prior=found)
    by_position = detector.detect(image, R_nc, prior=truth * 1.003)
    assert (found.method, tracked.method, by_position.method) == ("found", "tracked", "tracked")
    for other in (tracked, by_position):
        assert np.abs(other.position_cam_m - found.position_cam_m).max() < 3e-3
    lost = detector.detect(image, R_nc, prior=truth + np.array([2.0, 0.0, 0.0]))
    assert lost.method == "found"


@pytest.mark.parametrize(
    ("roll", "conditions", "options"),
    [
        (12.0, NOISY, {}),
        (-20.0, Conditions(bar_px=18.0, read_noise=3.0), {"deck_tilt_sigma_rad": 0.05}),
        (8.0, Conditions(motion_px=5.0, motion_angle_rad=0.6, read_noise=3.0), {"focal_sigma": 0.003}),
    ],
    ids=["plain", "bar, tilt", "motion"],
)
def test_compiled_and_numpy_give_the_same_fix(roll, conditions, options):
    pytest.importorskip("numba")
    lens = Camera(640, 480, 520.0, 524.0, 322.0, 236.0, (-0.12, 0.03, 0.001, -0.0005, 0.0), readout_s=0.02)
    for camera, height, pixel in ((CAMERA, 3.0, (300.0, 220.0)), (lens, 6.0, (60.0, 250.0))):
        image, R_nc, truth = scene(RECOMMENDED, height, roll, 5.0, 40.0, pixel, conditions, camera)
        both = [TargetDetector(camera, RECOMMENDED, engine=e, **options) for e in ("compiled", "numpy")]
        for attitude, prior in ((R_nc, None), (R_nc, truth * 1.002), (None, None)):
            rate = np.array([0.2, -0.1, 0.3])
            a, b = (d.detect(image, attitude, prior, rate) for d in both)
            assert type(a) is type(b)
            assert isinstance(a, VisionFix) or attitude is None
            if isinstance(a, NoFix):
                assert a == b
                continue
            np.testing.assert_allclose(a.position_cam_m, b.position_cam_m, rtol=1e-9, atol=1e-11)
            np.testing.assert_allclose(a.covariance_m2, b.covariance_m2, rtol=1e-6, atol=1e-14)
            assert (a.rings, a.method) == (b.rings, b.method)


def test_works_without_attitude():
    image, _, truth = scene(THESIS, 4.0, 15.0, -10.0, 40.0, (280.0, 220.0))
    detector = detector_of(CAMERA, THESIS)
    fix = detector.detect(image)
    assert np.linalg.norm(fix.position_cam_m - truth) < 0.004 * np.linalg.norm(truth)


def test_measures_a_tilted_deck():
    deck = quat_to_matrix(euler_to_quat(*np.radians([4.0, -3.0, 0.0])))
    image, R_nc, truth = scene(THESIS, 5.0, 10.0, 12.0, 20.0, (320.0, 230.0), R_nd=deck)
    fix = detector_of(CAMERA, THESIS).detect(image, R_nc)
    assert np.linalg.norm(fix.position_cam_m - truth) < 2e-3 * np.linalg.norm(truth)
    tilt = math.acos(deck[:, 2] @ np.array([0.0, 0.0, 1.0]))
    assert np.hypot(*fix.tilt_rad) == pytest.approx(tilt, abs=math.radians(0.3))


@pytest.mark.parametrize(
    "conditions",
    [
        Conditions(bar_px=18.0, bar_offset=0.2),
        Conditions(shadow=0.4, shadow_offset=0.2),
        Conditions(light=1.5),
        Conditions(light=0.25),
        Conditions(gamma=2.2),
        Conditions(defocus_px=1.5),
        Conditions(cast_rgb=(1.15, 0.95, 0.7)),
        Conditions(distractors=4),
        Conditions(jpeg_quality=80),
    ],
    ids=["bar", "shadow", "clipped", "dark", "gamma", "defocus", "warm", "distractors", "jpeg"],
)
def test_bears_bad_light_and_things_in_the_way(conditions):
    image, R_nc, truth = scene(THESIS, 5.0, 15.0, 10.0, -50.0, (310.0, 260.0), conditions)
    fix = detector_of(CAMERA, THESIS).detect(image, R_nc)
    assert isinstance(fix, VisionFix)
    assert np.linalg.norm(fix.position_cam_m - truth) < 2e-3 * np.linalg.norm(truth)


def test_a_bar_across_the_middle_hides_the_inner_edges_only():
    """Most lines then show no edge, and the contrast is that of the others."""
    bar = Conditions(read_noise=3.0, bar_px=45.0, bar_offset=0.02, bar_angle_rad=0.9)
    image, R_nc, truth = scene(RECOMMENDED, 2.0, 8.0, -12.0, 30.0, (340.0, 180.0), bar)
    fix = detector_of(CAMERA, RECOMMENDED).detect(image, R_nc)
    assert isinstance(fix, VisionFix)
    assert np.linalg.norm(fix.position_cam_m - truth) < 2e-3 * np.linalg.norm(truth)


def test_finds_a_target_partly_out_of_the_frame():
    image, R_nc, truth = scene(THESIS, 5.0, 10.0, -5.0, 15.0, (12.0, 250.0))
    fix = detector_of(CAMERA, THESIS).detect(image, R_nc)
    assert np.linalg.norm(fix.position_cam_m - truth) < 2e-3 * np.linalg.norm(truth)


def test_lens_distortion_is_taken_out():
    camera = Camera(640, 480, 520.0, 524.0, 322.0, 236.0, (-0.12, 0.03, 0.001, -0.0005, 0.0))
    image, R_nc, truth = scene(THESIS, 4.0, 8.0, 12.0, 30.0, (150.0, 120.0), camera=camera)
    fix = detector_of(camera, THESIS).detect(image, R_nc)
    assert np.linalg.norm(fix.position_cam_m - truth) < 1e-3 * np.linalg.norm(truth)


def test_rolling_shutter_is_taken_out_with_the_body_rate():
    camera = Camera(640, 480, CAMERA.fx, CAMERA.fy, readout_s=0.024)
    rate_body = np.array([0.5, -0.3, 0.4])
    image, R_nc, truth = scene(
        THESIS, 5.0, 10.0, -5.0, 15.0, (300.0, 330.0), camera=camera, rate_c_radps=R_CB_NOMINAL @ rate_body
    )
    detector = detector_of(camera, THESIS)
    corrected = detector.detect(image, R_nc, body_rate_radps=rate_body)
    ignored = detector.detect(image, R_nc)
    assert np.linalg.norm(corrected.position_cam_m - truth) < 5e-4 * np.linalg.norm(truth)
    assert np.linalg.norm(ignored.position_cam_m - truth) > 5 * np.linalg.norm(
        corrected.position_cam_m - truth
    )


def test_stated_errors_widen_the_covariance_by_what_they_do():
    image, R_nc, truth = scene(THESIS, 5.0, 0.0, 0.0, 0.0, (319.5, 239.5))
    plain = detector_of(CAMERA, THESIS).detect(image, R_nc)
    focal = detector_of(CAMERA, THESIS, focal_sigma=0.003).detect(image, R_nc)
    assert math.sqrt(focal.covariance_m2[2, 2]) == pytest.approx(0.003 * truth[2], rel=0.05)
    off = Camera(640, 480, CAMERA.fx * 1.003, CAMERA.fy * 1.003)
    shifted = detector_of(off, THESIS).detect(image, R_nc)
    assert shifted.position_cam_m[2] - plain.position_cam_m[2] == pytest.approx(0.003 * truth[2], rel=0.05)
    turned = detector_of(CAMERA, THESIS, attitude_sigma_rad=0.01).detect(image, R_nc)
    assert math.sqrt(turned.covariance_m2[0, 0]) == pytest.approx(0.01 * truth[2], rel=0.05)


def test_thesis_method_is_reached_through_the_same_call():
    target = RingTarget.thesis()
    image, R_nc, truth = scene(target, 0.8, 0.0, 0.0, 0.0, (319.5, 239.5))
    fix = detector_of(CAMERA, target, method="thesis").detect(image, R_nc)
    assert fix.method == "thesis"
    assert np.linalg.norm(fix.position_cam_m - truth) < 0.08 * np.linalg.norm(truth)


def test_no_fix_without_a_target():
    image, R_nc, _ = scene(THESIS, 8.0, 0.0, 0.0, 0.0, (320.0, 240.0), Conditions(target=False))
    result = detector_of(CAMERA, THESIS).detect(image, R_nc)
    assert isinstance(result, NoFix)
    assert not result
    assert "no red region" in result.reason


def test_no_false_fix_among_distractors():
    detector = detector_of(CAMERA, THESIS)
    for seed in range(12):
        conditions = Conditions(target=False, distractors=5, boats=2, read_noise=3.0)
        image, R_nc, _ = scene(THESIS, 8.0, 10.0, 5.0, 0.0, (320.0, 240.0), conditions, seed=seed)
        assert isinstance(detector.detect(image, R_nc), NoFix), seed


def test_no_false_fix_on_the_sea(data_dir):
    photos = sorted((data_dir / "sea_photos").glob("*.jpg"))
    assert len(photos) == 6
    for photo in photos:
        image = cv2.imread(str(photo))
        camera = Camera.from_fov(image.shape[1], image.shape[0], math.radians(62.2))
        for target in (THESIS, RECOMMENDED):
            for R_nc in (attitude(0.0, 0.0, 0.0), attitude(0.0, 50.0, 0.0), None):
                assert isinstance(detector_of(camera, target).detect(image, R_nc), NoFix), photo.name


IMAGE = np.zeros((480, 640, 3), dtype=np.uint8)


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (np.zeros((480, 640), dtype=np.uint8), "image"),
        (np.zeros((480, 640, 3), dtype=np.uint16), "image"),
        (np.zeros((0, 0, 3), dtype=np.uint8), "image"),
        (np.zeros((481, 640, 3), dtype=np.uint8), "image"),
        (np.zeros((480, 1280, 3), dtype=np.uint8)[:, ::2], "image"),
        (np.zeros((9000, 9000, 3), dtype=np.uint8), "image"),
        (None, "image"),
    ],
    ids=["grey", "16 bit", "empty", "size", "strided", "huge", "none"],
)
def test_refuses_what_is_no_image_of_the_camera(image, words):
    with pytest.raises(ValueError, match=words):
        detector_of(CAMERA, THESIS).detect(image)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"R_nc": np.eye(3) * 1.01}, "R_nc"),
        ({"R_nc": np.diag([1.0, 1.0, -1.0])}, "R_nc"),
        ({"R_nc": np.full((3, 3), np.nan)}, "R_nc"),
        ({"R_nc": np.eye(4)}, "R_nc"),
        ({"prior": [1.0, 2.0]}, "prior"),
        ({"prior": [np.nan, 0.0, 1.0]}, "prior"),
        ({"body_rate_radps": "fast"}, "body_rate_radps"),
    ],
)
def test_refuses_arguments_by_name(arguments, words):
    with pytest.raises(ValueError, match=words):
        detector_of(CAMERA, THESIS).detect(IMAGE, **arguments)


@pytest.mark.parametrize(
    "options",
    [
        {"method": "magic"},
        {"engine": "magic"},
        {"focal_sigma": -1.0},
        {"attitude_sigma_rad": math.nan},
        {"R_cb": np.ones((3, 3))},
    ],
)
def test_refuses_options_by_name(options):
    with pytest.raises(ValueError, match=next(iter(options))):
        TargetDetector(CAMERA, THESIS, **options)


def test_overlay_draws_fix_and_reason():
    image, R_nc, _ = scene(THESIS, 5.0, 10.0, -5.0, 15.0, (300.0, 250.0))
    fix = detector_of(CAMERA, THESIS).detect(image, R_nc)
    before = image.copy()
    drawn = draw_overlay(CAMERA, THESIS, image, fix)
    assert np.array_equal(image, before)
    assert (drawn != image).any(axis=2).sum() > 500
    assert np.linalg.eigvalsh(centre_ellipse(CAMERA, fix)).min() > 0.0
    refused = draw_overlay(CAMERA, THESIS, IMAGE, NoFix("nothing red"))
    assert (refused != IMAGE).any()


def test_command_prints_writes_and_draws(tmp_path, capsys):
    image, _, truth = scene(RECOMMENDED, 4.0, 0.0, 0.0, 0.0, (300.0, 250.0))
    for name, picture in (("a.png", image), ("b.png", IMAGE)):
        cv2.imwrite(str(tmp_path / name), picture)
    files = [str(tmp_path / "a.png"), str(tmp_path / "b.png")]
    json_path = tmp_path / "fixes.json"
    arguments = ["detect", *files, "--attitude", "0", "0", "0", "--json", str(json_path)]
    assert main([*arguments, "--overlay", str(tmp_path)]) == 0
    out = capsys.readouterr().out
    assert "no fix: no red region" in out
    rows = json.loads(json_path.read_text())
    assert np.allclose(rows[0]["fix"]["position_cam_m"], truth, atol=0.01)
    assert rows[1]["fix"] is None
    assert cv2.imread(str(tmp_path / "b.overlay.png")).shape == image.shape
    assert main(arguments) == 1
    assert "--force" in capsys.readouterr().err


def test_command_names_the_file_that_is_no_picture(tmp_path, capsys):
    (tmp_path / "x.png").write_bytes(b"not a picture")
    assert main(["detect", str(tmp_path / "x.png")]) == 1
    captured = capsys.readouterr()
    assert "x.png: not a picture" in captured.err
    assert "Traceback" not in captured.err
