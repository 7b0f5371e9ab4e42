"""The platform's models against finite differences and against what they mean."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.linalg import expm

from estimation.band import (
    BAND_PARAMETERS,
    band_derivatives,
    band_matrix,
    band_moments,
    band_states,
    band_stationary,
    discrete_band,
)
from estimation.config import parse_config
from estimation.deck import (
    CHAINS,
    HEAVE,
    any_sea,
    change_motion,
    deck_output,
    deck_transition,
    has_form,
    kept_step,
    no_steps,
    places,
    seen_place,
    vision,
)
from estimation.frames import R_CB_NOMINAL, euler_to_quat, quat_to_matrix
from estimation.parameters import Site, pack_parameters
from estimation.state import (
    CL0,
    CM0,
    P0,
    PH0,
    PL0,
    PLATFORM_HEAVE,
    PO0,
    PS0,
    Q0,
    RS0,
    V0,
    Layout,
    nominal_zero,
    plus,
)  # fmt: skip

CONFIG = parse_config(
    "[platform]\nuse = true\n[vision]\nlever_arm_m = [0.1, -0.05, 0.2]\nmount_rpy_rad = [0.02, -0.03, 0.1]\n"
)
LAYOUT = Layout.of(CONFIG)
P = pack_parameters(CONFIG, Site((0.9, 0.1, 50.0), 0.0))
MOTION = np.array(
    [
        *(0.5, 1.0, 1.3, 1.7, 0.3, 0.2, 0.4),
        *(0.2, 0.8, 1.1, 1.4, 0.2, 0.3, 0.6),
        *(0.3, 0.6, 1.2, 2.4, 0.1, 0.4, 0.5),
        0.05,
    ]
)
GYRO = np.array([0.2, -0.3, 0.1])
Array = NDArray[np.float64]


def some_state(seed: int = 1) -> Array:
    rng = np.random.default_rng(seed)
    x = nominal_zero()
    x[P0 : P0 + 3] = [3.0, -2.0, -12.0]
    x[V0 : V0 + 3] = rng.normal(size=3)
    x[Q0 : Q0 + 4] = euler_to_quat(0.2, -0.15, 1.1)
    x[PO0 : PO0 + 2] = [4.0, -3.0]
    x[PS0 : PS0 + 12] = rng.normal(size=12) * 0.1
    x[PL0] = 0.3
    x[PH0 : PH0 + 6] = rng.normal(size=6) * 0.3
    x[RS0], x[CL0] = 0.01, 0.02
    x[CM0 : CM0 + 3] = [0.01, -0.02, 0.015]
    return x


def innovation(x: Array, value: Array) -> tuple[Array, Array, Array]:
    r, H, R = np.zeros(3), np.zeros((3, LAYOUT.size)), np.zeros((3, 3))
    assert vision(value, np.full(6, math.nan), x, GYRO, P, LAYOUT.offsets, r, H, R) == 3
    return r, H, R


def test_the_fix_of_a_level_camera_over_the_deck_is_what_geometry_says() -> None:
    config = parse_config("[platform]\nuse = true\n")
    p = pack_parameters(config, Site((0.9, 0.1, 50.0), 0.0))
    x = nominal_zero()
    x[P0 : P0 + 3] = [0.0, 0.0, -10.0]
    x[PO0 : PO0 + 2] = [1.0, 2.0]
    x[PL0] = 0.5
    r, H, R = np.zeros(3), np.zeros((3, LAYOUT.size)), np.zeros((3, 3))
    # Camera axes: X right (east), Y backwards (south), Z down.
    vision(np.array([2.0, -1.0, 9.5]), np.full(6, math.nan), x, np.zeros(3), p, LAYOUT.offsets, r, H, R)
    assert r == pytest.approx(np.zeros(3), abs=1e-12)


def test_the_jacobian_of_a_fix_is_its_derivative() -> None:
    x, value, step = some_state(), np.array([1.0, 2.0, 11.0]), 1e-6
    x[CL0] = 0.0
    _, H, _ = innovation(x, value)
    numeric = np.zeros_like(H)
    for k in range(LAYOUT.size):
        d = np.zeros(LAYOUT.size)
        d[k] = step
        forward, backward = (
            innovation(plus(x, d, LAYOUT.offsets), value)[0],
            innovation(plus(x, -d, LAYOUT.offsets), value)[0],
        )
        numeric[:, k] = -(forward - backward) / (2.0 * step)
    # The mount's column is taken at the nominal mount: exact to first order in that mount.
    mount = slice(LAYOUT.size - 3, LAYOUT.size)
    assert H[:, mount] == pytest.approx(numeric[:, mount], abs=0.6)
    rest = slice(0, LAYOUT.size - 3)
    assert H[:, rest] == pytest.approx(numeric[:, rest], abs=1e-6)


@pytest.mark.parametrize("chain", CHAINS)
def test_the_transition_is_the_exponential_of_the_chain(chain: int) -> None:
    x, y, dt = some_state(), some_state(), 0.02
    F, Q = np.eye(LAYOUT.size), np.zeros((LAYOUT.size, LAYOUT.size))
    deck_transition(x, y, dt, P, MOTION, *no_steps(), LAYOUT.offsets, F, Q)
    at, start = places(chain, LAYOUT.offsets)
    block, band = slice(start, start + 6), MOTION[chain : chain + 7]
    f, drive = band_matrix(band), np.zeros((6, 1))
    drive[1] = band[0]
    exact = expm(f * dt)
    assert F[block, block] == pytest.approx(exact, abs=1e-6)
    assert y[at : at + 6] == pytest.approx(exact @ x[at : at + 6], abs=1e-6)
    big = np.block([[-f, drive @ drive.T], [np.zeros((6, 6)), f.T]])
    turned = expm(big * dt)
    noise = turned[6:, 6:].T @ turned[:6, 6:]
    assert Q[block, block] == pytest.approx(noise, rel=1e-2, abs=1e-8)
    assert np.linalg.eigvalsh(Q).min() > -1e-15
    stationary = band_stationary(band)
    after = F[block, block] @ stationary @ F[block, block].T + Q[block, block]
    assert after == pytest.approx(stationary, abs=1e-4 * stationary.max())


def test_what_is_reported_is_the_difference_and_its_jacobian() -> None:
    x, step = some_state(), 1e-6
    y, A = deck_output(x, MOTION, LAYOUT.offsets, LAYOUT.size)
    height = x[PL0] + x[PH0 + 5]
    assert y[6] == pytest.approx(height)
    assert y[2] == pytest.approx(x[P0 + 2] + height)
    assert y[7] == pytest.approx(band_matrix(MOTION[:7])[5] @ x[PH0 : PH0 + 6])
    for k in range(LAYOUT.size):
        d = np.zeros(LAYOUT.size)
        d[k] = step
        change = deck_output(plus(x, d, LAYOUT.offsets), MOTION, LAYOUT.offsets, LAYOUT.size)[0] - y
        assert change / step == pytest.approx(A[:, k], abs=1e-6)


def test_a_fix_that_is_too_short_shows_a_higher_deck_and_one_aside_another_place() -> None:
    x = nominal_zero()
    x[P0 + 2] = -10.0
    p = pack_parameters(parse_config("[platform]\nuse = true\n"), Site((0.9, 0.1, 50.0), 0.0))
    seen = np.zeros(6)
    # Camera axes of a level camera: X east, Y south, Z down.
    seen_place(np.array([0.4, -0.1, -0.2]), np.diag([0.1, 0.2, 0.3]), x, p, seen)
    assert seen == pytest.approx([0.2, 0.3, 0.1, 0.2, 0.4, 0.1])
    assert quat_to_matrix(x[Q0 : Q0 + 4]) @ R_CB_NOMINAL.T @ np.array([0, 0, 1.0]) == pytest.approx(
        [0, 0, 1.0]
    )


def band(rng: np.random.Generator) -> Array:
    """Return the parameters of some chain (7,): sections of 1 to 14 s and of every damping."""
    return np.array(
        [rng.uniform(0.05, 2.0), *rng.uniform(0.44, 6.0, 3), *np.exp(rng.uniform(np.log(0.02), 0.7, 3))]
    )


def moving(chain: int, one: Array) -> Array:
    """Return a platform's motion with these parameters of one chain."""
    out = MOTION.copy()
    out[chain : chain + 7] = one
    return out


