"""The platform on flights of a real autopilot in its simulator: relative position, heave, forecast, latency.

Each flight's .BIN and .tlog are imported and replayed with the default configuration; its LANDING_TARGET messages are
the vision fixes. Truth of the vehicle is the simulator's, truth of the deck the formula or table that moved it.

* Relative position: estimate less truth from 5 s after the first fix to contact, at every estimate, over the error of
  the raw fixes in that time, each turned with the estimated attitude at the time of its content. No datum is removed.
* Heave: estimated height of the deck less the true one, less the running mean of that difference over 20 s (both sides;
  narrower at the ends, down to 10 s): slower than that is level and drift. Judged from 5 s after the first fix, or
  after the deck begins to move, to contact. Beside it the same less a parabola instead of the running mean.
* Forecast: of every model learned in flight, against the true height on the estimate's level; the share of the truth
  inside the stated 95 % interval; RMSE of the level alone beside it.
* Latency with the fixes' own stamps thrown away: ``deckfix sync`` on arrival times, against the age at which the fixes'
  directions fit the simulator's own trajectory, attitude and deck best. (Sent less captured is no truth for it: the way
  of the clocks through the link, and the harness's own delay, add some 10 ms each.)

    python benchmarks/deck.py [--only heave06 sea3a calm] [--without-latency] [--json FILE] [--no-gate]

Exit status 1 when a target is missed, unless --no-gate is given.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from realdata import data_folder, imported
from targets import Target, Targets, nis_rows, provenance

import deckfix
from deckfix.deck_reference import first_fix_ns, slow, true_height
from deckfix.forecasts import forecasts, judge
from deckfix.reference import Trajectory, column, rms
from deckfix.replaying import facts
from deckfix.sync import LatencyStatus, latency_profile, on_inertial_clock
from estimation.config import parse_config
from estimation.events import Kind
from estimation.frames import R_CB_NOMINAL, quat_to_matrix
from estimation.state import BLOCKS, NOMINAL

Array = NDArray[np.float64]
Row = dict[str, Any]

TARGET_NE_M = (2.0, 2.236)
"""The target's place, north and east of home."""
SETTLING_S = 5.0
CONTACT_M = 0.12
HORIZONS_S = (0.5, 1.0, 1.5, 2.0, 3.0, 4.0, 5.0)
LATENCY_MS = 15.0


@dataclass(frozen=True, slots=True)
class Deck:
    """How a flight's deck moves: height [m, up] of boot times [s], when it begins to (None: before it is seen), and its
    period where it has one [s]."""

    height_m: Callable[[Array], Array]
    begins_s: float | None
    period_s: float | None


def decks(folder: Path) -> dict[str, Deck]:
    """Return the decks of the flights."""
    table = np.loadtxt(folder / "sea3a.deck.csv", delimiter=",", skiprows=1)

    def regular(t: Array) -> Array:
        moved = np.maximum(t - 60.0, 0.0)
        return 0.6 * (1.0 - np.exp(-((moved / 5.0) ** 2))) * np.sin(2.0 * np.pi * moved / 7.0)

    return {
        "heave06": Deck(regular, 60.0, 7.0),
        "sea3a": Deck(lambda t: np.interp(t, table[:, 0], table[:, 1]), None, None),
        "calm": Deck(lambda t: np.zeros(len(t)), None, None),
    }


