"""The simulated sea and raft: heights, responses and bounds that are known."""

from __future__ import annotations

import numpy as np
import pytest

from simulation.jets import Array, Tones, constant, product, step
from simulation.platform import Platform, Raft
from simulation.sea import BEAUFORT_HS_M, Sea, Wave, beaufort, developed_period_s, jonswap, pierson_moskowitz


@pytest.mark.parametrize("gamma", [1.0, 3.3, 7.0])
def test_spectra_have_the_height_and_the_peak_asked_for(gamma: float) -> None:
    omega = np.linspace(0.05, 60.0, 400_000)
    spectrum = jonswap(omega, 0.6, 3.9, gamma)
    assert 4.0 * np.sqrt(np.trapezoid(spectrum, omega)) == pytest.approx(0.6, rel=0.02)
    assert 2.0 * np.pi / omega[np.argmax(spectrum)] == pytest.approx(3.9, rel=1e-3)
    if gamma == 1.0:
        np.testing.assert_allclose(spectrum, pierson_moskowitz(omega, 0.6, 3.9))


def test_developed_seas() -> None:
    """Pierson and Moskowitz (1964): at 10 m/s 2.14 m and 7.3 s."""
    assert developed_period_s(0.21 * 10.0**2 / 9.81) == pytest.approx(2.0 * np.pi * 10.0 / (0.877 * 9.81))
    with pytest.raises(ValueError, match="Beaufort 4"):
        beaufort(4)
    with pytest.raises(ValueError, match="'tsunami'"):
        Wave("tsunami", 1.0, 5.0).spectrum(np.ones(3))


@pytest.mark.parametrize("force", [0, 1, 2, 3])
def test_drawn_seas_have_the_height_of_their_force(force: int) -> None:
    sea = Sea.draw(beaufort(force), np.random.default_rng(force))
    assert sea.significant_height_m == pytest.approx(BEAUFORT_HS_M[force], rel=0.06)
    again = Sea.draw(beaufort(force), np.random.default_rng(force))
    np.testing.assert_array_equal(sea.phase_rad, again.phase_rad)
    assert not np.array_equal(sea.phase_rad, Sea.draw(beaufort(force), np.random.default_rng(99)).phase_rad)


def test_raft_follows_long_waves_and_not_short_ones() -> None:
    raft = Raft()
    slow, fast = np.array([0.3]), np.array([12.0])
    assert abs(raft.heave_rao(slow)[0]) == pytest.approx(1.0, abs=0.02)
    assert abs(raft.heave_rao(fast)[0]) < 0.03
    assert abs(raft.tilt_rao(slow)[0]) == pytest.approx(1.0, abs=0.02)


def test_motion_in_a_single_long_wave() -> None:
    """Running north: heave is the elevation, sway a quarter period later, and the deck leans up the slope."""
    omega, amplitude = 0.4, 0.5
    sea = Sea(np.array([amplitude]), np.array([omega]), np.array([0.0]), np.array([0.0]))
    nothing = Tones(np.zeros((3, 1)), np.ones((3, 1)), np.zeros((3, 1)))
    t = np.linspace(0.0, 30.0, 300)
    motion = Platform(Raft(freeboard_m=0.4), sea, nothing).motion(t)
    np.testing.assert_allclose(-motion.position[0, :, 2], 0.4 + amplitude * np.cos(omega * t), atol=0.03)
    np.testing.assert_allclose(motion.position[0, :, 0], amplitude * np.sin(omega * t), atol=0.03)
    np.testing.assert_allclose(motion.position[0, :, 1], 0.0, atol=1e-12)
    slope = amplitude * omega**2 / 9.81 * np.sin(omega * t)
    np.testing.assert_allclose(motion.normal[0, :, 0], slope, atol=0.1 * slope.max())


def test_raft_stays_in_its_circle_and_its_derivatives_fit() -> None:
    rng = np.random.default_rng(4)
    raft = Raft(circle_m=3.0)
    platform = Platform.draw(raft, Sea.draw([], rng), rng)
    t = np.linspace(0.0, 3600.0, 20_000)
    assert np.linalg.norm(platform.motion(t).position[0, :, :2], axis=1).max() <= 3.0
    rough = Platform.draw(raft, Sea.draw([*beaufort(3), Wave("swell", 0.4, 9.0)], rng), rng)
    h = 1e-4
    t = np.linspace(0.0, 60.0, 400)
    ahead, here, behind = (rough.motion(t + d) for d in (h, 0.0, -h))
    for k in range(3):
        slope = (ahead.position[k] - behind.position[k]) / (2.0 * h)
        np.testing.assert_allclose(here.position[k + 1], slope, atol=1e-5)
        slope = (ahead.normal[k] - behind.normal[k]) / (2.0 * h)
        np.testing.assert_allclose(here.normal[k + 1], slope, atol=1e-5)


def test_products_and_steps_have_exact_derivatives() -> None:
    t = np.linspace(0.01, 3.9, 500)
    h = 1e-4
    tones = Tones(np.ones((3, 2)), np.array([[1.0, 2.0]] * 3), np.zeros((3, 2)))

    def both(
        t: Array,
    ) -> Array:
        return product(step(t, 1.0, 2.0) + constant(t, 0.5), tones.motion(t))

    for k in range(3):
        slope = (both(t + h)[k] - both(t - h)[k]) / (2.0 * h)
        np.testing.assert_allclose(both(t)[k + 1], slope, atol=2e-6)
    ends = step(np.array([0.0, 1.0, 2.0, 3.0, 9.0]), 1.0, 2.0)
    np.testing.assert_allclose(ends[0], [0.0, 0.0, 0.5, 1.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(ends[1:, [0, 1, 3, 4]], 0.0, atol=1e-9)
