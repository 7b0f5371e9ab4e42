"""docs/json.md names every key that a summary has, and none that no summary has."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from documented import deck_log
from imaged_flight import write_flight
from small_flight import small_log

import deckfix
from deckfix.cli import main
from estimation.outcome import Outcome

PAGE = Path(__file__).parents[2] / "docs" / "json.md"
NAMED_BY_THE_FLIGHT = {"SENSOR", "CLOCK", "HORIZON", "OUTCOME", "REASON"}


def paths(document: Any, below: str = "") -> Iterator[tuple[str, ...]]:
    """Yield the paths of keys of a summary, with what the flight names replaced by placeholders."""
    if not isinstance(document, dict):
        return
    for key, value in document.items():
        name = key
        if below in ("events", "fusion", "nis"):
            name = "SENSOR"
        elif below == "clock":
            name = "CLOCK"
        elif key in Outcome.__members__:
            name = "OUTCOME"
        elif re.fullmatch(r"\d+(\.\d+)?", key):
            name = "HORIZON"
        elif below == "no_fix":
            name = "REASON"
        yield (name,)
        for rest in paths(value, key):
            yield (name, *rest)


@pytest.fixture(scope="module")
def summaries(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Any]]:
    """Return summaries of replays that between them have every part."""
    folder = tmp_path_factory.mktemp("json")
    deck_log(folder / "deck.mcap")
    write_flight(folder / "images.mcap")
    small_log(folder / "small.mcap", seconds=14.0)
    small_log(folder / "no_truth.mcap", seconds=8.0, truth=False)
    made = [
        deckfix.replay(folder / "deck.mcap", smooth=True),
        deckfix.replay(folder / "images.mcap", jobs=1),
        deckfix.replay(folder / "small.mcap"),
        deckfix.replay(folder / "no_truth.mcap", smooth=True),
    ]
    return [m.summary() for m in made]


@pytest.fixture(scope="module")
def found(summaries: list[dict[str, Any]]) -> set[tuple[str, ...]]:
    return {path for one in summaries for path in paths(one)}


def test_every_key_is_documented(found: set[tuple[str, ...]]) -> None:
    text = PAGE.read_text(encoding="utf-8").split("# The summary of `heave --json`")[0]
    words = {part for code in re.findall(r"`([^`]+)`", text) for part in code.split(".")}
    missing = {".".join(p) for p in found if p[-1] not in words | NAMED_BY_THE_FLIGHT}
    assert not missing


def test_every_documented_key_is_there(found: set[tuple[str, ...]]) -> None:
    text = (
        PAGE.read_text(encoding="utf-8").split("# The summary of `heave --json`")[0].split("**Window.**")[0]
    )
    rows = re.findall(r"^\| (`[^|]+) \|", text, re.M)
    keys = [key for row in rows for key in re.findall(r"`([\w.]+)`", row)]
    assert len(keys) > 30
    ends = {p[i:] for p in found for i in range(len(p))}
    conditional = {"ratio", "autopilot", "contact_s"}
    missing = [k for k in keys if tuple(k.split(".")) not in ends and k.split(".")[0] not in conditional]
    assert not missing


def test_the_documented_keys_of_sync_are_there(tmp_path: Path) -> None:
    deck_log(tmp_path / "deck.mcap")
    assert main(["sync", str(tmp_path / "deck.mcap"), "--json", str(tmp_path / "s.json"), "--jobs", "1"]) == 0
    told = json.loads((tmp_path / "s.json").read_text())
    text = PAGE.read_text(encoding="utf-8").split("# The result of `sync --json`")[1]
    keys = {k for row in re.findall(r"^\| (`[^|]+) \|", text, re.M) for k in re.findall(r"`(\w+)[.`]", row)}
    assert keys == set(told)
