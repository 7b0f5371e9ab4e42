"""The band-pass block: its forms agree with each other, and it follows a sea's spectrum."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from estimation import heave

Array = NDArray[np.float64]

FREQUENCY = np.arange(0.02, 1.3, 0.005)
NOISE = 1e-4


def sea(peak_hz: float = 0.256, variance: float = 0.03) -> Array:
    """JONSWAP-like density with a steeper tail than the open sea's, of a given variance [m^2]."""
    x = FREQUENCY / peak_hz
    density = x**-7.0 * np.exp(-1.75 * (x**-4.0 - 1.0))
    return np.asarray(density * variance / np.trapezoid(density, FREQUENCY), np.float64)


@pytest.mark.parametrize("blocks", [1, 2])
def test_block_follows_the_spectrum(blocks: int) -> None:
    block = heave.fit_band_pass(FREQUENCY, sea(), NOISE, blocks=blocks)
    assert block.size == (6 if blocks == 1 else 8)
    assert block.sd_m == pytest.approx(np.sqrt(0.03), rel=0.02)
    assert block.divergence < 0.05
    apart = np.trapezoid(np.abs(block.density(FREQUENCY) - sea()), FREQUENCY)
    assert apart < 0.25 * 0.03


@pytest.mark.parametrize("blocks", [1, 2])
def test_forms_of_a_block_agree(blocks: int) -> None:
    block = heave.fit_band_pass(FREQUENCY, sea(), NOISE, blocks=blocks)
    residual = block.f @ block.stationary + block.stationary @ block.f.T + block.l @ block.l.T
    assert np.abs(residual).max() < 1e-9
    phi, noise = block.discrete(0.2)
    assert phi @ block.stationary @ phi.T + noise == pytest.approx(block.stationary, abs=1e-12)
    assert np.linalg.eigvalsh(noise).min() > -1e-15
    two, noise_two = block.discrete(0.1)
    assert two @ two == pytest.approx(phi, abs=1e-10)
    assert two @ noise_two @ two.T + noise_two == pytest.approx(noise, abs=1e-12)
    fine = np.linspace(1e-4, 6.0, 40000)
    assert np.trapezoid(block.density(fine), fine) == pytest.approx(block.sd_m**2, rel=1e-3)
    lag = np.array([0.0, 0.7, 3.0])
    by_spectrum = [np.trapezoid(block.density(fine) * np.cos(2 * np.pi * fine * t), fine) for t in lag]
    assert block.autocovariance(lag) == pytest.approx(by_spectrum, abs=1e-4)


def test_gain_is_zero_at_rest_and_rate_is_the_derivative() -> None:
    block = heave.fit_band_pass(FREQUENCY, sea(), NOISE)
    at_rest = block.heave_row @ np.linalg.solve(block.f, block.l)
    assert np.abs(at_rest).max() < 1e-9
    assert np.abs(block.heave_row @ block.l).max() == 0.0
    assert block.rate_row == pytest.approx(block.heave_row @ block.f)
    assert np.all(np.linalg.eigvals(block.f).real < 0)


def test_parameters_describe_the_density() -> None:
    block = heave.fit_band_pass(FREQUENCY, sea(), NOISE)
    gain, omega, zeta = block.parameters[0], block.parameters[1:4], block.parameters[4:7]
    s = 2j * np.pi * FREQUENCY[:, None]
    response = gain * np.prod(s / (s**2 + 2 * zeta * omega * s + omega**2), axis=1)
    assert block.density(FREQUENCY) == pytest.approx(2 * np.abs(response) ** 2, rel=1e-9)


def test_swell_and_wind_sea_together() -> None:
    both = sea(0.3, 0.02) + sea(0.1, 0.01)
    block = heave.fit_band_pass(FREQUENCY, both, NOISE, blocks=2)
    assert block.sd_m**2 == pytest.approx(0.03, rel=0.1)
    assert block.density(np.array([0.1]))[0] == pytest.approx(np.interp(0.1, FREQUENCY, both), rel=0.5)


def test_search_goes_on_from_a_previous_block() -> None:
    first = heave.fit_band_pass(FREQUENCY, sea(), NOISE)
    again = heave.fit_band_pass(FREQUENCY, sea(), NOISE, previous=first)
    assert again.divergence <= first.divergence + 1e-9
    other = heave.fit_band_pass(FREQUENCY, sea(0.2, 0.05), NOISE, previous=first)
    assert other.sd_m**2 == pytest.approx(0.05, rel=0.05)
    mixed = heave.fit_band_pass(FREQUENCY, sea(), NOISE, blocks=2, previous=first)
    assert mixed.size == 8


def test_block_of_a_learned_spectrum() -> None:
    rng = np.random.default_rng(0)
    t = np.arange(0.0, 60.0, 0.06)
    value = 0.3 * np.sin(2 * np.pi * t / 4.0) + 0.2 * np.sin(2 * np.pi * t / 5.1 + 1.0)
    model = heave.fit(t, value + rng.normal(0, 0.03, len(t)), 0.03)
    block = model.band_pass()
    assert block.sd_m == pytest.approx(model.sd_m, rel=0.1)
    assert model.band_pass(blocks=2, previous=block).size == 8
    peak_hz = FREQUENCY[int(np.argmax(block.density(FREQUENCY)))]
    assert 1 / 5.3 < peak_hz < 1 / 3.8
    with pytest.raises(ValueError, match="no spectral density"):
        heave.fit(t, value, 0.03, method="sinusoids").band_pass()


@pytest.mark.parametrize(
    ("density", "noise", "blocks", "named"),
    [
        (sea()[:-1], NOISE, 1, "density_m2ps: must have the shape"),
        (-sea(), NOISE, 1, "density_m2ps: must be finite"),
        (0.0 * sea(), NOISE, 1, "somewhere positive"),
        (sea() * np.nan, NOISE, 1, "density_m2ps: must be finite"),
        (sea(), 0.0, 1, "noise_density_m2ps"),
        (sea(), NOISE, 3, "blocks"),
    ],
)
def test_unusable_arguments_are_named(density: Array, noise: float, blocks: int, named: str) -> None:
    with pytest.raises(ValueError, match=named):
        heave.fit_band_pass(FREQUENCY, density, noise, blocks=blocks)
