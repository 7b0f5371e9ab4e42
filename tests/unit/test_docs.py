"""The README and the guides name only what is there."""

from __future__ import annotations

import importlib
import json
import re
from pathlib import Path
from typing import get_type_hints

import pytest

from deckfix.cli import deckfix as program
from estimation.config import Config, parse_config
from logs.topics import TOPICS, definition
from logs.writer import CLOCKS
from simulation.flight import parse_scenario

ROOT = Path(__file__).parents[2]
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md")])
PACKAGES = ("estimation", "vision", "logs", "simulation", "deckfix")


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_commands_links_and_targets_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    makefile = (ROOT / "Makefile").read_text()
    for command in re.findall(r"(?:`|^    |bin/)deckfix ([a-z]+)", text, re.M):
        assert command in program.commands, command
    for target in re.findall(r"(?:`|^    )make ([a-z]+)", text, re.M):
        assert f"\n{target}:" in makefile, target
    for link in re.findall(r"\]\(([^)#:]+)", text):
        assert (page.parent / link).exists(), link


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_names_of_the_code_and_of_the_configuration_exist(page: Path) -> None:
    tables = get_type_hints(Config)
    first = "|".join({*PACKAGES, *tables})
    for name in re.findall(rf"`((?:{first})(?:\.[A-Za-z_]\w*)+)`", page.read_text(encoding="utf-8")):
        table, key = name.split(".", 1)
        if name == CLOCKS or (table in tables and key in tables[table].__struct_fields__):
            continue
        assert table in PACKAGES, name
        resolve(name)


def resolve(name: str) -> object:
    """Return what a dotted name means: a module, or what is in one."""
    parts = name.split(".")
    found: object = importlib.import_module(parts[0])
    for i, part in enumerate(parts[1:], start=2):
        if not hasattr(found, part):
            importlib.import_module(".".join(parts[:i]))
        found = getattr(found, part)
    return found


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_files_of_the_code_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    for name in re.findall(rf"`((?:{'|'.join(PACKAGES)}|benchmarks|notebooks|docs|tests)/[\w./-]*)`", text):
        assert (ROOT / name).exists(), name


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_configurations_shown_are_valid(page: Path) -> None:
    for block in re.findall(r"```toml\n(.*?)```", page.read_text(encoding="utf-8"), re.S):
        if "[plan]" in block:
            parse_scenario(block, page.name)
        else:
            parse_config(block, page.name)


def test_options_shown_exist() -> None:
    text = "".join(p.read_text(encoding="utf-8") for p in PAGES)
    known = {o for c in program.commands.values() for p in c.params for o in (*p.opts, *p.secondary_opts)}
    known |= {"--help", "--version"}
    for line in re.findall(r"^ {4}.*deckfix [a-z]+ .*$", text, re.M):
        for option in re.findall(r"--[a-z-]+", line.split("#")[0]):
            assert option in known, line


def test_the_picture_is_small() -> None:
    assert (ROOT / "docs" / "images" / "report.png").stat().st_size < 300_000


def test_the_layout_for_foxglove_shows_fields_that_are_there() -> None:
    layout = json.loads((ROOT / "docs" / "foxglove_layout.json").read_text(encoding="utf-8"))
    shown = []
    for name, panel in layout["configById"].items():
        paths = [p["value"] for p in panel.get("paths", [])]
        paths += [panel["xAxisPath"]["value"]] if "xAxisPath" in panel else []
        paths += [panel[key] for key in ("topicToRender",) if key in panel]
        paths += [panel["imageMode"]["imageTopic"]] if "imageMode" in panel else []
        assert paths, name
        shown += paths
        assert json.dumps(name) in json.dumps(layout["layout"]), f"{name} is in no place of the layout"
    for path in shown:
        topic, _, rest = re.sub(r"\{.*?\}|\[\d+\]", "", path).partition(".")
        message = definition(TOPICS[topic].message_type)
        kind = message.name
        for field in rest.split(".") if rest else []:
            (kind,) = [f.type for f in message.fields[kind] if f.name == field]
        for sensor in re.findall(r'sensor=="(\w+)"', path):
            assert sensor in {"gps_position", "gps_velocity", "barometer", "magnetometer", "vision"}
