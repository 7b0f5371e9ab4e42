"""Is the filter honest? Simulated flights with sensors exactly as it is told, in every phase of the flight."""

from __future__ import annotations

import numpy as np
import pytest

from estimation.consistency import RunsConsistency, whiteness
from simulation.flight import load_scenario
from simulation.known import MODE_PARTS
from simulation.mission import load_mission
from simulation.montecarlo import FlightErrors, fly, land, nees_by_phase, nis_by_phase
from simulation.trajectory import PHASES

SCENARIOS = ("consistency_default_2026_06", "consistency_survey_2026_06")
QUICK, FULL = 8, 50


def table(result: dict[tuple[str, str], RunsConsistency]) -> str:
    return "\n".join(
        f"{name} in {phase}: {c.mean_over_dof:.2f} (band {c.band.low:.2f} to {c.band.high:.2f})"
        for (name, phase), c in result.items()
        if not c.consistent
    )


@pytest.fixture(scope="module", params=SCENARIOS)
def flights(request: pytest.FixtureRequest) -> list[FlightErrors]:
    scenario = load_scenario(request.param)
    return [fly(scenario, 1000 + seed) for seed in range(QUICK)]


def test_errors_are_what_the_covariance_says(flights: list[FlightErrors]) -> None:
    """The band of 99.9 % for so few flights: wide, and right for the many quantities and phases judged."""
    result = nees_by_phase(flights, 0.999)
    assert {phase for _, phase in result} == set(PHASES)
    assert {name for name, _ in result} >= {
        "position",
        "velocity",
        "attitude",
        "gyro_bias",
        "accel_bias",
        "gps_bias",
    }
    assert not table(result), table(result)


def test_innovations_are_what_the_filter_predicts(flights: list[FlightErrors]) -> None:
    result = nis_by_phase(flights, 0.999)
    assert {name for name, _ in result} >= {"gps_position", "gps_velocity", "barometer", "magnetometer"}
    assert not table(result), table(result)


def test_innovations_are_white(flights: list[FlightErrors]) -> None:
    """The mean autocorrelation over the flights, for each sensor, stays near zero at every lag."""
    for name in ("gps_velocity", "barometer", "magnetometer"):
        rho = []
        for flight in flights:
            r = flight.run.records[flight.run.records["sensor"] == flight.run.sensors.index(name)]
            r = r[r["dof"] > 0]
            rho.append(whiteness(r["innovation"][:, 0] / r["sigma"][:, 0], lags=10).autocorrelation)
        n = min(len(f.nis[name].values) for f in flights) * len(flights)
        # Four sigma: 2 scenarios, 3 sensors and 10 lags are looked at.
        assert np.abs(np.mean(rho, axis=0)).max() < 4.0 / np.sqrt(n), name


def test_following_a_deck_that_drifts_leaves_the_estimates_as_good_as_they_say() -> None:
    """A landing flown on its own estimates: what the vehicle does depends on their errors, which a plan's flight hides.

    The raft drifts by up to 0.2 m/s on its mooring, and the vehicle with it, so that the fixes show neither.
    """
    flights = [land(load_mission("landing_beaufort2_2026_11"), 7000 + seed) for seed in range(QUICK)]
    nees, nis = nees_by_phase(flights, 0.999), nis_by_phase(flights, 0.999)
    assert {part for _, part in nees} >= set(MODE_PARTS) - {"abort"}
    assert {name for name, _ in nees} >= {"velocity", "attitude", "accel_bias", "relative", "deck_rate"}
    assert not table(nees), table(nees)
    assert not table(nis), table(nis)
    truth = np.concatenate([f.known.deck_mps[:, :2] for f in flights])
    assert np.abs(truth).max() > 0.15


@pytest.mark.nightly
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("name", SCENARIOS)
def test_fifty_flights(name: str) -> None:
    """All inside the band of 99.9 %, and no more outside that of 95 % than chance allows."""
    scenario = load_scenario(name)
    flights = [fly(scenario, 1000 + seed) for seed in range(FULL)]
    for judge in (nees_by_phase, nis_by_phase):
        usual, wide = judge(flights, 0.95), judge(flights, 0.999)
        assert not table(wide), table(wide)
        assert sum(not c.consistent for c in usual.values()) <= max(1, 0.05 * len(usual)), table(usual)
