"""What goes wrong during a landing in a closed loop: it recovers or is broken off, and never ends beside the deck."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import msgspec
import numpy as np
import pytest

from estimation.modes import Mode, Reason
from simulation import world
from simulation.flight import WavesTable
from simulation.mishaps import Mishap
from simulation.mission import Mission, load_mission
from simulation.sea import Wave
from simulation.world import Flown, fly

SEED = 1


def mission(*mishaps: Mishap, longest_s: float = 90.0) -> Mission:
    """Return a landing that takes half a minute where nothing goes wrong: it is over the deck's place soon."""
    base = load_mission("landing_beaufort2_2026_11")
    landing = {
        "search_altitude_m": 10.0,
        "observe_s": 6.0,
        "observe_max_s": 15.0,
        "wait_s": 8.0,
        "search_s": 15.0,
    }
    landing["attempts"] = 2
    return msgspec.structs.replace(
        base, filter={**base.filter, "landing": landing}, start_m=(-4.0, -3.0, -2.0), longest_s=longest_s,
        mishaps=mishaps,
    )  # fmt: skip


@dataclass
class Told:
    """When the modes of an undisturbed flight begin [s]: a mishap is put into one of them."""

    observation: float
    landing: float


@pytest.fixture(scope="module")
def told() -> Told:
    flown = fly(mission(), SEED)
    assert flown.end == "landed"
    began = {}
    for t, mode, _ in flown.transitions:
        began.setdefault(mode, t)
    return Told(began[Mode.OBSERVATION], began[Mode.LANDING])


def on_the_deck_or_not_at_all(flown: Flown) -> None:
    """Check what must hold whatever happens: no touch of the deck but inside r_land and in the landing mode, on the way
    down or led up from there; what stands stands inside as well; and an end.
    """
    assert flown.end in ("landed", "given up", "time is up")
    # After a contact within the time, the flight goes on until the vehicle stands.
    end_s = flown.t_s[-1] if flown.contact is None else flown.contact.t_s
    assert end_s <= flown.mission.longest_s
    if flown.contact is not None:
        r_land = flown.mission.config.landing.r_land_m
        assert [mode for t, mode, _ in flown.transitions if t <= flown.contact.t_s][-1] is Mode.LANDING
        assert flown.contact.miss_m < r_land
        if flown.end == "landed":
            assert np.linalg.norm(flown.truth[-1, :2] - flown.deck[-1, :2]) < r_land
    assert (flown.end == "landed") <= (flown.contact is not None)


def reasons(flown: Flown) -> set[Reason]:
    return {reason for _, _, reason in flown.transitions}


CASES: list[tuple[str, str, dict[str, Any], bool | None, Reason | None]] = [
    # What happens; in which mode; how; whether it lands all the same (None: either); the reason that answers it.
    ("loss", "landing", {"duration_s": 5.0}, True, Reason.TARGET_LOST),
    ("camera_freeze", "landing", {"duration_s": 5.0}, True, Reason.TARGET_LOST),
    ("clock_step", "observation", {"by_s": 0.5}, True, Reason.ESTIMATE_STALE),
    ("clock_step", "observation", {"by_s": -0.5}, True, None),
    ("loss", "landing", {"sensor": "imu", "duration_s": 0.3}, True, Reason.ESTIMATE_STALE),
    ("link_loss", "landing", {"duration_s": 3.0}, True, Reason.ESTIMATE_STALE),
    ("packet_loss", "", {"share": 0.3}, True, None),
    ("gps_drift", "observation", {"offset_m": (0.1, 0.05, 0.0)}, None, None),
    ("loss", "landing", {}, False, Reason.TARGET_LOST),
    ("camera_freeze", "landing", {}, False, Reason.TARGET_LOST),
    ("false_target", "landing", {"offset_m": (2.0, 0.0, 0.0)}, False, Reason.TARGET_LOST),
]
QUICK = (2, 8)
"""Those that are flown in every run of the tests; the others take a minute or two together."""


@pytest.mark.parametrize(
    ("kind", "mode", "how", "lands", "answer"),
    [pytest.param(*c, marks=[] if k in QUICK else pytest.mark.nightly) for k, c in enumerate(CASES)],
)
def test_a_mishap_is_recovered_from_or_ends_the_landing(
    told: Told, kind: Any, mode: str, how: dict[str, Any], lands: bool | None, answer: Reason | None
) -> None:
    start = {"landing": told.landing + 2.0, "observation": told.observation + 3.0, "": 0.0}[mode]
    flown = fly(mission(Mishap(kind=kind, start_s=start, **how)), SEED)
    on_the_deck_or_not_at_all(flown)
    assert lands is None or (flown.end == "landed") == lands
    if answer is not None:
        # It is noticed within what the landing modes allow for.
        after = [(t, mode, reason) for t, mode, reason in flown.transitions if t >= start]
        allowed = 3.5 if answer is Reason.ESTIMATE_STALE else flown.mission.config.landing.lost_s + 0.5
        assert after[0][2] is answer
        assert after[0][0] - start < allowed