def shown(heave: Array) -> Array:
    """Return the rows (3, 6) that take the chain's states to heave, rate and acceleration."""
    f, unit = band_matrix(heave), np.eye(6)[5]
    return np.stack([unit, unit @ f, unit @ f @ f])


@given(st.integers(0, 2**32 - 1))
def test_the_heaves_derivatives_are_another_form_of_its_states(seed: int) -> None:
    rng = np.random.default_rng(seed)
    heave, x = band(rng), rng.normal(size=6)
    z = band_derivatives(x, heave)
    assert band_states(z, heave) == pytest.approx(x, abs=1e-9)
    assert shown(heave) @ x == pytest.approx(z[3:], rel=1e-9, abs=1e-9)
    to = np.column_stack([band_derivatives(unit, heave) for unit in np.eye(6)])
    assert np.diag(to @ band_stationary(heave) @ to.T) == pytest.approx(band_moments(heave), rel=1e-6)


@given(st.integers(0, 2**32 - 1), st.sampled_from(CHAINS))
def test_a_new_model_leaves_displacement_rate_and_acceleration_what_they_are(seed: int, chain: int) -> None:
    """With all that is known of them, of anything else, and of the two together; and P stays a covariance."""
    rng = np.random.default_rng(seed)
    old, new = band(rng), band(rng)
    n, (at, start) = LAYOUT.size, places(chain, LAYOUT.offsets)
    block, x = slice(start, start + 6), nominal_zero()
    x[at : at + 6] = rng.normal(size=6)
    A = rng.normal(size=(n, n))
    P, before = A @ A.T, x.copy()
    was, motion = P.copy(), moving(chain, old)
    trail = np.eye(n)
    change_motion(x, P, motion, chain, new, LAYOUT.offsets, trail)
    assert np.array_equal(motion, moving(chain, new))
    assert trail @ was @ trail.T == pytest.approx(P, rel=1e-6, abs=1e-6 * np.abs(P).max())
    assert shown(new) @ x[at : at + 6] == pytest.approx(shown(old) @ before[at : at + 6], rel=1e-9, abs=1e-8)
    rest = np.vstack([np.delete(np.eye(n), block, axis=0), np.zeros((3, n))])
    C, D = rest.copy(), rest.copy()
    C[-3:, block], D[-3:, block] = shown(old), shown(new)
    kept = C @ was @ C.T
    assert pytest.approx(kept, rel=1e-6, abs=1e-6 * np.abs(kept).max()) == D @ P @ D.T
    assert np.linalg.eigvalsh(P)[0] > -1e-12 * np.trace(P)
    assert np.array_equal(np.delete(x, range(at, at + 6)), np.delete(before, range(at, at + 6)))


