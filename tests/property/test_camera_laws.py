"""Laws of cameras and targets for any parameters."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from vision.camera import Camera
from vision.target import RingTarget

mild = st.floats(-0.1, 0.1)
cameras = st.builds(
    Camera,
    st.integers(16, 2000),
    st.integers(16, 2000),
    st.floats(1000.0, 4000.0),
    st.floats(1000.0, 4000.0),
    distortion=st.one_of(
        st.just(()), st.tuples(mild, mild, st.floats(-0.003, 0.003), st.floats(-0.003, 0.003), mild)
    ),
    readout_s=st.floats(0.0, 0.1),
)


@settings(max_examples=60, deadline=None)
@given(cameras, st.floats(0.0, 1.0), st.floats(0.0, 1.0))
@example(Camera(16, 1969, 1000.0, 1000.0, distortion=(0.0, 0.0, 0.0, 0.0, -0.0625)), 0.0, 0.0)
def test_projecting_a_ray_gives_its_pixel_back(camera, a, b):
    u, v = a * (camera.width - 1), b * (camera.height - 1)
    x, y = camera.rays(u, v)
    if np.isnan(x):  # a lens that folds back before its corner: refused, never wrong
        assert camera.distortion
        assert np.isnan(y)
        with pytest.raises(ValueError, match="cannot be inverted"):
            _ = camera.ray_table
        return
    back = camera.project(np.array([x, y, 1.0]))
    assert abs(back[0] - u) < 1e-6
    assert abs(back[1] - v) < 1e-6


@settings(max_examples=60, deadline=None)
@given(cameras)
def test_cameras_survive_their_files(camera):
    assert Camera.from_toml(camera.to_toml()) == camera
    assert Camera.from_camera_info(camera.to_camera_info(), camera.readout_s) == camera


radii = st.lists(st.floats(1e-3, 10.0), min_size=2, max_size=9, unique=True).map(
    lambda r: tuple(sorted(r, reverse=True))
)


@settings(max_examples=60, deadline=None)
@given(radii, st.text(max_size=12).filter(str.isprintable))
def test_targets_survive_their_files(edges, name):
    target = RingTarget(edges, name=name)
    assert RingTarget.from_toml(target.to_toml()) == target


@settings(max_examples=60, deadline=None)
@given(radii, st.floats(0.0, 12.0))
def test_red_is_where_the_bands_are(edges, radius):
    target = RingTarget(edges)
    inside = any(inner <= radius < outer for outer, inner in target.red_bands_m)
    on_edge = min(abs(radius - r) for r in edges) < 1e-9
    assert on_edge or bool(target.is_red(radius)) == inside
