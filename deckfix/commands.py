"""The commands ``replay`` and ``report``: from a log to files and to the text that the user reads."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from deckfix.files import check_output, existing, output_file
from deckfix.terminal import printable, working

if TYPE_CHECKING:
    from deckfix.result import Result
    from estimation.estimator import EngineName


def replay_command(
    file: str,
    *,
    output: str | None,
    report: str | None,
    json_path: str | None,
    config: str | None,
    engine: str,
    check: bool,
    force: bool,
    smooth: bool = False,
    images: bool | None = None,
    jobs: int | None = None,
) -> tuple[str, bool]:
    """Replay a log, write what was asked for, and return the text to show and whether the check held."""
    from deckfix.replaying import replay

    existing(file)
    inputs = [file, *([config] if config else [])]
    to_stdout = json_path == "-"
    written = [p for p in (output, report, None if to_stdout else json_path) if p]
    for path in written:
        check_output(path, force=force, inputs=inputs)
    _distinct(written)
    with working(f"replaying {Path(file).name}"):
        result = replay(file, config, cast("EngineName", engine), smooth=smooth, images=images, jobs=jobs)
    if output:
        result.write(output, force=force, inputs=inputs)
    if report:
        write_text(report, result.report(), force=force, inputs=inputs)
    document = json.dumps(finite(result.summary()), indent=1) + "\n"
    if json_path and not to_stdout:
        write_text(json_path, document, force=force, inputs=inputs)
    equal, verdict = True, list[str]()
    if check:
        from deckfix.check import check_replay

        with working("checking"):
            equal, verdict = check_replay(result, config, cast("EngineName", engine), jobs)
    if to_stdout:
        return document.rstrip("\n"), equal
    lines = [digest(result), *verdict, *(f"wrote {p}" for p in written)]
    return "\n".join(lines), equal


def report_command(file: str, output: str, *, engine: str = "auto", force: bool = False) -> str:
    """Write the report of a log, replaying it with its own configuration, and return the text to show."""
    from deckfix.replaying import replay

    existing(file)
    check_output(output, force=force, inputs=[file])
    with working(f"replaying {Path(file).name}"):
        result = replay(file, engine=cast("EngineName", engine))
    write_text(output, result.report(), force=force, inputs=[file])
    return f"{digest(result)}\nwrote {output}"


def write_text(path: str | Path, text: str, *, force: bool, inputs: list[str] | None = None) -> None:
    """Write a text file whole or not at all."""
    with output_file(path, force=force, inputs=inputs or []) as partial:
        partial.write_text(text, encoding="utf-8")


def finite(value: Any) -> Any:
    """Return a JSON document with null where a number is not finite, and NumPy numbers as Python's."""
    if isinstance(value, dict):
        return {str(k): finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [finite(v) for v in value]
    if isinstance(value, float | np.floating):
        return float(value) if np.isfinite(value) else None
    return int(value) if isinstance(value, np.integer) else value


def digest(result: Result) -> str:
    """Return a result in a few lines of plain text."""
    from deckfix.finding import Severity
    from deckfix.findings import findings, verdict
    from estimation.outcome import Outcome

    found = findings(result)
    n, records = len(result.run.t_ns), result.tried
    fused = int(np.count_nonzero(records["outcome"] <= int(Outcome.DOWNWEIGHTED)))
    lines = [
        f"{result.flight}: {result.duration_s:.1f} s, {n} estimates, "
        f"{fused} of {len(records)} measurements fused ({result.run.engine}, {result.wall_s:.2f} s)",
        verdict(result, found),
    ]
    if result.images is not None:
        lines.append(f"  {result.images.sentence()}")
    lines += [
        f"  {f.severity.name.lower()}: {f.symptom} ({f.remedy})" for f in found if f.severity > Severity.NOTE
    ]
    summary = result.summary()
    truth = summary.get("truth", {}).get("odometry", {})
    for key, unit in (("position_rmse_m", "m"), ("velocity_rmse_mps", "m/s"), ("attitude_rmse_deg", "deg")):
        if key in truth:
            values = ", ".join(f"{v:.3f}" for v in truth[key])
            axes = "roll, pitch, yaw" if key.startswith("attitude") else "north, east, down"
            lines.append(f"  rms error of {key.split('_')[0]} ({axes}): {values} {unit}")
    if "ratio" in summary:
        ratios = ", ".join(
            f"{k.replace('_', ' ')} {v:.2f}" for k, v in summary["ratio"].items() if _is_ratio(k)
        )
        lines.append(f"  over the autopilot's own: {ratios}")
    return "\n".join(printable(line) for line in lines)


def _is_ratio(key: str) -> bool:
    return key not in ("window_s", "contact_s")


def _distinct(paths: list[str]) -> None:
    from deckfix.files import OutputError

    places = [Path(p).resolve() for p in paths]
    for i, place in enumerate(places):
        if place in places[:i]:
            raise OutputError(f"{paths[i]}: is named for two outputs; give each its own file")
