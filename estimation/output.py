"""What the estimator gives out, and what its source may tell it beforehand."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from estimation.clockbank import ClockSummary
from estimation.config import Config
from estimation.frames import Array
from estimation.heave.model import HeaveModel
from estimation.outcome import Outcome
from estimation.rows import Estimates, Int
from estimation.state import BA0, BG0, P0, Q0, V0

RECORD_DTYPE = np.dtype(
    [
        ("t_ns", np.int64),
        ("stamp_ns", np.int64),
        ("arrival_ns", np.int64),
        ("sensor", np.int16),
        ("outcome", np.int16),
        ("dof", np.int16),
        ("nis", np.float64),
        ("innovation", np.float64, (3,)),
        ("sigma", np.float64, (3,)),
        ("log_det", np.float64),
        ("age_s", np.float64),
    ]
)
"""One fusion attempt: time of the content on the estimator's clock, the event's own stamp and arrival, the sensor's
index, ``Outcome``, degrees of freedom, NIS, innovation with its predicted 1-sigma and the logarithm of its
covariance's determinant (NaN where there was no comparison), and the age at arrival."""


@dataclass(frozen=True, slots=True)
class Facts:
    """What the source of the events knows beforehand, used where the configuration leaves it open.

    ``imu_latency_s`` is the age of an inertial sample at its stamp (filter delay); ``declination_rad`` is east
    positive; ``vision_by_arrival`` says that vision fixes have no stamps of their own but those of their arrival,
    ``vision`` that there are, or will be, vision fixes at all.
    """

    imu_latency_s: float = 0.0
    declination_rad: float | None = None
    vision_by_arrival: bool = False
    vision: bool = False


def with_facts(config: Config, facts: Facts) -> Config:
    """Return the configuration as it applies: the platform's states are on or off, and fixes that are stamped with
    their arrival have the age of that.
    """
    config = with_platform(config, facts.vision)
    if not facts.vision_by_arrival:
        return config
    v = config.vision
    age = {"latency_s": v.arrival_latency_s, "latency_sigma_s": v.arrival_latency_sigma_s}
    return replace(config, vision=replace(v, **age))


def with_platform(config: Config, vision: bool) -> Config:
    """Return the configuration with the platform's ``use``, where it is ``auto``, as there are vision fixes or not."""
    if config.platform.use != "auto":
        return config
    return replace(config, platform=replace(config.platform, use=vision))


@dataclass(frozen=True, slots=True)
class Estimate:
    """The vehicle at ``t_ns`` of the inertial clock.

    ``position_m`` and ``velocity_mps`` are NED from the origin, ``quaternion`` takes body to NED, ``covariance``
    (9, 9) is of position, velocity and attitude error (rotation vector in the body frame). ``sigma`` has the
    1-sigma of every entry of the error state, ``nominal`` the whole state (``estimation.state``). ``deck`` (8,) and
    ``deck_covariance`` (8, 8) are what ``estimation.deck.deck_output`` gives, empty where the platform is off.
    """

    t_ns: int
    position_m: Array
    velocity_mps: Array
    quaternion: Array
    covariance: Array
    nominal: Array
    sigma: Array
    deck: Array
    deck_covariance: Array


@dataclass(slots=True)
class Output:
    """What one event led to: an estimate (after an inertial sample), records that became final, notes."""

    estimate: Estimate | None
    records: NDArray[np.void]
    notes: list[tuple[int, str]]


@dataclass(slots=True)
class Run:
    """What a batch led to, as columns of n estimates.

    ``t_ns`` inertial clock; ``position_m``, ``velocity_mps`` (n, 3) NED; ``quaternion`` (n, 4) body to NED;
    ``covariance`` (n, 9, 9) of position, velocity and attitude error (body frame); ``gyro_bias``, ``accel_bias``
    (n, 3); ``deck`` (n, 8) what ``estimation.deck.deck_output`` gives with ``deck_covariance`` (n, 8, 8), of no columns
    where the platform is off; ``heave`` the heave models, each with the time of its last fix;
    ``clocks`` every other clock against the inertial one; ``nominal`` (n, NOMINAL_SIZE) and ``sigma`` (n, k) with
    ``state_names`` and ``state_units``. ``records`` has
    ``RECORD_DTYPE``; ``sensors`` are the names that its indices mean; ``notes`` are (t_ns, sentence).
    ``imu_outcomes`` counts the inertial samples. ``origin`` is latitude [rad], longitude [rad], altitude [m], or
    None where the filter never started; ``missing`` says then what it waited for.
    """

    engine: str
    t_ns: Int
    position_m: Array
    velocity_mps: Array
    quaternion: Array
    covariance: Array
    gyro_bias: Array
    accel_bias: Array
    nominal: Array
    sigma: Array
    state_names: tuple[str, ...]
    state_units: tuple[str, ...]
    deck: Array
    deck_covariance: Array
    heave: list[tuple[int, HeaveModel]]
    clocks: list[ClockSummary]
    records: NDArray[np.void]
    sensors: tuple[str, ...]
    notes: list[tuple[int, str]]
    imu_outcomes: dict[Outcome, int]
    origin: tuple[float, float, float] | None
    declination_rad: float | None
    missing: str


def estimate_at(e: Estimates, i: int) -> Estimate:
    """Return one row of the columns as an estimate."""
    x = e.x[i]
    return Estimate(
        int(e.t_ns[i]),
        x[P0 : P0 + 3],
        x[V0 : V0 + 3],
        x[Q0 : Q0 + 4],
        e.covariance[i],
        x,
        e.sigma[i],
        e.deck[i],
        e.deck_covariance[i],
    )


def columns_of(e: Estimates) -> dict[str, Any]:
    """Return the columns of a ``Run`` that are estimates."""
    x = e.x
    return {
        "t_ns": e.t_ns,
        "position_m": x[:, P0 : P0 + 3],
        "velocity_mps": x[:, V0 : V0 + 3],
        "quaternion": x[:, Q0 : Q0 + 4],
        "covariance": e.covariance,
        "gyro_bias": x[:, BG0 : BG0 + 3],
        "accel_bias": x[:, BA0 : BA0 + 3],
        "nominal": x,
        "sigma": e.sigma,
        "deck": e.deck,
        "deck_covariance": e.deck_covariance,
    }
