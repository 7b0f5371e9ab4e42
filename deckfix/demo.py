"""The command ``demo``: a simulated landing, replayed, with its report; needs no data."""

from __future__ import annotations

from pathlib import Path

from deckfix.commands import digest, write_text
from deckfix.files import OutputError, check_output
from deckfix.progress import working

SCENARIO = "landing_2026_06"
FLIGHT, REPLAY, REPORT = "flight.mcap", "replay.mcap", "report.html"


def run_demo(folder: str | Path, *, seed: int = 1, force: bool = False) -> str:
    """Simulate a landing on a heaving platform, replay it, write its report, and return the text to show.

    Writes ``flight.mcap``, ``replay.mcap`` and ``report.html`` into the folder, which is made where it is
    missing. The same seed gives the same estimates. Raises ``deckfix.files.OutputError`` where a file
    exists and ``force`` is not set, or the folder cannot be made.
    """
    from deckfix.replaying import replay
    from logs.writer import FlightWriter
    from simulation.flight import load_scenario, simulate

    place = _folder(folder)
    paths = [place / name for name in (FLIGHT, REPLAY, REPORT)]
    for path in paths:
        check_output(path, force=force)
    scenario = load_scenario(SCENARIO)
    with working("simulating"):
        flight = simulate(scenario, seed)
        with FlightWriter(paths[0], force=force) as writer:
            writer.write_recording(flight.recording())
    with working("replaying"):
        result = replay(paths[0])
        result.write(paths[1], force=force, inputs=[str(paths[0])])
    with working("writing the report"):
        write_text(paths[2], result.report(), force=force, inputs=[str(p) for p in paths[:2]])
    plan, sea = flight.trajectory.plan, flight.trajectory.platform.sea
    return "\n".join(
        [
            f"simulated: {scenario.description}",
            f"  {plan.duration_s:.0f} s, significant wave height {sea.significant_height_m:.2f} m, seed {seed}, "
            f"{len(flight.batch)} sensor messages",
            digest(result),
            f"  the flight:    {paths[0]}",
            f"  its replay:    {paths[1]}",
            f"  the report:    {paths[2]} (open it in a browser)",
        ]
    )


def _folder(folder: str | Path) -> Path:
    place = Path(folder)
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        reason = (error.strerror or type(error).__name__).lower()
        raise OutputError(f"{place}: cannot be made a folder ({reason}); give another") from None
    return place