def judged(name: str, folder: Path, deck: Deck, scratch: Path, latency: bool, targets: Targets) -> Row:
    """Print and return the numbers of one flight."""
    flight = imported([folder / f"{name}{s}" for s in (".BIN", ".tlog")], scratch)
    result = deckfix.replay(flight)
    run = result.run
    first = first_fix_ns(run)
    assert result.truth is not None and result.truth.position_m is not None and first is not None
    t = run.t_ns
    up = deck.height_m(t * 1e-9)
    place = np.column_stack([np.full(len(t), TARGET_NE_M[0]), np.full(len(t), TARGET_NE_M[1]), -up])
    relative = result.truth.position_m.at(t) - place
    contact = t[np.flatnonzero((t > first) & (-relative[:, 2] < CONTACT_M))[0]]
    begin = first + round(SETTLING_S * 1e9)
    inside = (t > begin) & (t < contact)
    row: Row = {
        "flight": name,
        "first_fix_s": first * 1e-9,
        "contact_s": float(contact) * 1e-9,
        "notes": [[at * 1e-9, text] for at, text in run.notes],
        "vision_nis": nis_rows(run)["vision"],
        "camera_latency": {k: v for k, v in result.clocks["companion"].items() if k.startswith("latency_")},
    }
    print(f"\n== {name}: first fix {row['first_fix_s']:.1f} s, contact {row['contact_s']:.1f} s ==")
    for at, text in row["notes"]:
        print(f"  {at:7.1f} s: {text}")
    row["relative"] = against_raw(result, relative, inside, (begin, int(contact)))
    for kind, bound in (("horizontal", 0.6), ("all", 0.5)):
        r = row["relative"][kind]
        print(
            f"  relative position, {kind:10}: {r['ours_m']:.4f} m, raw {r['raw_m']:.4f} m, ratio {r['ratio']:.2f}"
        )
        targets.add(Target(f"{name}: relative position, {kind}, over the raw fixes'", r["ratio"], bound))
    start = begin if deck.begins_s is None else max(begin, round((deck.begins_s + SETTLING_S) * 1e9))
    row["heave_rmse_m"], row["heave_less_parabola_m"] = heave_error(
        t, run.deck[:, 6] - up, start, int(contact)
    )
    print(f"  heave: {row['heave_rmse_m']:.4f} m rms ({row['heave_less_parabola_m']:.4f} less a parabola)")
    if name != "calm":
        bound = 0.05 if name == "heave06" else 0.04
        targets.add(Target(f"{name}: heave rmse [m]", row["heave_rmse_m"], bound))
    if deck.period_s is not None and deck.begins_s is not None:
        row["period"] = periods(run.heave, deck, int(contact))
        print("  period [s]: " + ", ".join(f"{p:.2f} at {at:.0f} s" for at, p in row["period"]["found"]))
        targets.add(
            Target(f"{name}: period, largest error from 15 s on", row["period"]["largest_error"], 0.03)
        )
    if name == "sea3a":
        row["forecast"] = forecast_table(result, deck, int(contact))
        for entry in row["forecast"]:
            at, share = f"{name}: coverage at {entry['horizon_s']:g} s", entry["coverage_95"]
            targets.add(Target(f"{at}, at least", share, 0.92, True))
            targets.add(Target(f"{at}, at most", share, 0.98))
    if name == "calm":
        row["constant"] = constants(run, (t > first + 20_000_000_000) & (t < contact))
        for key, value in row["constant"].items():
            print(f"  {key}: standard deviation {value:.4f} m")
            targets.add(Target(f"{name}: {key} is constant, standard deviation [m]", value, 0.05))
    if latency:
        row["by_arrival"] = by_arrival(name, flight, result, deck, (begin, int(contact)), targets)
    return row


def against_raw(
    result: deckfix.Result, relative: Array, inside: NDArray[np.bool_], window: tuple[int, int]
) -> Row:
    """Return RMSE of the estimated relative position and of the raw fixes, horizontal (2-D), vertical and 3-D."""
    run, fixes = result.run, result.fixes
    assert fixes is not None
    ours = (run.deck[:, :3] - relative)[inside]
    kept = (fixes.t_ns > window[0]) & (fixes.t_ns < window[1])
    at = fixes.t_ns[kept]
    raw = fixes.relative_m[kept] - np.column_stack([np.interp(at, run.t_ns, r) for r in relative.T])
    out = {}
    for kind, axes in (("horizontal", [0, 1]), ("vertical", [2]), ("all", [0, 1, 2])):
        a, b = (float(np.sqrt(np.mean(np.sum(e[:, axes] ** 2, axis=1)))) for e in (ours, raw))
        out[kind] = {"ours_m": a, "raw_m": b, "ratio": a / b}
    return out


def heave_error(t: NDArray[np.int64], error: Array, start: int, stop: int) -> tuple[float, float]:
    """Return the RMSE [m] of a height's error less its running mean over 20 s, and less a parabola."""
    inside = (t > start) & (t < stop)
    kept = np.where(inside, error, np.nan)
    seconds = (t[inside] - start) * 1e-9
    bent = error[inside] - np.polyval(np.polyfit(seconds, error[inside], 2), seconds)
    return rms((kept - slow(t, kept))[inside]) or 0.0, rms(bent) or 0.0


def periods(models: list[tuple[int, Any]], deck: Deck, contact: int) -> Row:
    """Return (time [s], period [s]) of the models, and the largest relative error from 15 s of motion on."""
    assert deck.begins_s is not None and deck.period_s is not None
    found = [(due * 1e-9, m.dominant_period_s) for due, m in models if due < contact]
    late = [abs(p / deck.period_s - 1.0) for at, p in found if at >= deck.begins_s + 15.0]
    return {"found": [f for f in found if f[0] > deck.begins_s], "largest_error": max(late, default=np.inf)}


def forecast_table(result: deckfix.Result, deck: Deck, contact: int) -> list[Row]:
    """Print and return the forecasts' RMSE and coverage by horizon."""
    run = result.run
    t = run.t_ns
    up = column(t, np.column_stack([np.zeros((len(t), 2)), -deck.height_m(t * 1e-9)]))
    happened = true_height(run, Trajectory(up, None, None))
    assert happened is not None
    models = [(due, m) for due, m in run.heave if due < contact - 5_000_000_000]
    scores = judge(forecasts(models, HORIZONS_S), happened, "truth")
    print("  forecast: horizon [s], n, RMSE [m], of the level alone [m], coverage of the 95 % interval")
    rows = []
    for k, h in enumerate(HORIZONS_S):
        row = {
            "horizon_s": h,
            "count": int(scores.count[k]),
            "rmse_m": float(scores.rmse_m[k]),
            "level_rmse_m": float(scores.level_rmse_m[k]),
            "coverage_95": float(scores.coverage_95[k]),
        }
        rows.append(row)
        print(f"    {h:4.1f} {row['count']:4d} {row['rmse_m']:8.4f} {row['level_rmse_m']:8.4f} ", end="")
        print(f"{row['coverage_95']:7.1%}")
    return rows


