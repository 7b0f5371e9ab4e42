"""Every command and every Python example of the README and the guides is run, on small files of the names they use.

Commands that follow each other on a page run in one folder, as they stand, so that one takes what another made. What
cannot be run here is listed with the reason, and at least its options are parsed.
"""

from __future__ import annotations

import importlib.util
import itertools
import re
import shlex
import tomllib
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
from documented import FILES, imaged_log, plain_log, provide

from deckfix.cli import deckfix as program
from deckfix.cli import main
from vision import RingTarget

ROOT = Path(__file__).parents[2]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
PROGRAMS = ("deckfix", "make", "pip", "dask", ".", "rerun", "ros2")

IMPORT_ULG = "deckfix import log_42.ulg"
NOT_RUN = {
    "make test": "it is what runs this",
    "pip install": "needs a package registry; that the extras exist is checked",
    ". .venv/bin/activate": "changes the reader's shell",
    "dask": "a cluster; tests/unit/test_fleet.py has one",
    "deckfix fleet logs/ -o results/ --scheduler": "a cluster; tests/unit/test_fleet.py has one",
    "deckfix onboard": "flies until it is stopped; tests/faults/test_onboard_faults.py starts it",
    "deckfix simulate landing_beaufort2_2026_11 --serve": "waits; tests/unit/test_served_vehicle.py has both",
    "deckfix tune": "takes minutes; tests/unit/test_tune.py runs it on small flights",
}
"""Beginning of a command, and why it is not run."""
SPECIAL = {"video.md": {"flight.mcap": imaged_log}, "add-a-sensor.md": {"flight.mcap": plain_log}}
"""Files that a page means something else by."""


def commands(text: str) -> Iterator[str]:
    """Yield the commands of a page: indented lines, outside fenced blocks, that begin with a program."""
    for line in re.sub(r"```.*?```", "", text, flags=re.S).split("\n"):
        found = re.match(r"(?: {4}| {8})(?:\.venv/bin/)?(\S+)( .*)?$", line)
        if found and found[1] in PROGRAMS:
            yield " ".join(shlex.split(f"{found[1]}{found[2] or ''}", comments=True))


ALL = [(page, command) for page in PAGES for command in commands(page.read_text(encoding="utf-8"))]


def reason(command: str) -> str | None:
    return next((why for begin, why in NOT_RUN.items() if command.startswith(begin)), None)


def parsed(command: str) -> click.Context:
    """Return a deckfix command line as click understands it."""
    name, *arguments = shlex.split(command)[1:]
    return program.commands[name].make_context(name, arguments)


def outputs(command: str) -> set[str]:
    words = shlex.split(command)
    return {
        b
        for a, b in itertools.pairwise(words)
        if a in ("-o", "--output", "--write", "--report", "--json") and b != "-"
    }


def expanded(words: list[str], folder: Path) -> list[str]:
    out = []
    for word in words:
        found = sorted(str(p.relative_to(folder)) for p in folder.glob(word)) if "*" in word else []
        out += found or [word]
    return out


def run(command: str, folder: Path, special: dict, capfd: pytest.CaptureFixture[str]) -> None:
    words = shlex.split(command)
    used = {w.split("/")[0] for w in words} - outputs(command)
    provide(folder, used, special)
    status = main(expanded(words[1:], folder))
    said = capfd.readouterr()
    assert status == 0, f"{command}\n{said.out}{said.err}"
    for written in outputs(command):
        assert (folder / written).exists(), f"{command} did not write {written}"


def toml_files(text: str) -> Iterator[tuple[str, str]]:
    """Yield name and content of the files that a page shows: blocks whose first line is ``# NAME.toml``."""
    for block in re.findall(r"```toml\n(# [\w-]+\.toml\n.*?)```", text, re.S):
        yield block.split("\n")[0][2:], block


