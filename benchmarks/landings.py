"""Landings flown in a closed loop, in five seas, against the same vehicle that comes down blindly.

    python benchmarks/landings.py [--landings 20 | --full] [--first-seed 5000] [--sea NAME ...] [--guide NAME ...]
                                  [--json FILE] [--no-gate]

Every landing is a whole mission: search, tracking, observation, landing, flown on the estimator's estimates, with fixes
drawn from what the estimator is told (``benchmarks/fix_model.py`` compares those with rendered pictures). Blind is the
same flight from the begin of the landing on, on the same sea, wind and sensors, straight down at 0.5 m/s over the
target, as an autopilot's precision landing does; "slow blind" goes down at the touchdown rate that the landing modes
use relative to the deck, to tell what is gained by going down slowly from what is gained by following the deck.
``--full`` flies 200 in each sea.

Printed are the touchdowns inside r_land, the descents broken off for the holding height, the aborts, the horizontal
miss and the speed into the deck at first contact. Outside is what touches first, or stands in the end, outside r_land.
A first contact on the way up counts as none of a descent.
Exit status 1 when a target is missed, unless --no-gate is given.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import msgspec
import numpy as np
from joblib import Parallel, delayed
from targets import Target, Targets, provenance

from estimation.landing import step
from estimation.landing_config import LandingConfig
from estimation.modes import Decision, Mode, Progress, Reason, Situation
from simulation.flight import WavesTable
from simulation.mission import Mission, load_mission
from simulation.sea import Wave
from simulation.world import Flown, Guidance, World

MISSION = "landing_beaufort2_2026_11"
SWELL = Wave("swell", 0.4, 9.0, 0.2, 0.1)
SEAS: dict[str, WavesTable] = {
    "Beaufort 0": WavesTable(beaufort=0),
    "Beaufort 1": WavesTable(beaufort=1),
    "Beaufort 2": WavesTable(beaufort=2),
    "Beaufort 3": WavesTable(beaufort=3),
    "Beaufort 3 + swell": WavesTable(beaufort=3, waves=(SWELL,)),
}
BLIND_RATE_MPS = 0.5
FIRST_SEED = 5000


def straight_down(rate_mps: float) -> Guidance:
    """Return guidance that comes down at this rate over the target from the moment the landing begins."""

    def guide(before: Progress, seen: Situation, c: LandingConfig) -> tuple[Progress, Decision]:
        if before.mode is Mode.LANDING and not seen.on_deck:
            # Kept at the begin of its descent, so that no rule of the landing modes ends it.
            still = replace(before, descent_ns=seen.now_ns, since_ns=seen.now_ns)
            after, decision = step(still, seen, relaxed(c))
            if after.mode is Mode.LANDING:
                velocity = decision.velocity_mps.copy()
                velocity[2] = rate_mps
                return after, replace(decision, velocity_mps=velocity)
            return after, decision
        return step(before, seen, c)

    return guide


def relaxed(c: LandingConfig) -> LandingConfig:
    """Return a configuration under which a descent is not broken off for its place."""
    return msgspec.structs.replace(c, abort_probability=1e-9)


GUIDES: dict[str, Callable[[LandingConfig], Guidance]] = {
    "deckfix": lambda c: step,
    "blind": lambda c: straight_down(BLIND_RATE_MPS),
    "slow blind": lambda c: straight_down(c.touchdown_rate_mps),
}


@dataclass(frozen=True, slots=True)
class Landing:
    end: str
    aborts: int
    rises: int
    duration_s: float
    speed_mps: float
    miss_m: float
    stands_m: float
    in_descent: bool


def land(mission: Mission, guides: list[str], seed: int) -> dict[str, Landing]:
    """Fly one mission under each guidance: they differ from the begin of the landing on."""
    world = World(mission, seed, "auto", step, None)
    while not world.end and world.landing_mode is not Mode.LANDING:
        world.tick()
    done = {}
    for guide in guides:
        branch = world.branch(GUIDES[guide](mission.config.landing))
        while not branch.end:
            branch.tick()
        landing = judged(branch.flown())
        # Coming straight down goes on where the landing modes would break a descent off.
        done[guide] = landing if guide == "deckfix" else replace(landing, rises=0)
    return done


def judged(flown: Flown) -> Landing:
    aborts = sum(
        mode is Mode.ABORT and reason is not Reason.GIVEN_UP for _, mode, reason in flown.transitions
    )
    # Descents broken off for the height that a quiet moment is waited for at.
    rises = sum(
        mode is Mode.LANDING and reason in (Reason.OUTSIDE_R_LAND, Reason.NO_CONTACT)
        for _, mode, reason in flown.transitions
    )
    touch = flown.contact
    if touch is None:
        return Landing(
            flown.end, aborts, rises, float(flown.t_s[-1]), float("nan"), float("nan"), float("nan"), False
        )
    end = flown.truth[-1, :2] - flown.deck[-1, :2]
    stands = float(np.hypot(*end)) if flown.end == "landed" else float("nan")
    return Landing(
        flown.end, aborts, rises, touch.t_s, touch.speed_mps, touch.miss_m, stands, touch.descending
    )


def summary(flights: list[Landing], radius: float) -> dict[str, float]:
    speed = np.array([f.speed_mps for f in flights if np.isfinite(f.speed_mps)])
    miss = np.array([f.miss_m for f in flights if np.isfinite(f.miss_m)])
    out = {
        "landings": float(len(speed)),
        "flights": float(len(flights)),
        "outside": float(sum(f.miss_m > radius or f.stands_m > radius for f in flights)),
    }
    out["away from the descent"] = float(sum(np.isfinite(f.speed_mps) and not f.in_descent for f in flights))
    out["aborts"] = float(sum(f.aborts for f in flights))
    out["rises"] = float(sum(f.rises for f in flights))
    if len(speed):
        for name, values in (("speed", speed), ("miss", miss)):
            for label, share in (("median", 50), ("p95", 95)):
                out[f"{name}_{label}"] = float(np.percentile(values, share))
            out[f"{name}_max"] = float(values.max())
        out["time_median"] = float(np.median([f.duration_s for f in flights]))
    return out


def line(name: str, s: dict[str, float]) -> str:
    if "speed_median" not in s:
        return f"  {name:11s} no landing in {s['flights']:.0f}"
    return (
        f"  {name:11s} {s['landings']:4.0f}/{s['flights']:.0f} landed, {s['outside']:.0f} outside r_land, "
        f"{s['rises']:.0f} descents broken off, {s['aborts']:.0f} aborts; "
        f"contact {s['speed_median']:.2f} median {s['speed_p95']:.2f} p95 {s['speed_max']:.2f} max m/s; "
        f"miss {s['miss_median']:.2f} median {s['miss_p95']:.2f} p95 {s['miss_max']:.2f} max m; "
        f"{s['time_median']:.0f} s"
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--landings", type=int, default=20, help="in each sea")
    parser.add_argument("--full", action="store_true", help="200 in each sea")
    parser.add_argument("--first-seed", type=int, default=FIRST_SEED)
    parser.add_argument("--sea", nargs="+", choices=list(SEAS), default=list(SEAS))
    parser.add_argument("--guide", nargs="+", choices=list(GUIDES), default=["deckfix", "blind"])
    parser.add_argument("--jobs", type=int, default=-1)
    parser.add_argument("--json", type=Path, help="write the numbers here")
    parser.add_argument("--no-gate", action="store_true", help="exit with 0 in any case")
    arguments = parser.parse_args()
    count = 200 if arguments.full else arguments.landings
    base = load_mission(MISSION)
    radius = base.config.landing.r_land_m
    document: dict[str, object] = {
        "benchmark": "landings",
        **provenance(),
        "landings": count,
        "r_land_m": radius,
    }
    targets = Targets()
    outside = stray = flown = 0.0
    for sea in arguments.sea:
        mission = msgspec.structs.replace(base, sea=SEAS[sea])
        begin = time.perf_counter()
        found: dict[str, dict[str, float]] = {}
        jobs = (delayed(land)(mission, arguments.guide, arguments.first_seed + k) for k in range(count))
        flights = list(Parallel(n_jobs=arguments.jobs)(jobs))
        print(sea)
        for guide in arguments.guide:
            chosen = [one[guide] for one in flights]
            found[guide] = summary(chosen, radius)
            if guide == "deckfix":
                outside += found[guide]["outside"]
                stray += found[guide]["away from the descent"]
                flown += found[guide]["landings"]
            print(line(guide, found[guide]), dict(Counter(f.end for f in chosen)), flush=True)
        print(f"  {time.perf_counter() - begin:.0f} s", flush=True)
        # Each contact's speed and miss, the place in the end, and whether it was in a descent: to put runs together.
        contacts = {
            g: [[one[g].speed_mps, one[g].miss_m, one[g].stands_m, one[g].in_descent] for one in flights]
            for g in arguments.guide
        }
        document[sea] = {"summary": found, "contacts": contacts}
        if sea != "Beaufort 0" and {"deckfix", "blind"} <= found.keys():
            ratios = {k: found["deckfix"][k] / found["blind"][k] for k in ("speed_median", "speed_p95")}
            print("  contact speed over blind: " + ", ".join(f"{k} {v:.2f}" for k, v in ratios.items()))
            if sea in ("Beaufort 2", "Beaufort 3"):
                for k, v in ratios.items():
                    targets.add(Target(f"{sea}: contact {k} over blind", v, 0.65))
    print(f"{flown:.0f} landings of deckfix in all, {outside:.0f} touchdowns outside r_land")
    targets.add(Target("touchdowns outside r_land", outside, 0))
    targets.add(Target("touchdowns not in a descent of the landing mode", stray, 0))
    met = targets.report()
    document["targets"] = targets.as_rows()
    if arguments.json:
        arguments.json.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    if not met and not arguments.no_gate:
        sys.exit(1)


if __name__ == "__main__":
    main()
