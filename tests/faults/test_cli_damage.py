"""Every command on damaged logs: an answer or one line, never a traceback, and no half-written file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_flight import small_log

from deckfix.cli import main


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_log(tmp_path_factory.mktemp("logs") / "flight.mcap", seconds=4.0)


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Return the bytes with some flipped, a part cut out, or the end missing."""
    out = np.frombuffer(data, dtype=np.uint8).copy()
    kind = rng.integers(3)
    if kind == 0:
        places = rng.integers(8, len(out), size=int(rng.integers(1, 30)))
        out[places] ^= np.left_shift(1, rng.integers(0, 8, size=len(places))).astype(np.uint8)
    elif kind == 1:
        start = int(rng.integers(8, len(out)))
        out = np.delete(out, slice(start, start + int(rng.integers(1, 5000))))
    else:
        out = out[: int(rng.integers(9, len(out)))]
    return out.tobytes()


@pytest.mark.parametrize("seed", range(12))
def test_commands_survive_damage(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, log: Path, seed: int
) -> None:
    path = tmp_path / "damaged.mcap"
    path.write_bytes(damaged(log.read_bytes(), np.random.default_rng(seed)))
    page, whole, estimate = (str(tmp_path / n) for n in ("r.html", "whole.mcap", "e.mcap"))
    for arguments in (
        ["info", str(path)],
        ["replay", str(path), "-o", estimate, "--engine", "filterpy"],
        ["report", str(path), "-o", page, "--engine", "filterpy"],
        ["export", str(path), "-o", str(tmp_path / "tables"), "--format", "npz"],
        ["recover", str(path), "-o", whole],
    ):
        code = main(arguments)
        out, err = capsys.readouterr()
        assert code in (0, 1), arguments
        assert "internal error" not in err, err
        if code:
            assert err.startswith("deckfix: ")
            assert err.count("\n") == 1
            assert str(tmp_path) in err
        else:
            assert out
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".")]
    if Path(whole).exists():
        assert main(["info", whole]) == 0
        capsys.readouterr()


def test_extreme_values_are_reported_not_raised(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    from small_flight import small_recording

    from logs.writer import FlightWriter

    rng = np.random.default_rng(5)
    recording = small_recording(8.0)
    for series in recording.series:
        for name in series.data.dtype.names or ():
            column = series.data[name].reshape(len(series), -1)
            if column.dtype.kind == "f":
                rows = rng.integers(0, len(series), size=max(1, len(series) // 50))
                column[rows] = rng.choice([np.nan, np.inf, -np.inf, 5e-324], size=(len(rows), 1))
    path = tmp_path / "wild.mcap"
    with FlightWriter(path) as writer:
        writer.write_recording(recording)
    arguments = ["replay", str(path), "--report", str(tmp_path / "r.html"), "--engine", "filterpy"]
    arguments += ["--json", str(tmp_path / "s.json")]
    assert main(arguments) == 0, capsys.readouterr().err
    assert "REJECTED_NOT_FINITE" in (tmp_path / "s.json").read_text()
    assert "NaN" not in (tmp_path / "s.json").read_text()
