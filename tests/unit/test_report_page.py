"""The report: complete in itself, and text from a log stays text."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from synthetic_result import synthetic_result

from deckfix.report import render
from deckfix.result import LogMessage, Result
from estimation.outcome import Outcome

HOSTILE = "</script><script>document.title='pwned'</script><img src=x onerror=alert(1)>\u2028\x00\"'&"
SECTIONS = ("wrong", "track", "estimate", "measurements", "outcomes", "states", "inputs", "configuration")


def hostile_result() -> Result:
    """Return a result in which every text that a log can hold is an attack."""
    result = synthetic_result()
    run = result.run
    sensors = (HOSTILE, *run.sensors[1:])
    streams = tuple(replace(s, name=HOSTILE) if s.name == "gps_position" else s for s in result.streams)
    return replace(
        result,
        flight=HOSTILE,
        run=replace(run, sensors=sensors, notes=[(int(run.t_ns[5]), HOSTILE)]),
        streams=streams,
        problems=(HOSTILE,),
        messages=(LogMessage(int(run.t_ns[0]), 50, HOSTILE, HOSTILE),),
        metadata={HOSTILE: {HOSTILE: HOSTILE}},
        config_text=HOSTILE,
        config_source=HOSTILE,
        clocks={HOSTILE: {"status": HOSTILE}},
    )


def without_library(page: str) -> str:
    """Return a page without plotly's own code."""
    from plotly.offline import get_plotlyjs

    return page.replace(get_plotlyjs(), "")


@pytest.fixture(scope="module")
def page() -> str:
    return render(synthetic_result())


def test_all_sections_are_there(page: str) -> None:
    for section in SECTIONS:
        assert f'<section id="{section}">' in page
        assert f'href="#{section}"' in page


def test_the_page_loads_nothing_and_is_small(page: str) -> None:
    rest = without_library(page)
    assert "default-src 'none'" in rest
    assert not re.search(r"""(?:src|href)\s*=\s*["'](?!#)""", rest)
    assert "@import" not in rest
    assert "url(" not in rest
    assert len(page.encode()) < 8_000_000


def test_long_flights_stay_small() -> None:
    result = synthetic_result()
    many = {
        name: np.tile(getattr(result.run, name), (10,) + (1,) * (getattr(result.run, name).ndim - 1))
        for name in ("position_m", "velocity_mps", "quaternion", "covariance", "gyro_bias", "accel_bias")
    }
    n = len(result.run.t_ns) * 10
    t = result.start_ns + np.arange(n, dtype=np.int64) * 20_000_000
    run = replace(
        result.run,
        t_ns=t,
        nominal=np.tile(result.run.nominal, (10, 1)),
        sigma=np.tile(result.run.sigma, (10, 1)),
        **many,
    )
    long = replace(result, run=run, end_ns=int(t[-1]), truth_errors=None, at_autopilot=None)
    assert len(render(long).encode()) < 8_000_000


def test_hostile_text_stays_text() -> None:
    rest = without_library(render(hostile_result()))
    assert "<script>document" not in rest
    assert "<img" not in rest
    assert "\x00" not in rest
    assert "&lt;script&gt;document.title=" in rest
    scripts = re.findall(r"<script[^>]*>", rest)
    assert scripts.count("<script>") == 2
    assert all(s == "<script>" or 'type="application/json"' in s for s in scripts)


def test_a_clean_flight_says_so() -> None:
    clean = render(synthetic_result())
    assert "Nothing was found." in clean
    assert "Nothing went wrong that can be seen from the log." in clean


def test_a_flight_without_estimates_still_has_a_report() -> None:
    result = synthetic_result(with_truth=False)
    run = result.run
    empty = {
        name: getattr(run, name)[:0]
        for name in ("t_ns", "position_m", "velocity_mps", "quaternion", "covariance", "nominal", "sigma")
    }
    records = run.records.copy()
    records["outcome"], records["nis"], records["dof"] = int(Outcome.REJECTED_NOT_READY), np.nan, 0
    bare = replace(run, **empty, gyro_bias=run.gyro_bias[:0], accel_bias=run.accel_bias[:0], records=records)
    bare = replace(bare, origin=None, missing="a GPS fix", notes=[])
    page = render(replace(result, run=bare, autopilot=None))
    assert "There is no estimate" in page
    assert "it waited for a GPS fix" in page
    assert '<section id="track">' not in page
    assert '<section id="inputs">' in page


def test_without_truth_the_estimates_are_shown() -> None:
    page = render(synthetic_result(with_truth=False))
    assert "The log holds no truth" in page
    assert "horizontal sigma, median" in page


def test_the_report_is_the_same_each_time(tmp_path: Path) -> None:
    assert render(synthetic_result()) == render(synthetic_result())
