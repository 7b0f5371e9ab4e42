"""Flights of ArduPilot's own code: our errors against the simulator's truth over those of its EKF3."""

from __future__ import annotations

from pathlib import Path

import pytest

import deckfix
from deckfix.importing import import_flight
from deckfix.result import Result

TARGETS = {
    "horizontal_position": 1.05,
    "height": 0.4,
    "horizontal_velocity": 0.95,
    "vertical_velocity": 0.5,
    "roll_pitch": 0.7,
    "yaw": 0.4,
}
CONTACT_BOOT_S = {"calm": 114.13, "heave06": 102.53, "sea3a": 181.41}
"""When the simulator said "Hit ground"; kept apart from the truth that the rule for contact reads."""


@pytest.fixture(scope="module", params=sorted(CONTACT_BOOT_S))
def flight(request: pytest.FixtureRequest, data_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    source = data_dir / "ardupilot_sitl" / f"{request.param}.BIN"
    if not source.exists():
        pytest.skip(f"{source} is not there")
    target = tmp_path_factory.mktemp("sitl") / f"{request.param}.mcap"
    import_flight([source], target)
    return target


@pytest.fixture(scope="module")
def result(flight: Path) -> Result:
    return deckfix.replay(flight)


def test_errors_over_the_autopilots_own(result: Result) -> None:
    ratio = result.summary()["ratio"]
    print(result.flight, {k: round(ratio[k], 3) for k in TARGETS})
    for name, target in TARGETS.items():
        assert ratio[name] <= target, name


def test_contact_is_found_in_the_truth(result: Result) -> None:
    assert result.judged.contact_ns is not None
    expected = CONTACT_BOOT_S[result.flight.removesuffix(".mcap")]
    assert result.judged.contact_ns * 1e-9 == pytest.approx(expected, abs=0.06)


def test_the_report_of_a_real_flight_is_whole(result: Result) -> None:
    page = result.report()
    assert len(page.encode()) < 8_000_000
    assert page.count("<section") == 8
