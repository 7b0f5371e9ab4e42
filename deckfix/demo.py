"""The commands ``simulate`` and ``demo``: a flight from nothing but a scenario and a seed.

The demo is the whole loop: a landing flown from the search to the deck on what the pipeline sees in rendered pictures,
its log, the replay of that, and the report.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from deckfix.commands import digest, write_text
from deckfix.files import check_output, output_file, output_folder
from deckfix.terminal import working
from estimation.config import ConfigError

if TYPE_CHECKING:
    from logs.recording import Recording
    from simulation.world import Flown

DEMO_MISSION = "landing_beaufort2_2026_11"


def simulate_flight(
    scenario: str, output: str | Path, *, seed: int | None = None, force: bool = False
) -> str:
    """Write the log of a simulated flight, and return what there is to say.

    ``scenario`` is the name of a scenario or of a mission (flown in a closed loop) that comes with the product, or the
    path of a TOML file of either kind. Raises ``estimation.config.ConfigError`` for the scenario,
    ``deckfix.files.OutputError`` for the output.
    """
    from logs.writer import FlightWriter

    inputs = [scenario] if scenario.endswith(".toml") else []
    with output_file(output, force=force, inputs=inputs) as partial:
        with working(f"simulating {scenario}"):
            recording, said = _simulated(scenario, seed)
        with working(f"writing {Path(output).name}"), FlightWriter(partial, force=True) as writer:
            writer.write_recording(recording)
    return f"wrote {output}: {said}"


def _simulated(scenario: str, seed: int | None) -> tuple[Recording, str]:
    """Simulate a scenario or fly a mission; return the recording and what there is to say of it."""
    from simulation.flight import load_scenario, scenario_names, simulate
    from simulation.mission import is_mission, load_mission, mission_names

    if not is_mission(scenario):
        if not scenario.endswith(".toml") and scenario not in scenario_names():
            known = ", ".join([*mission_names(), *scenario_names()])
            raise ConfigError(
                f"scenario {scenario!r} is unknown; use one of {known}, or the path of a .toml file"
            )
        flight = simulate(load_scenario(scenario), seed)
        said = f"{flight.scenario.description} ({len(flight.batch):,} events, seed {flight.seed})"
        return flight.recording(), said
    from simulation.mission_log import mission_recording
    from simulation.world import fly

    flown = fly(load_mission(scenario), seed)
    return mission_recording(flown), flight_words(flown)


def flight_words(flown: Flown) -> str:
    """Return what became of a mission, in a sentence."""
    said = f"{flown.mission.description} ({len(flown.batch):,} events, seed {flown.seed}): {flown.end}"
    if flown.contact is not None:
        touch = flown.contact
        said += f", contact at {touch.speed_mps:.2f} m/s, {touch.miss_m:.2f} m from the target's centre"
    return said


def run_demo(folder: str | Path, *, seed: int = 1, force: bool = False) -> str:
    """Fly a landing on rendered pictures, replay its log, write log, estimates and report to a folder, and say what
    became of it and where they are.

    The reference engine is used: it starts at once, whereas the compiled one is compiled at its first use.
    """
    from deckfix.rendered import fly_rendered, write_rendered
    from deckfix.replaying import replay
    from estimation.modes import EXPLANATIONS
    from simulation.mission import load_mission

    target = output_folder(folder)
    log, estimate, page = (target / name for name in ("flight.mcap", "estimate.mcap", "report.html"))
    for path in (log, estimate, page):
        check_output(path, force=force)
    with working("flying a landing, search to touchdown, on rendered pictures"):
        flown, companion = fly_rendered(load_mission(DEMO_MISSION), seed, engine="filterpy")
    with output_file(log, force=force) as partial:
        write_rendered(partial, flown, companion)
    said = [flight_words(flown)]
    said += [
        f"  {t:6.1f} s  {mode.name.lower()}: {EXPLANATIONS[reason]}" for t, mode, reason in flown.transitions
    ]
    counts = companion.pipeline.counts
    said.append(f"{counts['fixes']} of {counts['images']} pictures gave a fix of the target; wrote {log}")
    with working("replaying"):
        result = replay(log, engine="filterpy")
    result.write(estimate, force=force)
    write_text(page, result.report(), force=force)
    said += [digest(result), f"wrote {estimate}", f"wrote {page}: open it in a browser"]
    return "\n".join(said)
