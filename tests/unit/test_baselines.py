"""The comparison of benchmarks with their baselines, and that none of them is forgotten."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture
def load(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(BENCHMARKS))

    def module(name: str) -> ModuleType:
        spec = importlib.util.spec_from_file_location(f"benchmark_{name}", BENCHMARKS / f"{name}.py")
        assert spec is not None
        assert spec.loader is not None
        made = importlib.util.module_from_spec(spec)
        monkeypatch.setitem(sys.modules, spec.name, made)
        spec.loader.exec_module(made)
        return made

    return module


def document(*rows: tuple[str, float | None, bool, float | None]) -> dict[str, Any]:
    return {
        "targets": [
            {"name": n, "value": v, "bound": 1.0, "at_least": least, "spread": spread, "met": True}
            for n, v, least, spread in rows
        ]
    }


def test_a_number_that_is_worse_by_more_than_its_spread_is_named(load: Any) -> None:
    missed = load("targets").missed_baselines
    then = document(("error", 1.0, False, None), ("ratio", 20.0, True, 4.0), ("gone", 1.0, False, None))
    same = document(("error", 1.09, False, None), ("ratio", 16.5, True, 0.1), ("gone", 0.2, False, None))
    assert missed(same, then) == []
    assert (
        missed(
            document(("error", 0.1, False, None), ("ratio", 90.0, True, 4.0), ("gone", 0.0, False, None)),
            then,
        )
        == []
    )
    worse = missed(document(("error", 1.2, False, None), ("ratio", 15.0, True, 4.0)), then)
    assert [line.split(":")[0] for line in worse] == ["error", "ratio", "gone"]
    assert "not measured any more" in worse[2]


def test_a_count_of_none_may_not_become_one(load: Any) -> None:
    missed = load("targets").missed_baselines
    assert missed(document(("differs", 1.0, False, None)), document(("differs", 0.0, False, None)))


def test_targets_say_which_way_is_better(load: Any) -> None:
    module = load("targets")
    targets = module.Targets()
    targets.add(module.Target("ratio", 20.0, 15.0, at_least=True, spread=2.0))
    row = targets.as_rows()[0]
    assert (row["at_least"], row["spread"], row["met"]) == (True, 2.0, True)


def test_every_benchmark_is_run(load: Any) -> None:
    # A benchmark writes its numbers; what else lies there draws pictures or is shared.
    texts = {p.stem: p.read_text(encoding="utf-8") for p in BENCHMARKS.glob("*.py")}
    scripts = {name for name, text in texts.items() if "__main__" in text and '"--json"' in text}
    assert {b.name for b in load("run").ALL} == scripts - {"run"}, "name it in benchmarks/run.py"


def test_baselines_are_of_benchmarks_that_there_are(load: Any) -> None:
    names = {b.name for b in load("run").ALL}
    of_vision = set(load("vision_baseline").FILES.values())
    for path in (BENCHMARKS / "baselines").glob("*.json"):
        found = json.loads(path.read_text(encoding="utf-8"))
        assert path.stem in names or path.name in of_vision
        assert {"commit", "machine"} <= found.keys(), path