@given(st.integers(0, 2**32 - 1))
def test_the_same_model_taken_up_again_changes_nothing(seed: int) -> None:
    rng = np.random.default_rng(seed)
    one, x = band(rng), nominal_zero()
    x[PH0 : PH0 + 6] = rng.normal(size=6)
    A = rng.normal(size=(LAYOUT.size, LAYOUT.size))
    P, before = A @ A.T, x.copy()
    was = P.copy()
    change_motion(x, P, moving(HEAVE, one), HEAVE, one, LAYOUT.offsets, np.empty((0, 0)))
    assert x == pytest.approx(before, abs=1e-9)
    assert pytest.approx(was, abs=1e-8) == P


@given(st.integers(0, 2**32 - 1))
def test_a_sea_of_which_only_the_heave_is_known_becomes_the_new_one(seed: int) -> None:
    """What the old sea leaves open of the integrals, once the heave is known, the new one leaves open too."""
    rng = np.random.default_rng(seed)
    old, new = band(rng), band(rng)
    P, x, start = np.zeros((LAYOUT.size, LAYOUT.size)), nominal_zero(), LAYOUT.offsets[PLATFORM_HEAVE]
    block = slice(start, start + 6)
    P[block, block] = band_stationary(old)
    change_motion(x, P, moving(HEAVE, old), HEAVE, new, LAYOUT.offsets, np.empty((0, 0)))
    S, C = band_stationary(new), shown(new)
    G = S @ C.T @ np.linalg.inv(C @ S @ C.T)
    y = shown(old) @ band_stationary(old) @ shown(old).T
    wanted = G @ y @ G.T + S - G @ C @ S
    assert P[block, block] == pytest.approx(wanted, rel=1e-3, abs=1e-5 * np.abs(wanted).max())


def test_a_step_that_is_remembered_is_that_of_its_length_and_motion() -> None:
    """Lengths that share a place, and motions that come and go, never hear of one another."""
    keys, kept = no_steps()
    calmer = MOTION * np.where(np.arange(len(MOTION)) == CHAINS[1], 0.5, 1.0)
    lengths = [0.005, 0.005 + len(keys) * 1e-9, 0.0025, 0.005]
    for motion in (MOTION, calmer, MOTION):
        for dt in lengths:
            k = kept_step(dt, motion, keys, kept)
            assert kept_step(dt, motion, keys, kept) == k
            for c, chain in enumerate(CHAINS):
                transition, noise = discrete_band(motion[chain : chain + BAND_PARAMETERS], dt)
                assert np.array_equal(kept[k, 0, c], transition)
                assert np.array_equal(kept[k, 1, c], noise)
    assert np.count_nonzero(keys[:, 0]) == 2


def test_a_chain_has_a_form_unless_it_is_that_of_any_sea() -> None:
    broad = any_sea(0.2, 1.7, 0.3)
    assert not has_form(broad)
    assert not has_form(any_sea(0.02, 4.9, 0.1))
    for k in range(1, 7):
        own = broad.copy()
        own[k] *= 1.01
        assert has_form(own)
