"""Laws of rotations and geodesy, against scipy, another formula of the ellipsoid and published values."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from estimation import frames
from estimation.frames import Array

unit = st.floats(-1.0, 1.0)
vectors = st.tuples(unit, unit, unit).map(np.array)
angles = st.floats(-math.pi, math.pi)
rotations = st.builds(lambda v, s: frames.quat_exp(s * v), vectors, st.floats(0.0, 1.8))
latitudes = st.floats(-1.55, 1.55)
altitudes = st.floats(-400.0, 9_000.0)
places = st.tuples(latitudes, angles, altitudes)


def scipy_rotation(q: Array) -> Rotation:
    return Rotation.from_quat(q[[1, 2, 3, 0]])


@given(rotations, rotations, vectors)
def test_products_and_matrices_are_scipys(a: Array, b: Array, v: Array) -> None:
    product = frames.quat_multiply(a, b)
    np.testing.assert_allclose(np.linalg.norm(product), 1.0, atol=1e-14)
    np.testing.assert_allclose(
        frames.quat_to_matrix(product), (scipy_rotation(a) * scipy_rotation(b)).as_matrix(), atol=1e-14
    )
    np.testing.assert_allclose(frames.quat_to_matrix(a) @ v, scipy_rotation(a).apply(v), atol=1e-14)
    np.testing.assert_allclose(frames.compose(frames.quat_to_matrix(a), frames.quat_to_matrix(b)),
                               frames.quat_to_matrix(product), atol=1e-14)  # fmt: skip


@given(rotations)
def test_inverse_and_matrix_round_trip(q: Array) -> None:
    identity = frames.quat_multiply(q, frames.quat_conjugate(q))
    np.testing.assert_allclose(identity, [1.0, 0.0, 0.0, 0.0], atol=1e-14)
    back = frames.matrix_to_quat(frames.quat_to_matrix(q))
    np.testing.assert_allclose(back, frames.quat_normalise(q), atol=1e-14)
    assert back[0] >= 0.0


@given(vectors, st.sampled_from([0.0, 1e-12, 1e-7, 1e-4, 1.001e-4, 0.1, 1.0, 1.8]))
def test_exp_and_log_are_inverse_and_scipys(v: Array, size: float) -> None:
    rotation_vector = size * v
    q = frames.quat_exp(rotation_vector)
    np.testing.assert_allclose(frames.quat_log(q), rotation_vector, atol=1e-14)
    np.testing.assert_allclose(frames.quat_log(-q), rotation_vector, atol=1e-14)
    np.testing.assert_allclose(
        frames.quat_to_matrix(q), Rotation.from_rotvec(rotation_vector).as_matrix(), atol=1e-14
    )


@given(angles, st.floats(-1.57, 1.57), angles)
def test_euler_angles_are_scipys(roll: float, pitch: float, yaw: float) -> None:
    q = frames.euler_to_quat(roll, pitch, yaw)
    expected = Rotation.from_euler("ZYX", [yaw, pitch, roll])
    np.testing.assert_allclose(frames.quat_to_matrix(q), expected.as_matrix(), atol=1e-14)
    back = frames.quat_to_euler(q)
    np.testing.assert_allclose(
        frames.quat_to_matrix(frames.euler_to_quat(*back)), expected.as_matrix(), atol=1e-11
    )
    np.testing.assert_allclose(frames.quat_to_euler_columns(q[None])[0], back, atol=1e-7)


def test_euler_angles_at_the_poles() -> None:
    for pitch in (-0.5 * math.pi, 0.5 * math.pi):
        q = frames.euler_to_quat(0.3, pitch, 0.8)
        back = frames.quat_to_euler(q)
        assert back[1] == pytest.approx(pitch, abs=1e-7)
        np.testing.assert_allclose(
            frames.quat_to_matrix(frames.euler_to_quat(*back)), frames.quat_to_matrix(q), atol=1e-7
        )


@given(st.floats(-1e4, 1e4))
def test_wrapped_angles_are_the_same_direction(angle: float) -> None:
    wrapped = frames.wrap_pi(angle)
    assert -math.pi <= wrapped <= math.pi
    assert math.cos(wrapped - angle) == pytest.approx(1.0, abs=1e-12)


@given(vectors, vectors)
def test_skew_is_the_cross_product(a: Array, b: Array) -> None:
    np.testing.assert_allclose(frames.skew(a) @ b, np.cross(a, b), atol=1e-15)


@given(places)
def test_earth_centred_coordinates_by_the_reduced_latitude(place: tuple[float, float, float]) -> None:
    """x = a cos(beta) + h cos(phi), z = b sin(beta) + h sin(phi), with tan(beta) = (1 - f) tan(phi)."""
    latitude, longitude, altitude = (np.longdouble(v) for v in place)
    a, f = np.longdouble(6378137), 1 / np.longdouble("298.257223563")
    beta = np.arctan((1 - f) * np.tan(latitude))
    from_axis = a * np.cos(beta) + altitude * np.cos(latitude)
    expected = [
        from_axis * np.cos(longitude),
        from_axis * np.sin(longitude),
        a * (1 - f) * np.sin(beta) + altitude * np.sin(latitude),
    ]
    np.testing.assert_allclose(
        frames.geodetic_to_ecef(*place), np.array(expected, dtype=np.float64), atol=5e-9
    )


@settings(deadline=None)
@given(places, vectors)
def test_ned_round_trip(place: tuple[float, float, float], there: Array) -> None:
    origin = np.array(place)
    ned = 1e5 * there * [1.0, 1.0, 0.02]
    there_again = frames.ned_to_geodetic(ned, origin)
    back = frames.geodetic_to_ned(there_again[0], there_again[1], there_again[2], origin)
    np.testing.assert_allclose(back, ned, atol=1e-6)


@given(places)
def test_ned_axes_point_north_east_and_down(place: tuple[float, float, float]) -> None:
    latitude, longitude, altitude = place
    origin = np.array(place)
    m = frames.ecef_to_ned_matrix(latitude, longitude)
    np.testing.assert_allclose(m @ m.T, np.eye(3), atol=1e-14)
    step = 1e-7
    s = math.sin(latitude)
    w = math.sqrt(1.0 - frames.WGS84_E2 * s * s)
    meridian = frames.WGS84_A_M * (1.0 - frames.WGS84_E2) / w**3
    north = frames.geodetic_to_ned(latitude + step, longitude, altitude, origin)
    east = frames.geodetic_to_ned(latitude, longitude + step, altitude, origin)
    down = frames.geodetic_to_ned(latitude, longitude, altitude - 1.0, origin)
    np.testing.assert_allclose(north, [(meridian + altitude) * step, 0.0, 0.0], atol=1e-6)
    np.testing.assert_allclose(
        east, [0.0, (frames.WGS84_A_M / w + altitude) * math.cos(latitude) * step, 0.0], atol=1e-6
    )
    np.testing.assert_allclose(down, [0.0, 0.0, 1.0], atol=1e-8)


def test_published_values_of_the_ellipsoid() -> None:
    """NIMA TR 8350.2 (2000), tables 3.1, 3.3 and 3.4."""
    np.testing.assert_allclose(frames.geodetic_to_ecef(0.0, 0.0, 0.0), [6378137.0, 0.0, 0.0], atol=1e-9)
    pole = frames.geodetic_to_ecef(0.5 * math.pi, 0.0, 0.0)
    np.testing.assert_allclose(pole, [0.0, 0.0, 6356752.3142], atol=1e-4)
    assert pytest.approx(6.69437999014e-3, abs=1e-14) == frames.WGS84_E2
    assert frames.normal_gravity(0.0, 0.0) == pytest.approx(9.7803253359, abs=1e-10)
    assert frames.normal_gravity(0.5 * math.pi, 0.0) == pytest.approx(9.8321849378, abs=1e-9)
    # Free-air gradient in middle latitudes: 0.3086 mGal a metre.
    drop = frames.normal_gravity(math.pi / 4.0, 0.0) - frames.normal_gravity(math.pi / 4.0, 1000.0)
    assert drop == pytest.approx(3.086e-3, abs=3e-6)
