"""Watching whether the deck still moves as was learned.

A learned heave that is too small or too regular holds the estimate back when the deck begins to move otherwise. Each
innovation alone hardly shows that where fixes are noisy, but they then keep their sign for as long as the deck is away.
Their mean over a fraction of a second is compared with what white innovations would leave; beyond that the learned
motion is let go, for what is known of any sea, until it has been learned anew.

Plain functions of arrays that numba compiles as they stand.
"""

from __future__ import annotations

import math

import numpy as np

from estimation import parameters as par
from estimation.band import BAND_PARAMETERS, BAND_SIZE, band_moments, band_states
from estimation.deck import HEAVE, camera_to_ned, change_motion
from estimation.frames import Array
from estimation.state import PLATFORM_HEAVE, Offsets

WATCH_S = 0.7
"""Time over which innovations are averaged [s]; short against the waves' period."""
FORGET_S = 1.0
"""After so long without a fix the mean begins anew [s]."""
LIKELY = 3.0
"""An innovation counts for no more than this many sigma: one wild fix is no motion."""
UNEXPLAINED_SIGMA = 4.5
"""White innovations leave a mean beyond this many sigma less than once in some hours."""
UNEXPLAINED_SHARE = 0.5
"""Nor is a mean below this share of the learned heave's own 1-sigma a reason to let it go: it is a small misfit."""
LET_GO = 2
"""Mark of a fix after which the learned heave was let go (``Rows.reset``)."""


def unexplained(
    memory: Array, t_s: float, r: Array, S: Array, weight: float, x: Array, p: Array, motion: Array
) -> bool:
    """Take a fix's innovation r (3,) with its covariance S (3, 3); return whether the learned heave is to be let go.

    ``memory`` is the camera's own: of it the last three entries hold the time [s], the mean of the innovations' upward
    part in units of its sigma, and the variance that it would have if they were white. A fix outside the gate
    (``weight`` 0) says nothing.
    """
    if weight == 0.0:
        return False
    row = camera_to_ned(x, p)[2]
    up = 0.0
    variance = 0.0
    for i in range(3):
        up -= row[i] * r[i]
        for j in range(3):
            variance += row[i] * S[i, j] * row[j]
    sigma = math.sqrt(variance)
    dt = t_s - memory[6]
    if not 0.0 <= dt < FORGET_S:
        memory[7] = 0.0
        memory[8] = 0.0
        dt = 0.05
    memory[6] = t_s
    share = 1.0 - math.exp(-dt / WATCH_S)
    memory[7] += share * (min(max(up / sigma, -LIKELY), LIKELY) - memory[7])
    memory[8] = (1.0 - share) ** 2 * memory[8] + share**2
    mean = abs(memory[7])
    if mean <= UNEXPLAINED_SIGMA * math.sqrt(memory[8]):
        return False
    any_sea = True
    for k in range(BAND_PARAMETERS):
        any_sea = any_sea and motion[k] == p[par.PRIOR_HEAVE + k]
    return not any_sea and mean * sigma > UNEXPLAINED_SHARE * math.sqrt(
        band_moments(motion[:BAND_PARAMETERS])[3]
    )


def let_go(
    t_s: float, x: Array, P: Array, memory: Array, scatter: Array, motion: Array, p: Array, offsets: Offsets,
    chain: Array,
) -> None:  # fmt: skip
    """Go back to the heave of any sea, in place, and open the heave's states as far as that sea goes.

    Heave, rate and acceleration keep their values, their doubt grows by that sea's. ``chain`` is as in
    ``change_motion``; ``scatter`` keeps the time, before which nothing that was learned is taken up any more.
    """
    new = p[par.PRIOR_HEAVE : par.PRIOR_HEAVE + BAND_PARAMETERS]
    change_motion(x, P, motion, HEAVE, new, offsets, chain)
    m = band_moments(new)
    start = offsets[PLATFORM_HEAVE]
    T = np.empty((BAND_SIZE, BAND_SIZE))
    for c in range(BAND_SIZE):
        unit = np.zeros(BAND_SIZE)
        unit[c] = 1.0
        T[:, c] = band_states(unit, new)
    # E[z_i z_j] of z and its derivatives: (-1)^((i - j) / 2) m_((i + j) / 2) for even i + j, else 0.
    for i in range(BAND_SIZE):
        for j in range(i + 1):
            spread = 0.0
            for a in range(BAND_SIZE):
                for b in range(a % 2, BAND_SIZE, 2):
                    sign = 1.0 if (a - b) % 4 == 0 else -1.0
                    spread += T[i, a] * sign * m[(a + b) // 2] * T[j, b]
            P[start + i, start + j] += spread
            if j < i:
                P[start + j, start + i] += spread
    memory[7] = 0.0
    memory[8] = 0.0
    scatter[3] = t_s
