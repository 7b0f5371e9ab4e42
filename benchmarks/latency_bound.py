"""How well the camera's age can be known at best in a simulated flight: the Cramer-Rao bound.

A fix that is older than thought is off by s(t) times the difference, with s the rotation's and the vehicle's own part
of the target's velocity in the picture, levelled. The deck's own motion has no part in it: a deck that moves a little
later is as probable as this one. Against s stand, as one-sided spectral densities: the fixes' noise, the deck's motion,
whose spectrum is taken as known, and what inertial sensors leave open of the vehicle's place. With one-sided densities
the information of T seconds is 2 T int S_s / S_n df, per axis; the prior adds its own. The camera's mount is taken as
known: circling with an angular frequency w a camera turned about its axis by e looks e / w late.
"""

from __future__ import annotations

import numpy as np
from scipy.signal import periodogram, welch

from estimation.events import COMPANION, Kind
from simulation.flight import SimulatedFlight

RATE_HZ, GRAVITY_MPS2 = 30.0, 9.81
LOWEST_HZ = 0.03
SEA_S, SEGMENT_S = 3000.0, 60.0


def latency_bound_s(flight: SimulatedFlight) -> float:
    """Return the least 1-sigma [s] that an estimator without a bias can reach for the age of this flight's fixes."""
    config, rows = flight.scenario.config, flight.batch.rows
    stamps = rows["stamp_ns"][rows["kind"] == Kind.VISION]
    seen_s = np.sort(flight.scenario.clocks[COMPANION].true_s(stamps))
    t = np.arange(seen_s[0], seen_s[-1], 1.0 / RATE_HZ)
    duration_s = float(t[-1] - t[0])
    vehicle, platform = flight.trajectory.motion(t), flight.trajectory.platform
    away = platform.motion(t).position[0] - vehicle.position_m
    seen = np.einsum("nji,nj->ni", vehicle.R_nb, away)
    turning = np.cross(seen, vehicle.angular_velocity_radps)
    signal = np.einsum("nij,nj->ni", vehicle.R_nb, turning) - vehicle.velocity_mps
    distance = float(np.linalg.norm(away, axis=1).mean())
    variance = (config.vision.angle_sigma_rad * distance) ** 2 + config.vision.floor_m**2
    sea = platform.motion(np.arange(0.0, SEA_S, 1.0 / RATE_HZ)).position[0]
    information = config.vision.latency_sigma_s**-2
    for axis in range(2):
        f, moving = welch(sea[:, axis], RATE_HZ, nperseg=int(SEGMENT_S * RATE_HZ), detrend="linear")
        straight = np.polyval(np.polyfit(t, signal[:, axis], 1), t)
        g, power = periodogram(signal[:, axis] - straight, RATE_HZ, window="hann", detrend=False)
        keep = g > LOWEST_HZ
        g, power = g[keep], power[keep]
        omega = 2.0 * np.pi * g
        noise = 2.0 * variance * duration_s / len(seen_s) + np.interp(g, f, moving)
        noise += 2.0 * config.imu.accel_noise**2 / omega**4
        noise += 2.0 * (GRAVITY_MPS2 * config.imu.gyro_noise) ** 2 / omega**6
        information += 2.0 * duration_s * float(np.sum(power / noise)) * (g[1] - g[0])
    return float(information**-0.5)
