"""What the autopilot is told of the deck: laws of LANDING_TARGET, when it is sent, and guidance that lets go."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import ardupilotmega as m

from deckfix.guide import Guide, set_point
from deckfix.health import WORDS, Health, Problem
from deckfix.landing_target import AHEAD_S, Newest, landing_target, target_in_body, why_not
from deckfix.mavlink_link import GUIDED, LAND, Vehicle
from estimation.frames import euler_to_quat, quat_to_matrix
from estimation.landing_config import LandingConfig
from estimation.modes import Mode
from estimation.output import Estimate
from estimation.state import NOMINAL_SIZE

S = 1_000_000_000
C = LandingConfig()


def newest(
    relative: tuple[float, ...] = (1.0, 2.0, -8.0),
    velocity: tuple[float, ...] = (0.0, 0.0, 0.0),
    rpy: tuple[float, float, float] = (0.0, 0.0, 0.0),
    rate: tuple[float, float, float] = (0.0, 0.0, 0.0),
    seen_ns: int | None = 100 * S,
) -> Newest:
    deck = np.array([*relative, *velocity, 0.3, 0.0])
    e = Estimate(
        100 * S, np.array(relative), np.array(velocity), euler_to_quat(*rpy), 1e-4 * np.eye(9),
        np.zeros(NOMINAL_SIZE), np.zeros(40), deck, 1e-4 * np.eye(8),
    )  # fmt: skip
    return Newest(e, 500 * S, np.array(rate), seen_ns)


_metres = st.floats(-30.0, 30.0)


@given(_metres, _metres, st.floats(0.1, 40.0))
def test_angles_say_the_same_as_the_place(x: float, y: float, z: float) -> None:
    told = landing_target(m, np.array([x, y, z]), 1)
    assert told.distance == pytest.approx(math.hypot(x, y, z))
    direction = np.array([-math.tan(told.angle_y), math.tan(told.angle_x), 1.0])
    np.testing.assert_allclose(direction * z, [x, y, z], rtol=1e-9, atol=1e-9)
    assert (told.frame, told.position_valid) == (12, 1)


@given(st.tuples(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5), st.floats(-3.0, 3.0)), _metres, _metres)
def test_the_place_turned_back_is_where_the_deck_is(
    rpy: tuple[float, float, float], n: float, e: float
) -> None:
    told = newest((n, e, -9.0), rpy=rpy)
    back = quat_to_matrix(told.estimate.quaternion) @ target_in_body(told, 500 * S)
    np.testing.assert_allclose(back, [-n, -e, 9.0], atol=1e-9)


def test_between_fixes_the_estimate_is_carried_forward_but_not_far() -> None:
    told = newest(velocity=(1.0, 0.0, 0.5))
    np.testing.assert_allclose(target_in_body(told, 500 * S + S // 10), [-1.1, -2.0, 7.95])
    far = target_in_body(told, 600 * S)
    np.testing.assert_allclose(far, target_in_body(told, 500 * S + round(AHEAD_S * S)))


def test_a_turn_is_carried_forward() -> None:
    told = newest((0.0, 0.0, -10.0), rate=(0.2, 0.0, 0.0))
    _, y, z = target_in_body(told, 500 * S + S // 10)
    assert math.atan2(y, z) == pytest.approx(
        0.02
    )  # rolling right lifts the left side: what is below goes right


@pytest.mark.parametrize(
    ("told", "late_s", "why"),
    [
        (None, 0.0, "no estimate"),
        (newest(), 0.1, ""),
        (newest(), C.stale_s + 0.01, "the estimate is stale"),
        (newest(seen_ns=None), 0.0, "the target is lost"),
        (newest(seen_ns=100 * S - round(C.lost_s * S)), 0.05, "the target is lost"),
        (newest((0.0, 0.0, -0.9 * C.blind_height_m), seen_ns=90 * S), 0.0, ""),
        (newest((0.0, 0.0, 1.0)), 0.0, "the vehicle is not above the deck"),
        (newest((math.nan, 0.0, -5.0)), 0.0, "the estimate is not finite"),
    ],
)
def test_nothing_is_sent_on_what_cannot_be_trusted(told: Newest | None, late_s: float, why: str) -> None:
    assert why_not(told, 500 * S + round(late_s * S), C) == why


def flying() -> Vehicle:
    return Vehicle(system=1, armed=True, mode=GUIDED, landed_state=2)


def engaged() -> tuple[Guide, Vehicle]:
    guide, vehicle = Guide(C), flying()
    guide.look(vehicle, newest(), 500 * S, True)
    assert guide.engaged
    return guide, vehicle


def test_guidance_flies_in_guided_only() -> None:
    guide, vehicle = engaged()
    decision = guide.decide(newest(), 500 * S, None, False)
    assert decision is not None
    message = set_point(m, vehicle, decision, 1234)
    assert message.coordinate_frame == 1
    assert message.type_mask == 2503
    np.testing.assert_allclose([message.vx, message.vy, message.vz], decision.velocity_mps)
    assert message.yaw == decision.yaw_rad


def test_a_mode_change_drops_guidance_at_once_and_guided_takes_it_up_again() -> None:
    guide, vehicle = engaged()
    vehicle.mode = LAND
    guide.look(vehicle, newest(), 500 * S, True)
    assert not guide.engaged
    assert guide.decide(newest(), 500 * S, None, False) is None
    vehicle.mode = GUIDED
    guide.look(vehicle, newest(), 500 * S, True)
    assert guide.engaged
    assert guide.progress.mode is Mode.IDLE


@pytest.mark.parametrize("trouble", ["stale", "link", "disarmed"])
def test_what_comes_back_is_not_guided_until_guided_is_selected_anew(trouble: str) -> None:
    guide, vehicle = engaged()
    late = 500 * S + round((C.stale_s + 0.01) * S) if trouble == "stale" else 500 * S
    vehicle.armed = trouble != "disarmed"
    guide.look(vehicle, newest(), late, trouble != "link")
    assert not guide.engaged
    vehicle.armed = True
    guide.look(vehicle, newest(), 500 * S, True)
    assert not guide.engaged
    assert "GUIDED" in guide.why
    vehicle.mode = LAND
    guide.look(vehicle, newest(), 500 * S, True)
    vehicle.mode = GUIDED
    guide.look(vehicle, newest(), 500 * S, True)
    assert guide.engaged


@pytest.mark.parametrize("state", [0, 1, 3])
def test_a_take_off_is_not_disturbed(state: int) -> None:
    guide = Guide(C)
    guide.look(replace(flying(), landed_state=state), newest(), 500 * S, True)
    assert not guide.engaged


def test_health_tells_each_change_once_and_briefly() -> None:
    health = Health()
    assert health.update(Problem.ESTIMATE | Problem.TARGET, 0)
    assert health.state in (1, 2)
    assert health.update(Problem.ESTIMATE | Problem.TARGET, S) == []
    said = health.update(Problem(0), 3 * S)
    assert [text for _, text in said] == ["deckfix: no estimate: over", "deckfix: target not in view: over"]
    assert health.state == 4
    health.update(Problem.LINK, 6 * S)
    assert health.state == 5
    assert health.update(Problem(0), 6 * S + 1) == []  # at most once in two seconds
    assert all(len(f"deckfix: {w}: over") <= 50 for w in WORDS.values())
