"""The README and the guides name only what is there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from deckfix.cli import deckfix as program
from estimation.config import parse_config

ROOT = Path(__file__).parents[2]
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md")])


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_commands_links_and_targets_exist(page: Path) -> None:
    text = page.read_text(encoding="utf-8")
    makefile = (ROOT / "Makefile").read_text()
    for command in re.findall(r"(?:`|^    |bin/)deckfix ([a-z]+)", text, re.M):
        assert command in program.commands, command
    for target in re.findall(r"(?:`|^    )make ([a-z]+)", text, re.M):
        assert f"\n{target}:" in makefile, target
    for link in re.findall(r"\]\(([^)#:]+)\)", text):
        assert (page.parent / link).exists(), link


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_configurations_shown_are_valid(page: Path) -> None:
    for block in re.findall(r"```toml\n(.*?)```", page.read_text(encoding="utf-8"), re.S):
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
