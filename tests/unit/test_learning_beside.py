"""The platform's motion learned beside the estimates: the same bits, however long the learning takes."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace as changed

from estimation.ahead import DeckForecaster
from estimation.config import Config
from estimation.deck import prior_motion
from estimation.estimator import TAKE_UP_NS, LandingEstimator
from estimation.events import Event, Imu
from simulation.flight import SimulatedFlight, parse_scenario, simulate

FLIGHT = """
description = "a hover over a raft"
[plan]
rest_s = 4.0
climb_s = 4.0
leg_s = 2.0
hover_s = 16.0
descent_s = 3.0
deck_s = 1.0
altitude_m = 4.0
start_m = [-3.0, 0.0, -1.0]
legs_m = []
yaw_rad = [0.6, 0.4]
[sea]
beaufort = 2
[streams]
imu = { rate_hz = 100.0 }
timesync = { rate_hz = 10.0, delay_s = 0.001, delay_spread_s = 0.0005 }
vision = { rate_hz = 20.0, delay_s = 0.06 }
[filter.platform]
use = true
learn_s = 1.0
"""


MOTION = prior_motion(parse_scenario(FLIGHT).config.platform)


class Late(Executor):
    """Does nothing before it is asked for a result: the slowest that there is."""

    def __init__(self) -> None:
        self.given = self.asked = 0

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        executor = self
        self.given += 1

        class Waiting(Future[Any]):
            def result(self, timeout: float | None = None) -> Any:
                executor.asked += 1
                return fn(*args, **kwargs)

        return Waiting()


class Failing(Executor):
    """Fails at what it is given."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_exception(ArithmeticError("no such sea"))
        return future


@pytest.fixture(scope="module")
def flight() -> SimulatedFlight:
    return simulate(parse_scenario(FLIGHT), 3)


def again(events: list[Event]) -> Iterator[Event]:
    """The flight, and the same once more: arrival goes on, and every clock begins anew."""
    yield from events
    later = events[-1].arrival_ns - events[0].arrival_ns + 10_000_000
    for event in events:
        yield replace(event, arrival_ns=event.arrival_ns + later)


def all_of(
    flight: SimulatedFlight, events: Iterator[Event], executor: Executor | None, config: Config | None = None
) -> tuple[list[bytes], bytes]:
    """Every estimate as it came out, with what is said of the deck's sea then, and the records with the notes."""
    e = LandingEstimator(config or flight.scenario.config, "compiled", flight.facts, executor=executor)
    estimates, records = [], b""
    forecaster = DeckForecaster.at(np.array([0.0, 1.0]))
    for event in events:
        output = e.step(event)
        records += output.records.tobytes()
        if output.estimate is not None:
            x = output.estimate
            ahead = e.deck_forecast(forecaster)
            assert ahead is not None
            said = np.array([ahead.learned, *ahead.skill])
            estimates.append(x.nominal.tobytes() + x.covariance.tobytes() + x.deck.tobytes() + said.tobytes())
    output = e.settled()
    notes = "\n".join(str(note) for note in output.notes)
    return estimates, records + output.records.tobytes() + notes.encode()


@pytest.mark.parametrize("twice", [False, True])
def test_what_is_learned_beside_is_the_same_however_long_it_takes(
    flight: SimulatedFlight, twice: bool
) -> None:
    events = list(flight.batch)
    flown = again if twice else iter
    wanted = all_of(flight, flown(events), None)
    late = Late()
    assert all_of(flight, flown(events), late) == wanted
    assert late.asked > 100
    with ThreadPoolExecutor(1) as pool:
        assert all_of(flight, flown(events), pool) == wanted
    # What is learned counts: without it other estimates come out.
    config = flight.scenario.config
    blind = changed(config, platform=changed(config.platform, learn_s=0.0))
    assert all_of(flight, flown(events), None, blind)[0] != wanted[0]


def test_a_sea_is_told_as_learned_once_it_is_taken_up(flight: SimulatedFlight) -> None:
    e = LandingEstimator(flight.scenario.config, "compiled", flight.facts)
    forecaster = DeckForecaster.at(np.array([0.0, 1.0]))
    found = told = None
    for event in flight.batch:
        e.step(event)
        if not isinstance(event, Imu):
            continue
        if found is None and e.heave_model is not None and not np.array_equal(e.motion, MOTION):
            found = event.stamp_ns
        ahead = e.deck_forecast(forecaster)
        if ahead is not None and ahead.learned:
            told = event.stamp_ns
            break
    assert found is not None
    assert told is not None
    assert told - found >= TAKE_UP_NS - 50_000_000


def test_nothing_is_waited_for_before_it_is_taken_up(flight: SimulatedFlight) -> None:
    late = Late()
    e = LandingEstimator(flight.scenario.config, "compiled", flight.facts, executor=late)
    first = None
    for event in flight.batch:
        e.step(event)
        if not isinstance(event, Imu):
            continue
        if late.given and first is None:
            first = event.stamp_ns
        if late.asked:
            break
    assert first is not None
    # The window, in which nothing is final, is over when the first of it is given to be learned.
    assert event.stamp_ns - first == pytest.approx(TAKE_UP_NS, abs=50_000_000)


def test_what_fails_beside_fails_where_it_is_taken_up(flight: SimulatedFlight) -> None:
    e = LandingEstimator(flight.scenario.config, "compiled", flight.facts, executor=Failing())
    with pytest.raises(ArithmeticError, match="no such sea"):
        for event in flight.batch:
            e.step(event)
