"""Ring targets as data and on paper."""

import itertools
import math
import re
import shutil
import struct
import subprocess
import xml.etree.ElementTree as ET

import cv2
import numpy as np
import pytest

from vision.printing import PAPERS_MM, label, to_pdf, to_png, to_svg
from vision.target import RingTarget

THESIS, RECOMMENDED = RingTarget.thesis(), RingTarget.recommended(1.0)


def test_thesis_target_is_six_equally_spaced_contours():
    assert len(THESIS.edges_m) == 6
    assert THESIS.spacing_m == pytest.approx(0.21 / 12)
    assert len(THESIS.red_bands_m) == 3
    assert RECOMMENDED.spacing_m is None


def test_thesis_size_is_measurable_at_both_ends_of_its_trial():
    """Table 5.4 in 640x480: at least 37 px for 100 contour pixels, at most 279.7 px for 20 % of the image."""
    focal, diameters = 530.47, 2.0 * np.array(THESIS.edges_m)
    for distance in (0.2, 2.0):
        pixels = focal * diameters / distance
        assert ((pixels >= 37.0) & (pixels <= 279.7)).sum() == 3


def test_any_two_edges_of_the_recommended_target_are_recognised_by_their_ratio():
    ratios: dict[tuple[int, int], list[float]] = {}
    for i, j in itertools.combinations(range(len(RECOMMENDED.edges_m)), 2):
        ratio = RECOMMENDED.edges_m[i] / RECOMMENDED.edges_m[j]
        ratios.setdefault((i % 2, j % 2), []).append(ratio)
    for same_kind in ratios.values():
        ordered = sorted(same_kind)
        assert all(b / a > 1.14 for a, b in itertools.pairwise(ordered))


def test_recommended_target_has_margin_and_edges_for_near_and_far():
    focal, half_height = 530.0, 240.0
    margin = RECOMMENDED.side_m / 2.0 - RECOMMENDED.edges_m[0]
    assert margin >= 0.15 * RECOMMENDED.diameter_m - 1e-9
    near = focal * np.array(RECOMMENDED.edges_m) / 0.3
    assert (near < 0.75 * half_height).sum() >= 3
    far = focal * np.array(RECOMMENDED.edges_m) / 34.0
    assert far[0] - far[1] > 3.5


def test_red_is_between_the_right_edges():
    ring = RingTarget((0.3, 0.2, 0.1))
    assert ring.is_red([0.35, 0.25, 0.15, 0.05]).tolist() == [False, True, False, True]
    assert ring.red_bands_m == [(0.3, 0.2), (0.1, 0.0)]


@pytest.mark.parametrize(
    "target", [THESIS, RECOMMENDED, RingTarget((0.3, 0.2, 0.1), 0.7, (180, 0, 0), name='a "b" \\ c')]
)
def test_toml_round_trip(target):
    assert RingTarget.from_toml(target.to_toml()) == target


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"edges_m": (0.1, 0.2)}, "edges_m"),
        ({"edges_m": (0.2, 0.2)}, "edges_m"),
        ({"edges_m": (0.2,)}, "edges_m"),
        ({"edges_m": (0.2, -0.1)}, "edges_m"),
        ({"edges_m": (math.nan, 0.1)}, "edges_m"),
        ({"edges_m": "wide"}, "edges_m"),
        ({"edges_m": (0.2, 0.1), "board_m": 0.3}, "board_m"),
        ({"edges_m": (0.2, 0.1), "red_rgb": (10, 200, 10)}, "red_rgb"),
        ({"edges_m": (0.2, 0.1), "white_rgb": (300, 0, 0)}, "white_rgb"),
    ],
)
def test_what_is_no_target_is_refused_by_name(arguments, named):
    with pytest.raises(ValueError, match=f"^{named}:"):
        RingTarget(**arguments)


@pytest.mark.parametrize("diameter", [0.0, -1.0, math.nan, "big"])
def test_diameters_are_checked(diameter):
    with pytest.raises(ValueError, match=r"^diameter_m:"):
        RingTarget.recommended(diameter)


def test_target_files_are_strict(tmp_path):
    path = tmp_path / "t.toml"
    path.write_text("edges_m = [0.2, 0.1]\ncolour = 'red'\n")
    with pytest.raises(ValueError, match=r"t\.toml.*colour"):
        RingTarget.load(path)


def test_svg_is_true_to_scale_and_says_its_size():
    root = ET.fromstring(to_svg(THESIS))
    space = "{http://www.w3.org/2000/svg}"
    view = [float(x) for x in root.attrib["viewBox"].split()]
    assert float(root.attrib["width"].removesuffix("mm")) == view[2]
    assert float(root.attrib["height"].removesuffix("mm")) == view[3]
    radii = [float(c.attrib["r"]) for c in root.iter(f"{space}circle")]
    assert radii == pytest.approx([1e3 * r for r in THESIS.edges_m], abs=1e-3)
    assert label(THESIS) in [t.text for t in root.iter(f"{space}text")]
    assert "210.0 mm" in label(THESIS)


