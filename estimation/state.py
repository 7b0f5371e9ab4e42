"""The state: its blocks, their places in the vectors, and the laws of adding an error to it.

The *nominal* state ``x`` always holds every block, the attitude as a quaternion (body to NED). The *error* state
is what the filter estimates; it holds only the blocks that are switched on, the attitude as a rotation vector in
the body frame: ``q = q_nominal * exp(error)`` (Sola's local perturbation). ``offsets[block]`` is the block's first
place in the error state, or -1 where it is off.

Laws: ``minus(plus(x, d), x) == d`` and ``plus(x, minus(y, x)) == y`` for the blocks that are on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.config import Config
from estimation.frames import Array, quat_conjugate, quat_exp, quat_log, quat_multiply, quat_normalise

Offsets = NDArray[np.int64]

(
    POSITION,
    VELOCITY,
    ATTITUDE,
    GYRO_BIAS,
    ACCEL_BIAS,
    GPS_BIAS,
    BARO_BIAS,
    PLATFORM_OFFSET,
    PLATFORM_DRIFT,
    PLATFORM_SWAY,
    PLATFORM_LEVEL,
    PLATFORM_HEAVE,
    RANGE_SCALE,
    CAMERA_LATENCY,
    CAMERA_MOUNT,
) = range(15)

BLOCKS: tuple[tuple[str, tuple[str, ...], str], ...] = (
    ("position", ("n", "e", "d"), "m"),
    ("velocity", ("n", "e", "d"), "m/s"),
    ("attitude", ("x", "y", "z"), "rad"),
    ("gyro_bias", ("x", "y", "z"), "rad/s"),
    ("accel_bias", ("x", "y", "z"), "m/s^2"),
    ("gps_bias", ("n", "e", "d"), "m"),
    ("baro_bias", ("h",), "m"),
    ("platform_offset", ("n", "e"), "m"),
    ("platform_drift", ("n", "e"), "m/s"),
    (
        "platform_sway",
        (
            *("n1", "n1_rate", "n2", "n2_rate", "n3", "n3_rate"),
            *("e1", "e1_rate", "e2", "e2_rate", "e3", "e3_rate"),
        ),
        "m",
    ),
    ("platform_level", ("h",), "m"),
    ("platform_heave", ("1", "1_rate", "2", "2_rate", "3", "3_rate"), "m"),
    ("range_scale", ("s",), "-"),
    ("camera_latency", ("t",), "s"),
    ("camera_mount", ("x", "y", "z"), "rad"),
)
"""Name, components and unit of each block, in the order of the constants above."""

SIZES: tuple[int, ...] = tuple(len(components) for _, components, _ in BLOCKS)
NOMINAL: tuple[int, ...] = tuple(sum(SIZES[:b]) + (1 if b > ATTITUDE else 0) for b in range(len(SIZES)))
"""First place of each block in the nominal state."""
NOMINAL_SIZE = sum(SIZES) + 1

P0, V0, Q0, BG0, BA0, BP0, BB0 = (NOMINAL[b] for b in range(7))
"""First places in the nominal state of position, velocity, attitude, biases of gyro, accelerometer, GPS, baro."""
PO0, PD0, PS0, PL0, PH0, RS0, CL0, CM0 = (NOMINAL[b] for b in range(7, 15))
"""First places of the platform's offset, drift, sway, level and heave, of range scale, camera latency and mount."""
DECK_BLOCKS = (
    PLATFORM_OFFSET,
    PLATFORM_DRIFT,
    PLATFORM_SWAY,
    PLATFORM_LEVEL,
    PLATFORM_HEAVE,
    RANGE_SCALE,
    CAMERA_LATENCY,
    CAMERA_MOUNT,
)
"""The blocks that vision needs; they are switched on together."""


@dataclass(frozen=True, slots=True)
class Layout:
    """Which blocks are on, and where they are in the error state of ``size`` entries."""

    offsets: Offsets
    size: int

    @classmethod
    def of(cls, config: Config) -> Layout:
        """Return the layout that a configuration asks for."""
        on = [POSITION, VELOCITY, ATTITUDE, GYRO_BIAS, ACCEL_BIAS]
        if config.gps.bias:
            on.append(GPS_BIAS)
        if config.barometer.use:
            on.append(BARO_BIAS)
        if config.platform.use is True:
            on.extend(DECK_BLOCKS)
        return cls.with_blocks(on)

    @classmethod
    def with_blocks(cls, blocks: list[int]) -> Layout:
        """Return the layout in which exactly these blocks are on; the first five always are."""
        offsets = np.full(len(SIZES), -1, dtype=np.int64)
        size = 0
        for block in sorted({*range(GPS_BIAS), *blocks}):
            offsets[block] = size
            size += SIZES[block]
        return cls(offsets, size)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the error state's entries, such as ``gyro_bias.x``."""
        return tuple(
            f"{BLOCKS[b][0]}.{c}" for b in range(len(SIZES)) if self.offsets[b] >= 0 for c in BLOCKS[b][1]
        )

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the error state's entries; rates of a chain's sections carry ``/s``."""
        return tuple(
            BLOCKS[b][2] + ("/s" if c.endswith("_rate") else "")
            for b in range(len(SIZES))
            if self.offsets[b] >= 0
            for c in BLOCKS[b][1]
        )


def nominal_zero() -> Array:
    """Return a nominal state at rest at the origin, level and heading north."""
    x = np.zeros(NOMINAL_SIZE)
    x[Q0] = 1.0
    return x


def plus(x: Array, error: Array, offsets: Offsets) -> Array:
    """Return the nominal state ``x`` with an error state added."""
    y = x.copy()
    for block in range(len(SIZES)):
        start = offsets[block]
        if start < 0:
            continue
        if block == ATTITUDE:
            dq = quat_exp(error[start : start + 3])
            y[Q0 : Q0 + 4] = quat_normalise(quat_multiply(x[Q0 : Q0 + 4], dq))
        else:
            for i in range(SIZES[block]):
                y[NOMINAL[block] + i] += error[start + i]
    return y


def minus(y: Array, x: Array, offsets: Offsets, size: int) -> Array:
    """Return the error state that takes ``x`` to ``y``."""
    error = np.zeros(size)
    for block in range(len(SIZES)):
        start = offsets[block]
        if start < 0:
            continue
        if block == ATTITUDE:
            dq = quat_multiply(quat_conjugate(x[Q0 : Q0 + 4]), y[Q0 : Q0 + 4])
            error[start : start + 3] = quat_log(dq)
        else:
            for i in range(SIZES[block]):
                error[start + i] = y[NOMINAL[block] + i] - x[NOMINAL[block] + i]
    return error
