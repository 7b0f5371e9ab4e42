"""Output files: whole or not at all, and never over another by accident."""

from __future__ import annotations

from pathlib import Path

import pytest

from deckfix.files import InputError, OutputError, check_output, existing, output_file


def test_a_file_appears_when_the_block_ends(tmp_path: Path) -> None:
    target = tmp_path / "a.mcap"
    with output_file(target) as partial:
        partial.write_text("whole")
        assert not target.exists()
        assert partial.suffix == ".mcap"
    assert target.read_text() == "whole"
    assert list(tmp_path.iterdir()) == [target]


def test_nothing_is_left_after_an_error(tmp_path: Path) -> None:
    target = tmp_path / "a.mcap"
    target.write_text("old")
    with pytest.raises(KeyboardInterrupt), output_file(target, force=True) as partial:
        partial.write_text("half")
        raise KeyboardInterrupt
    assert target.read_text() == "old"
    assert list(tmp_path.iterdir()) == [target]


def test_an_existing_file_needs_force(tmp_path: Path) -> None:
    target = tmp_path / "a"
    target.write_text("old")
    with pytest.raises(OutputError, match="exists already; use --force"), output_file(target):
        pytest.fail("the block must not be entered")
    with output_file(target, force=True) as partial:
        partial.write_text("new")
    assert target.read_text() == "new"


def test_a_file_that_appears_meanwhile_is_kept(tmp_path: Path) -> None:
    target = tmp_path / "a"
    with pytest.raises(OutputError, match="exists already"), output_file(target) as partial:
        partial.write_text("mine")
        target.write_text("another's")
    assert target.read_text() == "another's"
    assert list(tmp_path.iterdir()) == [target]


def test_an_input_is_never_an_output(tmp_path: Path) -> None:
    source = tmp_path / "in.mcap"
    source.write_text("data")
    (tmp_path / "sub").mkdir()
    for name in (source, tmp_path / "sub" / ".." / "in.mcap"):
        with pytest.raises(OutputError, match="is also an input"):
            check_output(name, force=True, inputs=[source])


def test_folders_and_missing_folders_are_refused(tmp_path: Path) -> None:
    with pytest.raises(OutputError, match="is a folder"):
        check_output(tmp_path, force=True)
    with pytest.raises(OutputError, match="does not exist; create it"):
        check_output(tmp_path / "none" / "a", force=True)
    with pytest.raises(InputError, match="no such file"):
        existing(tmp_path / "none")
    with pytest.raises(InputError, match="is a folder"):
        existing(tmp_path)
