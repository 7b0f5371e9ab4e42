"""The platform is carried where there are vision fixes, unless the configuration says otherwise."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_flight import deck_recording, small_log

import deckfix
from deckfix.replaying import facts
from estimation.config import Config, dump_config, parse_config
from estimation.estimator import LandingEstimator
from estimation.events import Kind
from estimation.output import Facts, with_facts
from logs.writer import FlightWriter


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("auto") / "seen.mcap"
    with FlightWriter(path) as writer:
        writer.write_recording(deck_recording(8.0))
    return path


def test_auto_is_the_default_and_is_decided_by_what_the_source_says() -> None:
    assert Config().platform.use == "auto"
    assert parse_config(dump_config(Config())) == Config()
    assert with_facts(Config(), Facts()).platform.use is False
    assert with_facts(Config(), Facts(vision=True)).platform.use is True
    off = parse_config("[platform]\nuse = false\n")
    assert with_facts(off, Facts(vision=True)) == off
    on = parse_config("[platform]\nuse = true\n")
    assert with_facts(on, Facts()) == on


def test_a_log_with_fixes_has_the_platform_and_is_the_same_as_with_it_asked_for(seen: Path) -> None:
    auto, on = deckfix.replay(seen), deckfix.replay(seen, parse_config("[platform]\nuse = true\n"))
    assert auto.has_deck and np.array_equal(auto.run.deck, on.run.deck)
    off = deckfix.replay(seen, parse_config("[platform]\nuse = false\n"))
    assert not off.has_deck and off.run.deck.shape[1] == 0


def test_a_log_without_fixes_gives_what_it_gives_without_the_platform(tmp_path: Path) -> None:
    log = small_log(tmp_path / "blind.mcap", 8.0)
    assert not facts(deckfix.open(log)).vision
    auto, off = deckfix.replay(log), deckfix.replay(log, parse_config("[platform]\nuse = false\n"))
    assert auto.run.state_names == off.run.state_names
    assert np.array_equal(auto.run.nominal, off.run.nominal)


def test_the_state_does_not_depend_on_when_the_fixes_come(seen: Path) -> None:
    flight = deckfix.open(seen)
    batch, known = flight.events(), facts(flight)
    late = replace(batch, rows=batch.rows[batch.rows["kind"] != int(Kind.VISION)])
    some, none = (LandingEstimator(facts=known).run(b) for b in (batch, late))
    assert some.state_names == none.state_names
    first = int(batch.rows["arrival_ns"][batch.rows["kind"] == int(Kind.VISION)].min())
    assert first > 0 and none.deck.shape[1] == some.deck.shape[1] > 0
