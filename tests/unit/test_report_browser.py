"""The report in a real browser: it draws, says nothing on the console, and runs no code of a log's."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
from synthetic_result import synthetic_result

from deckfix.report import render
from deckfix.result import LogMessage

ATTACK = "</script><script>document.title='pwned'</script><img src=x onerror=\"document.title='pwned'\">"


@pytest.fixture(scope="module")
def browser() -> str:
    found = os.environ.get("CHROMIUM") or shutil.which("chromium") or shutil.which("google-chrome")
    if found is None:
        pytest.skip("no browser: install Debian's chromium, or set CHROMIUM")
    return found


def visit(browser: str, page: Path, profile: Path, width: int = 1280) -> tuple[str, list[str]]:
    """Return the document after its scripts have run, and what the console said."""
    done = subprocess.run(
        [
            browser, "--headless", "--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage",
            "--enable-logging=stderr", "--v=0", f"--user-data-dir={profile}", f"--window-size={width},900",
            "--virtual-time-budget=30000", "--dump-dom", page.as_uri(),
        ],
        capture_output=True, text=True, timeout=180, check=True, stdin=subprocess.DEVNULL,
    )  # fmt: skip
    return done.stdout, [line for line in done.stderr.splitlines() if "CONSOLE" in line]


def drawn_sizes(document: str) -> dict[str, tuple[float, float]]:
    """Return width and height of the drawing in each place for a plot."""
    places = re.split(r'<div class="plot[^"]*" id="(plot\d+)"', document)[1:]
    sizes = {}
    for name, rest in zip(places[::2], places[1::2], strict=True):
        drawing = re.search(r'<svg class="main-svg"[^>]*? width="([\d.]+)" height="([\d.]+)"', rest)
        sizes[name] = (float(drawing[1]), float(drawing[2])) if drawing else (0.0, 0.0)
    return sizes


@pytest.mark.parametrize("width", [1280, 500])
def test_every_plot_is_drawn_and_the_console_is_silent(browser: str, tmp_path: Path, width: int) -> None:
    page = tmp_path / "report.html"
    page.write_text(render(synthetic_result()), encoding="utf-8")
    document, console = visit(browser, page, tmp_path / "profile", width)
    assert console == []
    assert 'data-drawn="yes"' in document
    sizes = drawn_sizes(document)
    assert len(sizes) == page.read_text(encoding="utf-8").count('<div class="plot"')
    assert len(sizes) >= 14
    for name, (wide, high) in sizes.items():
        assert 250 <= wide <= width, name
        assert high >= 100, name
    assert document.count("scatterlayer") > 20


def test_text_from_a_log_runs_nothing(browser: str, tmp_path: Path) -> None:
    result = synthetic_result()
    run = replace(result.run, sensors=(ATTACK, *result.run.sensors[1:]))
    hostile = replace(
        result,
        flight=ATTACK,
        run=run,
        problems=(ATTACK,),
        config_text=ATTACK,
        metadata={ATTACK: {ATTACK: ATTACK}},
        messages=(LogMessage(result.start_ns, 50, ATTACK, ATTACK),),
    )
    page = tmp_path / "report.html"
    page.write_text(render(hostile), encoding="utf-8")
    document, console = visit(browser, page, tmp_path / "profile")
    assert console == []
    assert 'data-drawn="yes"' in document
    title = re.search(r"<title>(.*?)</title>", document, re.S)
    assert title is not None
    assert title[1].startswith("&lt;/script&gt;")
    assert "<img" not in document