def _streams(pdf: bytes) -> list[str]:
    """Return the page contents after checking that every cross-reference points at its object."""
    start = int(re.search(rb"startxref\n(\d+)", pdf).group(1))
    assert pdf[start : start + 4] == b"xref"
    offsets = [int(o) for o in re.findall(rb"(\d{10}) 00000 n", pdf)]
    for number, offset in enumerate(offsets, start=1):
        assert pdf[offset:].startswith(f"{number} 0 obj".encode())
    contents = re.findall(rb"/Length (\d+) >>\nstream\n(.*?)\nendstream", pdf, re.DOTALL)
    assert all(int(length) == len(body) for length, body in contents)
    return [body.decode() for _, body in contents]


def test_pdf_circles_have_the_right_radius_all_round():
    (page,) = _streams(to_pdf(RingTarget.thesis(0.14)))
    starts = [float(r) for r in re.findall(r"^(\S+) 0 m$", page, re.MULTILINE)]
    assert starts == pytest.approx([1e3 * r for r in RingTarget.thesis(0.14).edges_m], abs=1e-4)
    t = np.linspace(0.0, 1.0, 21)[:, None]
    for block, radius in zip(
        re.findall(r"^\S+ 0 m\n(.*?)\nh$", page, re.MULTILINE | re.DOTALL), starts, strict=True
    ):
        here = np.array([radius, 0.0])
        for line in block.splitlines():
            a, b, c = np.array(line.split()[:6], dtype=float).reshape(3, 2)
            curve = (1 - t) ** 3 * here + 3 * (1 - t) ** 2 * t * a + 3 * (1 - t) * t**2 * b + t**3 * c
            np.testing.assert_allclose(np.hypot(*curve.T), radius, rtol=1e-5)
            here = c
    assert f"{72 / 25.4:.8f} 0 0 {72 / 25.4:.8f} 0 0 cm" in page


def test_large_targets_are_tiled_without_gaps_and_white_sheets_left_out():
    pdf = to_pdf(RECOMMENDED)
    pages = _streams(pdf)
    box = [float(x) for x in re.search(rb"MediaBox \[0 0 (\S+) (\S+)\]", pdf).groups()]
    assert box == pytest.approx([210 * 72 / 25.4, 297 * 72 / 25.4], abs=1e-3)
    tiles = set()
    for page in pages:
        row, column = re.search(r"row (\d+) of 5, column (\d+) of 7", page).groups()
        x0, y0, wide, high = (
            float(x) for x in re.search(r"^(\S+) (\S+) (\S+) (\S+) re W n$", page, re.MULTILINE).groups()
        )
        cx, cy = (float(x) for x in re.search(r"^1 0 0 1 (\S+) (\S+) cm$", page, re.MULTILINE).groups())
        left, top = x0 - cx, cy - (y0 + high)
        assert left == pytest.approx((int(column) - 1) * wide - 650.0, abs=1e-3)
        assert top == pytest.approx((int(row) - 1) * high - 650.0, abs=1e-3)
        tiles.add((int(row), int(column)))
    assert len(tiles) == len(pages) < 35
    wide, high = 190.0, 263.0
    angles = np.linspace(0.0, 2.0 * np.pi, 500)
    for x, y in 500.0 * np.stack([np.cos(angles), np.sin(angles)], axis=1):
        assert (math.floor((y + 650.0) / high) + 1, math.floor((x + 650.0) / wide) + 1) in tiles


def test_paper_is_checked():
    with pytest.raises(ValueError, match="A4"):
        to_pdf(THESIS, "A9")
    with pytest.raises(ValueError, match="sheets"):
        to_pdf(RingTarget.recommended(8.0))
    assert len(_streams(to_pdf(RECOMMENDED, "A0"))) == 2
    assert set(PAPERS_MM) >= {"A4", "A3", "letter"}


@pytest.mark.skipif(shutil.which("pdftoppm") is None, reason="pdftoppm (poppler-utils) is not installed")
def test_pdf_renders_to_the_right_red_area(tmp_path):
    target, dpi = RingTarget.thesis(0.14), 100
    (tmp_path / "t.pdf").write_bytes(to_pdf(target))
    subprocess.run(["pdftoppm", "-r", str(dpi), "-png", tmp_path / "t.pdf", tmp_path / "t"], check=True)
    image = cv2.imread(str(next(tmp_path.glob("t*.png")))).astype(float)
    red = np.clip((image[..., 2] - image[..., 1]) / 178.0, 0.0, 1.0).sum() * (0.0254 / dpi) ** 2
    assert red == pytest.approx(math.pi * sum(a * a - b * b for a, b in target.red_bands_m), rel=0.01)


def test_png_carries_its_resolution_and_area():
    data = to_png(THESIS, 200.0)
    where = data.index(b"pHYs")
    assert struct.unpack(">IIB", data[where + 4 : where + 13]) == (7874, 7874, 1)
    image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).astype(float)
    assert image.shape[0] == round(THESIS.side_m / 0.0254 * 200)
    share = (245.0 - image[..., 1]) / (245.0 - 22.0)
    area = share.sum() * (0.0254 / 200.0) ** 2
    assert area == pytest.approx(math.pi * sum(a * a - b * b for a, b in THESIS.red_bands_m), rel=2e-3)


@pytest.mark.parametrize("dpi", [0.0, -1.0, math.nan, 1e6])
def test_png_resolution_is_checked(dpi):
    with pytest.raises(ValueError, match=r"^dpi:"):
        to_png(THESIS, dpi)
