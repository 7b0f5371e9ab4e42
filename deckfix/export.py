"""``deckfix export``: the numeric topics of a log as tables."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from deckfix.files import InputError, check_output, existing, output_file, output_folder
from deckfix.terminal import tracked, working

if TYPE_CHECKING:
    from logs.reader import Flight
    from logs.recording import Series

FORMATS = ("csv", "npz", "parquet")


def export_flight(
    file: str | Path,
    folder: str | Path,
    *,
    kind: str = "csv",
    topics: Sequence[str] = (),
    force: bool = False,
) -> str:
    """Write each numeric topic of a log to a file in ``folder``, and return what there is to say.

    Raises ``InputError`` for a topic that is not in the log, ``OutputError`` for files that may not be
    written.
    """
    from logs.reader import open_flight

    if kind not in FORMATS:
        raise InputError(f"{kind}: no such format; use csv, npz or parquet")
    if kind == "parquet":
        _need_pyarrow()
    place, target = existing(file), Path(folder)
    with working(f"reading {place.name}"):
        flight = open_flight(place)
    missing = [t for t in topics if t not in flight.topics]
    if missing:
        present = ", ".join(sorted(flight.topics)) or "none"
        raise InputError(f"{place}: has no topic {missing[0]}; it has {present}")
    output_folder(target)
    wanted = list(topics) or sorted(flight.topics)
    said, skipped = [], []
    for topic in tracked(wanted, "exporting", len(wanted)):
        tables = _tables(flight, topic)
        if tables is None:
            skipped.append(topic)
            continue
        names = _names(topic, tables)
        for name, series in zip(names, tables, strict=True):
            path = target / f"{name}.{kind}"
            check_output(path, force=force, inputs=[place])
            with output_file(path, force=force, inputs=[place]) as partial:
                _WRITERS[kind](partial, columns(series))
            said.append(f"wrote {path} ({len(series):,} rows)")
    if skipped:
        said.append(f"no tables for {', '.join(skipped)}: they hold images or text")
    return "\n".join(said) if said else "nothing to write: the log has no numeric topics"


def columns(series: Series) -> dict[str, NDArray[Any]]:
    """Return a series as flat columns: stamp and arrival, then each field, arrays as ``name_0``,
    ``name_1``...
    """
    out: dict[str, NDArray[Any]] = {"stamp_ns": series.stamp_ns, "arrival_ns": series.arrival_ns}
    for name in series.data.dtype.names or ():
        values = series.data[name]
        if values.ndim == 1:
            out[name] = values
            continue
        flat = values.reshape(len(values), -1)
        labels = _labels(name, flat.shape[1], series.strings)
        for i, text in enumerate(labels):
            out[text] = flat[:, i]
    return out


def _labels(name: str, size: int, strings: dict[str, str]) -> list[str]:
    """Return the columns' names: the states' own where the message lists them."""
    own = [strings.get(f"names_{i}") for i in range(size)]
    if name in ("values", "sigmas") and all(own):
        return [f"{name[:-1]} {text}" for text in own]
    axes = {3: "xyz", 4: "xyzw"}.get(size)
    return [f"{name}_{axes[i] if axes else i}" for i in range(size)]


def _tables(flight: Flight, topic: str) -> list[Series] | None:
    from logs.errors import LogError

    try:
        series = [s for s in flight.series(topic) if len(s)]
    except LogError:
        return None
    return series or None


def _names(topic: str, series: list[Series]) -> list[str]:
    """Return a file name for each series of a topic: the topic's, and a sensor or number where there are
    several.
    """
    base = _safe(topic.strip("/").replace("/", "_")) or "topic"
    if len(series) == 1:
        return [base]
    out: list[str] = []
    for i, s in enumerate(series):
        text = s.strings.get("sensor") or s.metadata.get("sensor")
        name = f"{base}_{_safe(text)}" if text else f"{base}_{i}"
        out.append(name if name not in out else f"{name}_{i}")
    return out


def _safe(text: str) -> str:
    return "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "_" for c in text)[:100]


def _need_pyarrow() -> None:
    try:
        import pyarrow  # noqa: F401
    except ImportError:
        raise ImportError("parquet: needs pyarrow; install it with pip install pyarrow, or use npz") from None


def _write_csv(path: Path, table: dict[str, NDArray[Any]]) -> None:
    with path.open("w", encoding="utf-8", newline="") as out:
        out.write(",".join(table) + "\n")
        texts = [_texts(values) for values in table.values()]
        for row in zip(*texts, strict=True):
            out.write(",".join(row) + "\n")


def _texts(values: NDArray[Any]) -> list[str]:
    """Return numbers as text that reads back to the same bits."""
    if values.dtype == np.float32:
        return [str(v) for v in values]
    return [repr(v) for v in values.tolist()]


def _write_npz(path: Path, table: dict[str, NDArray[Any]]) -> None:
    with path.open("wb") as out:
        np.savez_compressed(out, allow_pickle=False, **table)


def _write_parquet(path: Path, table: dict[str, NDArray[Any]]) -> None:
    import pyarrow
    import pyarrow.parquet

    arrays = {name: np.ascontiguousarray(values) for name, values in table.items()}
    pyarrow.parquet.write_table(pyarrow.table(arrays), path)


_WRITERS = {"csv": _write_csv, "npz": _write_npz, "parquet": _write_parquet}
