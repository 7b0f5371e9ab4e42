"""The report's sections of the platform, its clocks and its heave, and what is found wrong with them."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from small_flight import deck_recording
from synthetic_result import synthetic_result

import deckfix
from deckfix import deck_figures, heave_figures
from deckfix.finding import Severity
from deckfix.findings import findings
from deckfix.report import render
from deckfix.result import Result
from estimation.config import parse_config
from estimation.heave.model import fit
from estimation.outcome import Outcome
from logs.writer import FlightWriter

CONFIG = "[platform]\nuse = true\nlearn_s = 2.0\n"
NEW_SECTIONS = ("platform", "heave", "clocks")


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Result:
    path = tmp_path_factory.mktemp("deck") / "deck.mcap"
    with FlightWriter(path) as writer:
        writer.write_recording(deck_recording())
    return deckfix.replay(path, parse_config(CONFIG))


def symptoms(result: Result) -> dict[str, Severity]:
    return {f.symptom: f.severity for f in findings(result)}


def changed(result: Result, **changes: Any) -> Result:
    return replace(result, run=replace(result.run, **changes))


def test_sections_come_with_a_platform_and_only_then(result: Result) -> None:
    page = render(result)
    for section in NEW_SECTIONS:
        assert f'<section id="{section}">' in page
    for section in NEW_SECTIONS:
        assert f'<section id="{section}">' not in render(synthetic_result())
    assert "Positive means that the content is older than its stamp" in page
    assert "raw fixes" in page
    assert "Skill over horizon" in page
    assert re.search(r"inside 95 %.*level given instead", page)


def test_every_axis_of_the_platforms_figures_has_its_unit(result: Result) -> None:
    seconds = result.seconds_of(result.forecasts.origin_ns)
    figures = [
        deck_figures.relative(result),
        deck_figures.deck_height(result),
        deck_figures.clocks(result),
        heave_figures.spectrum(result.run.heave[-1][1]),
        heave_figures.skill(result.forecasts, result.forecast_scores),
        heave_figures.against_what_happened(result.forecasts, seconds, seconds, seconds, "truth", 20.0),
    ]
    for figure in figures:
        y = [v["title"]["text"] for k, v in figure["layout"].items() if k.startswith("yaxis")]
        assert y
        assert all("[" in title or "skill" in title for title in y), y


def test_errors_are_shown_with_the_fixes_errors_beside_them(result: Result) -> None:
    figure = deck_figures.relative(result)
    raw = [t for t in figure["data"] if t.get("name") == "raw fix"]
    assert len(raw) == 3
    assert np.std(raw[2]["y"]) < 0.1
    without = replace(result, deck_errors=None, truth=None, platform=None)
    values = [t for t in deck_figures.relative(without)["data"] if t.get("name") == "deckfix"]
    assert np.median(values[2]["y"]) == pytest.approx(-6.0, abs=0.3)


def test_a_model_without_a_spectrum_is_drawn_too() -> None:
    t = np.arange(0.0, 40.0, 0.1)
    plain = fit(t, 0.3 * np.sin(t), 0.01, method="sinusoids", components=1)
    assert heave_figures.spectrum(plain)["data"]
    short = fit([0.0], [0.1], 0.01)
    assert short.reason
    figure = heave_figures.fit_and_forecast(short, np.zeros(1), np.full(1, 0.1))
    assert figure["layout"]["xaxis"]["range"]


def test_a_good_flight_over_a_deck_has_no_warning_of_the_platform(result: Result) -> None:
    told = symptoms(result)
    assert not [
        t for t in told if "heave was not learned" in t or "no vision fix" in t or "arrivals only" in t
    ]


def test_unobserved_latency_is_told_with_the_excitation(result: Result) -> None:
    found = [f for f in findings(result) if "was not observed" in f.symptom]
    assert len(found) == 1
    assert "rock the vehicle" in found[0].remedy


def test_lost_fixes_are_told(result: Result) -> None:
    records = result.run.records.copy()
    vision = records["sensor"] == result.run.sensors.index("vision")
    middle = np.abs(records["t_ns"] - np.median(records["t_ns"])) < 3e9
    records["outcome"][vision & middle] = int(Outcome.REJECTED_GATE)
    told = symptoms(changed(result, records=records))
    matching = {t: s for t, s in told.items() if t.startswith("no vision fix was fused for 6")}
    assert list(matching.values()) == [Severity.WARNING]
    records["outcome"][vision] = int(Outcome.REJECTED_GATE)
    assert symptoms(changed(result, records=records))["no vision fix was ever fused"] is Severity.WARNING


def test_heave_that_was_not_learned_is_told(result: Result) -> None:
    told = symptoms(changed(result, heave=[]))
    assert [s for t, s in told.items() if t.startswith("the heave was not learned")] == [Severity.WARNING]


def test_untied_clocks_are_told(result: Result) -> None:
    clocks = {"companion": {"source": "arrivals", "status": "acquiring", "offset_ms": 1.0}}
    told = symptoms(replace(result, clocks=clocks))
    assert told["the clock companion is tied to the inertial one by arrivals only"] is Severity.WARNING
    assert [
        t for t in symptoms(replace(result, clocks={"companion": {"status": "stale"}})) if "ends stale" in t
    ]


def test_watchdog_notes_and_large_vision_innovations_are_told(result: Result) -> None:
    notes = [(int(result.run.t_ns[9]), "heave watchdog: back to level and drift")]
    assert [t for t in symptoms(changed(result, notes=notes)) if "watchdog" in t]
    records = result.run.records.copy()
    records["nis"][records["sensor"] == result.run.sensors.index("vision")] *= 10.0
    found = [
        f
        for f in findings(changed(result, records=records))
        if f.symptom.startswith("vision: innovations are")
    ]
    assert len(found) == 1
    assert "calibrate" in found[0].remedy


def test_a_platform_that_is_off_is_noted(result: Result) -> None:
    off = changed(result, deck=np.zeros((len(result.run.t_ns), 0)), heave=[])
    assert "the log holds vision fixes, but the platform is switched off" in symptoms(off)


def test_hostile_clock_names_stay_text(result: Result) -> None:
    attack = "</script><img src=x onerror=alert(1)>"
    tracks = tuple(replace(t, clock=attack, source=attack) for t in result.clock_tracks)
    page = render(replace(result, clock_tracks=tracks, clocks={attack: {"status": attack, "source": attack}}))
    from plotly.offline import get_plotlyjs

    rest = page.replace(get_plotlyjs(), "")
    assert "<img" not in rest
    assert "&lt;img" in rest