@pytest.mark.parametrize("page", [p for p in PAGES if any(q == p for q, _ in ALL)], ids=lambda p: p.name)
def test_the_commands_of_a_page_run(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    text = page.read_text(encoding="utf-8")
    for name, content in toml_files(text):
        (tmp_path / name).write_text(content, encoding="utf-8")
    left = []
    for command in commands(text):
        why = reason(command)
        if why is not None:
            left.append(f"{command}: {why}")
        elif command.startswith(IMPORT_ULG):
            left += ulog(command, tmp_path, capfd)
        elif not command.startswith("make "):
            run(command, tmp_path, SPECIAL.get(page.name, {}), capfd)
    with capfd.disabled():
        for line in left:
            print(f"\nnot run: {line}", end="")


def made_by_make() -> list[str]:
    """Return the deckfix commands of the Makefile's targets that the pages show."""
    targets = sorted({c.split()[1] for _, c in ALL if c.startswith("make ") and reason(c) is None})
    return [command for target in targets for command in recipe(target)]


def test_the_recipes_of_the_makefile_parse() -> None:
    assert made_by_make() == ["deckfix demo -o demo --force"]
    parsed(made_by_make()[0])


@pytest.mark.nightly
def test_the_recipes_of_the_makefile_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """The demo flies a whole landing on rendered pictures, which takes more than a minute."""
    monkeypatch.chdir(tmp_path)
    for command in made_by_make():
        run(command, tmp_path, {}, capfd)
    assert (tmp_path / "demo" / "report.html").stat().st_size > 1_000_000


def ulog(command: str, folder: Path, capfd: pytest.CaptureFixture[str]) -> list[str]:
    """Run an import of a PX4 log where there is one, and pyulog; else return why not."""
    beside = ROOT.parent / "shared" / "data" / "ulog" / "sample_log_small.ulg"
    if importlib.util.find_spec("pyulog") is None or not beside.exists():
        return [f"{command}: needs pyulog and a recorded .ulg"]
    (folder / "log_42.ulg").write_bytes(beside.read_bytes())
    run(command, folder, {}, capfd)
    return []


def recipe(target: str) -> list[str]:
    """Return the deckfix commands of a Makefile's target."""
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    (body,) = re.findall(rf"^{target}:.*\n((?:\t.*\n)+)", makefile, re.M)
    found = re.findall(r"\t\$\(BIN\)/(deckfix .*)\n", body)
    assert found, f"make {target}: its recipe is not run; list it in NOT_RUN with the reason"
    return found


def test_what_is_not_run_is_still_shown_and_parses() -> None:
    for begin in NOT_RUN:
        shown = [command for _, command in ALL if command.startswith(begin)]
        assert shown, f"{begin!r} is shown nowhere any more"
        for command in shown:
            if command.startswith("deckfix "):
                parsed(command)


def test_extras_that_are_installed_exist() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    shown = [
        n
        for p in PAGES
        for n in re.findall(r"(?:-e \"\.|'?deckfix)\[([\w,]+)\]", p.read_text(encoding="utf-8"))
    ]
    assert shown
    assert {name for names in shown for name in names.split(",")} <= set(extras)


def test_the_target_shown_is_one() -> None:
    text = (ROOT / "docs" / "target.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"^    # target\.toml\n((?:    .*\n)+)", text, re.M)
    assert RingTarget.from_toml(re.sub(r"^ {4}", "", block, flags=re.M)).name == "raft 2"


def python_blocks(page: Path) -> list[str]:
    return re.findall(r"```python\n(.*?)```", page.read_text(encoding="utf-8"), re.S)


@pytest.mark.parametrize("page", [p for p in PAGES if python_blocks(p)], ids=lambda p: p.name)
def test_the_python_of_a_page_runs(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plotly = pytest.importorskip("plotly.graph_objects")
    shown: list[object] = []
    monkeypatch.setattr(plotly.Figure, "show", lambda figure: shown.append(figure))  # noqa: PLW0108 (a builtin is no method)
    monkeypatch.chdir(tmp_path)
    text = page.read_text(encoding="utf-8")
    for name, content in toml_files(text):
        (tmp_path / name).write_text(content, encoding="utf-8")
    blocks = python_blocks(page)
    provide(
        tmp_path,
        {name for name in FILES if any(f'"{name}"' in b for b in blocks)},
        SPECIAL.get(page.name, {}),
    )
    if any("to_pandas" in b for b in blocks):
        pytest.importorskip("pandas", reason="Result.to_pandas needs pandas")
    if any("import rerun" in b for b in blocks):
        pytest.importorskip("rerun", reason="rerun-sdk is not a part of deckfix")
    names: dict[str, object] = {}
    for block in blocks:
        exec(compile(block, page.name, "exec"), names)
    assert len(shown) == sum(block.count(".show()") for block in blocks)