def constants(run: deckfix.Run, inside: NDArray[np.bool_]) -> dict[str, float]:
    """Return how much [m] what does not change in truth does in the estimate."""
    names = [b[0] for b in BLOCKS]
    bias, level = (NOMINAL[names.index(n)] for n in ("gps_bias", "platform_level"))
    columns = {"GPS bias north": bias, "GPS bias east": bias + 1, "deck level": level}
    return {key: float(np.std(run.nominal[inside, k])) for key, k in columns.items()}


def by_arrival(
    name: str, flight: Any, result: deckfix.Result, deck: Deck, window: tuple[int, int], targets: Targets
) -> Row:
    """Print and return the latency that arrival times alone show."""
    config = parse_config(result.config_text)
    truth_ms = true_age_s(flight, result, deck, window) * 1e3
    found = latency_profile(flight.events(), config, facts(flight), by_arrival=True)
    error_ms, sigma_ms = found.latency_s * 1e3 - truth_ms, found.sigma_s * 1e3
    print(f"  latency by arrival: {found.latency_s * 1e3:.1f} ± {sigma_ms:.1f} ms, {found.status}", end="")
    print(f" ({found.reason}); truth {truth_ms:.1f} ms, error {error_ms:+.1f} ms")
    bound = LATENCY_MS if found.status is LatencyStatus.ESTIMATED else 2.0 * sigma_ms
    targets.add(Target(f"{name}: latency by arrival, |error| [ms]", abs(error_ms), bound))
    return {
        "latency_ms": found.latency_s * 1e3,
        "sigma_ms": sigma_ms,
        "status": str(found.status),
        "truth_ms": truth_ms,
        "error_ms": error_ms,
    }


def true_age_s(flight: Any, result: deckfix.Result, deck: Deck, window: tuple[int, int]) -> float:
    """Return the age [s] at arrival at which the fixes' directions fit the truth best, by least squares."""
    truth = result.truth
    assert truth is not None and truth.position_m is not None
    batch, _ = on_inertial_clock(flight.events(), by_arrival=True)
    rows = batch.rows[batch.rows["kind"] == int(Kind.VISION)]
    rows = rows[(rows["stamp_ns"] > window[0]) & (rows["stamp_ns"] < window[1] - 2_000_000_000)]
    seen = rows["value"][:, :3] @ R_CB_NOMINAL
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    ages = np.arange(0.0, 0.15, 0.001)
    left = np.zeros(len(ages))
    for k, age in enumerate(ages.tolist()):
        t = rows["stamp_ns"].astype(np.int64) - round(age * 1e9)
        place = np.column_stack([np.tile(TARGET_NE_M, (len(t), 1)), -deck.height_m(t * 1e-9)])
        R_nb = np.stack([quat_to_matrix(q) for q in truth.quaternion_at(t)])
        body = np.einsum("nji,nj->ni", R_nb, place - truth.position_m.at(t))
        body /= np.linalg.norm(body, axis=1, keepdims=True)
        left[k] = np.nanmean(np.sum((seen - body) ** 2, axis=1))
    k = int(np.clip(np.argmin(left), 3, len(ages) - 4))
    square, line, _ = np.polyfit(ages[k - 3 : k + 4] - ages[k], left[k - 3 : k + 4], 2)
    return float(ages[k] - 0.5 * line / square)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", choices=["heave06", "sea3a", "calm"])
    parser.add_argument("--without-latency", action="store_true", help="leave out what takes the longest")
    parser.add_argument("--json", type=Path, help="write the numbers here")
    parser.add_argument("--no-gate", action="store_true", help="exit with 0 in any case")
    arguments = parser.parse_args()
    folder = data_folder()
    if folder is None:
        sys.exit("the real recordings are not here; set DECKFIX_DATA to their folder")
    folder /= "ardupilot_sitl"
    targets = Targets()
    known = decks(folder)
    with tempfile.TemporaryDirectory() as scratch:
        rows = [
            judged(name, folder, known[name], Path(scratch), not arguments.without_latency, targets)
            for name in arguments.only or list(known)
        ]
    met = targets.report()
    if arguments.json:
        document = {"benchmark": "deck", **provenance(), "flights": rows, "targets": targets.as_rows()}
        arguments.json.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    if not met and not arguments.no_gate:
        sys.exit(1)


if __name__ == "__main__":
    main()
