"""How fast .BIN logs are decoded and imported, against pymavlink's DFReader in the same process.

Per file and trial, in turn: DFReader reads every message; ``logs.dataflash`` decodes every message into
columns; ``logs.importer`` imports the log and ``logs.writer`` writes it as MCAP. Times are CPU seconds of
this process.

    python benchmarks/import_speed.py [FILES] [--trials N] [--json OUT]
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from targets import Target, Targets, provenance

from logs.dataflash import read_dataflash
from logs.importer import import_files
from logs.writer import FlightWriter

DECODE_TARGET = 5.0
IMPORT_TARGET = 1.0


def default_files() -> list[Path]:
    """Return the flights of the real data, where it is there."""
    folder = Path(os.environ.get("DECKFIX_DATA") or Path(__file__).parents[2] / "shared" / "data")
    return sorted((folder / "ardupilot_sitl").glob("*.BIN"))


def read_with_pymavlink(path: Path) -> int:
    """Return the number of messages that DFReader hands out (their fields are not even scaled yet)."""
    from pymavlink.DFReader import DFReader_binary

    reader = DFReader_binary(str(path))
    count = 0
    while reader.recv_msg() is not None:
        count += 1
    reader.filehandle.close()
    return count


def import_and_write(path: Path) -> int:
    """Return the size [bytes] of the MCAP file that the import made."""
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "flight.mcap"
        with FlightWriter(target) as writer:
            writer.write_recording(import_files([path]))
        return target.stat().st_size


def timed(call: Callable[[Path], int], path: Path) -> tuple[float, int]:
    """Return the CPU time [s] of a call and what it returned."""
    start = time.process_time()
    value = call(path)
    return time.process_time() - start, value


def measure(path: Path, trials: int) -> dict[str, Any]:
    """Return one file's row: medians [s], the ratios of the trials (smallest, median, largest) and counts."""
    rows = []
    for _ in range(trials):
        pymavlink_s, theirs = timed(read_with_pymavlink, path)
        decode_s, ours = timed(lambda p: read_dataflash(p).count(), path)
        import_s, size = timed(import_and_write, path)
        if ours != theirs:
            raise SystemExit(f"{path}: {ours} messages decoded, pymavlink {theirs}")
        rows.append((pymavlink_s, decode_s, import_s))
    decode = sorted(p / d for p, d, _ in rows)
    whole = sorted(i / p for p, _, i in rows)
    return {
        "file": path.name,
        "megabytes": path.stat().st_size / 1e6,
        "messages": ours,
        "mcap_megabytes": size / 1e6,
        "trials": trials,
        "pymavlink_s": statistics.median(p for p, _, _ in rows),
        "decode_s": statistics.median(d for _, d, _ in rows),
        "import_s": statistics.median(i for _, _, i in rows),
        "decode_speedup": [decode[0], statistics.median(decode), decode[-1]],
        "import_over_pymavlink": [whole[0], statistics.median(whole), whole[-1]],
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table and return 0 when the targets are met, else 1."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", nargs="*", type=Path)
    parser.add_argument("--trials", type=int, default=5)
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(arguments)
    files = options.files or default_files()
    if not files:
        parser.error("no .BIN file: name some, or set DECKFIX_DATA")
    read_with_pymavlink(files[0])  # imports and caches
    import_and_write(files[0])
    rows = [measure(f, options.trials) for f in files]
    print(f"{'file':14} {'MB':>6} {'messages':>9} {'DFReader s':>11} {'decode s':>9} {'import s':>9} "
          f"{'decode x (min..max)':>22} {'import/DFReader':>17}")  # fmt: skip
    targets = Targets()
    for row in rows:
        low, middle, high = row["decode_speedup"]
        share = row["import_over_pymavlink"][1]
        print(f"{row['file']:14} {row['megabytes']:6.1f} {row['messages']:9d} {row['pymavlink_s']:11.3f} "
              f"{row['decode_s']:9.3f} {row['import_s']:9.3f} {middle:8.1f} ({low:.1f}..{high:.1f}) "
              f"{share:12.3f}")  # fmt: skip
        name = f"{row['file']}: decoding, DFReader over ours"
        targets.add(Target(name, middle, DECODE_TARGET, at_least=True, spread=high - low))
        first, _, last = row["import_over_pymavlink"]
        targets.add(Target(f"{row['file']}: import over DFReader", share, IMPORT_TARGET, spread=last - first))
    good = targets.report()
    if options.json:
        report = {
            "benchmark": "import_speed",
            **provenance(),
            "pymavlink": version("pymavlink"),
            "files": rows,
            "targets": targets.as_rows(),
        }
        options.json.write_text(json.dumps(report, indent=1) + "\n")
    return 0 if good else 1


if __name__ == "__main__":
    raise SystemExit(main())