@pytest.mark.nightly
@pytest.mark.parametrize("seed", range(1, 6))
@pytest.mark.parametrize(
    "mishap",
    [
        Mishap(kind="gps_jump", start_s=17.0, offset_m=(15.0, 0.0, 0.0)),
        Mishap(kind="gps_jump", start_s=17.0, offset_m=(5.0, -3.0, 4.0)),
        Mishap(kind="gps_drift", start_s=8.0, offset_m=(0.3, 0.2, 0.0)),
        Mishap(kind="false_target", start_s=9.0, offset_m=(2.0, 1.0, 0.0)),
        Mishap(kind="false_target", start_s=24.0, offset_m=(0.0, -1.0, 0.0)),
        Mishap(kind="loss", start_s=27.0),
        Mishap(kind="packet_loss", start_s=0.0, share=0.3),
    ],
    ids=lambda m: f"{m.kind}-{m.start_s:g}",
)
def test_whatever_misleads_it_never_touches_down_beside_the_deck(mishap: Mishap, seed: int) -> None:
    on_the_deck_or_not_at_all(fly(mission(mishap), seed))


@pytest.mark.parametrize(
    ("seed", "detector_s"),
    [
        pytest.param(seed, detector_s, marks=[] if (seed, detector_s) == (1, 2.5) else pytest.mark.nightly)
        for seed in range(1, 9)
        for detector_s in (1.0, 2.5, 5.0)
    ],
)
def test_what_stands_stays_until_a_slow_landing_detector_tells(
    monkeypatch: pytest.MonkeyPatch, seed: int, detector_s: float
) -> None:
    """In a swell, on a deck that falls away and comes up again under the vehicle while the target is out of sight. What
    a rising deck touches while it is led up does not stand: it goes on up, and comes again.
    """
    monkeypatch.setattr(world, "LEGS_LOADED_S", detector_s)
    swell = WavesTable(beaufort=3, waves=(Wave("swell", 0.4, 9.0, 0.2, 0.1),))
    flown = fly(msgspec.structs.replace(mission(), sea=swell), seed)
    assert flown.contact is not None
    if not flown.contact.descending:
        on_the_deck_or_not_at_all(flown)
        assert flown.end == "landed"
        return
    after = [(mode, reason) for t, mode, reason in flown.transitions if t > flown.contact.t_s]
    assert after == [(Mode.LANDED, Reason.CONTACT)]
    assert flown.transitions[-1][0] - flown.contact.t_s >= detector_s


@pytest.mark.nightly
@pytest.mark.parametrize("seed", range(1, 4))
def test_a_vehicle_that_answers_slowly_is_not_taken_for_one_that_stands(seed: int) -> None:
    """One whose vertical velocity is led up to what is asked for with 1 m/s^2: a step of it is not a contact."""
    base = mission()
    slow = msgspec.structs.replace(base.airframe, climb_mps2=1.0)
    flown = fly(msgspec.structs.replace(base, sea=WavesTable(beaufort=3), airframe=slow), seed)
    on_the_deck_or_not_at_all(flown)
    assert flown.contact is not None
    assert flown.contact.speed_mps < 1.0
    # What touches while it is led up stays in the landing mode until it stands.
    after = [mode for t, mode, _ in flown.transitions if t > flown.contact.t_s]
    assert set(after[:-1]) <= {Mode.LANDING}
    assert after[-1] is Mode.LANDED


def test_a_jump_of_the_gps_does_not_lead_the_vehicle_down_beside_the_deck(told: Told) -> None:
    jump = Mishap(kind="gps_jump", start_s=told.landing + 1.0, offset_m=(15.0, 0.0, 0.0))
    flown = fly(mission(jump, longest_s=told.landing + 12.0), SEED)
    on_the_deck_or_not_at_all(flown)
    # It stays over the deck until the landing is broken off; then it searches, high up, where the GPS has the anchor.
    broken_off = [t for t, mode, _ in flown.transitions if t > jump.start_s and mode is Mode.ABORT]
    assert broken_off
    before = (flown.t_s > jump.start_s) & (flown.t_s < broken_off[0])
    assert np.linalg.norm(flown.truth[before, :2] - flown.deck[before, :2], axis=1).max() < 1.5
    after = flown.t_s > broken_off[0] + 2.0
    assert (flown.deck[after, 2] - flown.truth[after, 2]).min() > 2.0
