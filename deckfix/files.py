"""Output files: written beside their place and moved there when they are whole, never over another by
accident.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any


class OutputError(ValueError):
    """An output cannot be written; the message reads ``FILE: what is wrong; what to do``."""


class InputError(ValueError):
    """An input cannot be used; the message reads ``FILE: what is wrong; what to do``."""


def existing(path: str | Path) -> Path:
    """Return the path of a readable file; raises ``InputError`` where there is none."""
    given = Path(path)
    if given.is_dir():
        raise InputError(f"{path}: is a folder; give a file")
    if not given.exists():
        raise InputError(f"{path}: no such file; check the path")
    if not os.access(given, os.R_OK):
        raise InputError(f"{path}: cannot be read; check its permissions")
    return given


def loaded(kind: Any, path: str | Path) -> Any:
    """Return ``kind.load(path)`` (a camera, a target) with its error as ``InputError``."""
    try:
        return kind.load(existing(path))
    except InputError:
        raise
    except ValueError as error:
        raise InputError(str(error)) from error


def check_output(path: str | Path, *, force: bool, inputs: Sequence[str | Path] = ()) -> Path:
    """Return the path of an output that may be written.

    Raises ``OutputError`` where it exists and ``force`` is not set, is one of the inputs, or has no folder.
    """
    target = Path(path)
    if target.is_dir():
        raise OutputError(f"{path}: is a folder; give the name of a file")
    if not target.parent.is_dir():
        raise OutputError(f"{path}: the folder {target.parent} does not exist; create it first")
    for given in inputs:
        if target.exists() and Path(given).exists() and target.samefile(given):
            raise OutputError(f"{path}: is also an input; write to another file")
    if target.exists() and not force:
        raise OutputError(f"{path}: exists already; use --force to overwrite it")
    if not os.access(target.parent, os.W_OK):
        raise OutputError(f"{path}: the folder cannot be written to; choose another")
    return target


def output_folder(path: str | Path) -> Path:
    """Return a folder to write to, made where it is missing; raises ``OutputError`` where it cannot be."""
    folder = Path(path)
    if folder.exists() and not folder.is_dir():
        raise OutputError(f"{folder}: is a file; give a folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder}: cannot be created ({error.strerror}); choose another") from None
    return folder


@contextmanager
def output_file(
    path: str | Path, *, force: bool = False, inputs: Sequence[str | Path] = ()
) -> Iterator[Path]:
    """Give a temporary path beside ``path``; it takes its place when the block ends well, else it is
    removed.

    Raises ``OutputError`` as ``check_output`` does, before the block is entered; without ``force`` a file
    that has appeared meanwhile is not overwritten either.
    """
    target = check_output(path, force=force, inputs=inputs)
    partial = target.with_name(f".{target.stem}.{os.getpid()}.partial{target.suffix}")
    try:
        yield partial
        if force:
            partial.replace(target)
        else:
            _move_to_free_place(partial, target)
    finally:
        partial.unlink(missing_ok=True)


def _move_to_free_place(partial: Path, target: Path) -> None:
    try:
        os.link(partial, target)
    except FileExistsError:
        raise OutputError(f"{target}: exists already; use --force to overwrite it") from None
    except OSError:
        # The file system has no hard links.
        if target.exists():
            raise OutputError(f"{target}: exists already; use --force to overwrite it") from None
        partial.replace(target)
