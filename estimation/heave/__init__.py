"""Heave of the deck: learn its spectrum, report it as a sum of sinusoids, forecast it with honest variance.

from estimation import heave
model = heave.fit(t_s, heave_m, sigma_m)
mean_m, variance_m2 = model.forecast([0.5, 1.0, 2.0])
"""

from estimation.heave.bandpass import BandPass, fit_band_pass
from estimation.heave.forecast import Forecast
from estimation.heave.model import Component, HeaveModel, fit
from estimation.heave.spectrum import SpectrumSettings

__all__ = [
    "BandPass",
    "Component",
    "Forecast",
    "HeaveModel",
    "SpectrumSettings",
    "fit",
    "fit_band_pass",
]
