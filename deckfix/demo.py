"""The commands ``simulate`` and ``demo``: a flight from nothing but a scenario and a seed."""

from __future__ import annotations

from pathlib import Path

from deckfix.commands import digest, write_text
from deckfix.files import check_output, output_file, output_folder
from deckfix.terminal import working

DEMO_SCENARIO = "landing_2026_06"


def simulate_flight(
    scenario: str, output: str | Path, *, seed: int | None = None, force: bool = False
) -> str:
    """Write the log of a simulated flight, and return what there is to say.

    ``scenario`` is the name of one that comes with the product, or the path of a TOML file. Raises
    ``estimation.config.ConfigError`` for the scenario, ``deckfix.files.OutputError`` for the output.
    """
    from logs.writer import FlightWriter
    from simulation.flight import load_scenario, simulate

    inputs = [scenario] if scenario.endswith(".toml") else []
    with output_file(output, force=force, inputs=inputs) as partial:
        with working(f"simulating {scenario}"):
            flight = simulate(load_scenario(scenario), seed)
            recording = flight.recording()
        with working(f"writing {Path(output).name}"), FlightWriter(partial, force=True) as writer:
            writer.write_recording(recording)
    return f"wrote {output}: {flight.scenario.description} ({len(flight.batch):,} events, seed {flight.seed})"


def run_demo(folder: str | Path, *, seed: int = 1, force: bool = False) -> str:
    """Simulate a landing, replay it, write log, estimates and report to a folder, and say where they are.

    The reference engine is used: it starts at once, whereas the compiled one is compiled at its first use.
    """
    from deckfix.replaying import replay

    target = output_folder(folder)
    log, estimate, page = (target / name for name in ("flight.mcap", "estimate.mcap", "report.html"))
    for path in (log, estimate, page):
        check_output(path, force=force)
    said = [simulate_flight(DEMO_SCENARIO, log, seed=seed, force=force)]
    with working("replaying"):
        result = replay(log, engine="filterpy")
    result.write(estimate, force=force)
    write_text(page, result.report(), force=force)
    said += [digest(result), f"wrote {estimate}", f"wrote {page}: open it in a browser"]
    return "\n".join(said)
