"""The README's picture of the demo: height, place and view of one landing, from the files that ``deckfix demo`` wrote.

    python docs/mission_picture.py [demo] [-o docs/images/mission.png]

Needs matplotlib (part of ``pip install .[dev]``).
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np

import deckfix
from deckfix.pipeline import decode
from estimation.modes import Mode
from logs.images import images

SHADES = {
    Mode.SEARCH: "#e8eef7", Mode.TRACKING: "#d3e3f5", Mode.OBSERVATION: "#e3f1df", Mode.LANDING: "#f8ecd6",
    Mode.LANDED: "#eeeeee", Mode.ABORT: "#f8d8d6",
}  # fmt: skip
SIZE_IN = (10.5, 5.6)


def column(flight: Any, topic: str, field: str = "pose_pose_position") -> tuple[np.ndarray, np.ndarray]:
    """Return the times [s of the clock] and a field (n, 3) of a topic's messages."""
    (series,) = flight.series(topic)
    return series.stamp_ns * 1e-9, series.data[field]


def modes(flight: Any) -> list[tuple[float, float, Mode]]:
    """Return from when to when which mode was on [s of the clock]."""
    told = []
    for one in flight.series("/landing/mode"):
        told += list(zip((one.stamp_ns * 1e-9).tolist(), one.data["mode"].tolist(), strict=True))
    told.sort()
    spans: list[tuple[float, float, Mode]] = []
    for t, mode in told:
        if spans and spans[-1][2] == mode:
            spans[-1] = spans[-1][0], t, Mode(mode)
        else:
            spans.append((t, t, Mode(mode)))
    return spans


def main() -> int:
    """Draw the picture."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path, default=Path("demo"))
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/images/mission.png"))
    a = parser.parse_args()
    try:
        import matplotlib as mpl
    except ImportError:
        print("matplotlib is not installed: pip install 'deckfix[notebooks]'")
        return 1
    mpl.use("Agg")
    import matplotlib.pyplot as plt
    from PIL import Image  # matplotlib needs it too

    flight, estimate = deckfix.open(a.folder / "flight.mcap"), deckfix.open(a.folder / "estimate.mcap")
    t, vehicle = column(flight, "/truth/odometry")
    _, deck = column(flight, "/truth/platform")
    te, relative = column(estimate, "/estimate/relative")
    begin = t[0]
    told = flight.metadata["deckfix.simulation"]
    contact = float(told["contact_s"])
    figure = plt.figure(figsize=SIZE_IN, layout="constrained")
    grid = figure.add_gridspec(2, 4, height_ratios=(3, 2))
    height = figure.add_subplot(grid[0, :3])
    for start, end, mode in modes(flight):
        height.axvspan(start - begin, end - begin, color=SHADES.get(mode, "white"), lw=0)
        if end - start > 2.5:
            height.text(
                0.5 * (start + end) - begin, 16.5, mode.name.lower(), ha="center", va="top", fontsize=8
            )
    height.plot(t - begin, -vehicle[:, 2], color="#1f4e8c", label="vehicle")
    height.plot(t - begin, -deck[:, 2], color="#b03a2e", label="deck")
    height.set(xlabel="time [s]", ylabel="height [m]", xlim=(0, t[-1] - begin), ylim=(-1, 17))
    height.legend(loc="center right", fontsize=8)
    last = figure.add_subplot(grid[0, 3])
    near, told_near = t - begin > contact - 6.0, te - begin > contact - 6.0
    last.plot(t[near] - begin, deck[near, 2] - vehicle[near, 2], color="#1f4e8c", label="true")
    last.plot(te[told_near] - begin, -relative[told_near, 2], color="#e08e0b", ls="--", label="estimated")
    last.axvline(contact, color="0.6", lw=0.8)
    last.set(xlabel="time [s]", title="height over the deck [m]", ylim=(0, 2))
    last.title.set_fontsize(9)
    last.legend(fontsize=8)
    seen = [one for one in images(flight) if decode(one.data) is not None]
    arrivals = np.array([one.arrival_ns * 1e-9 for one in seen])
    arrivals -= arrivals[0] - 0.06
    spans = {mode: (start - begin, end - begin) for start, end, mode in modes(flight)}
    moments = [spans[Mode.TRACKING][0], spans[Mode.OBSERVATION][0] + 2.0, contact - 3.0, contact - 0.7]
    for k, moment in enumerate(moments):
        picture = decode(seen[int(np.argmin(np.abs(arrivals - moment)))].data)
        assert picture is not None
        axes = figure.add_subplot(grid[1, k])
        axes.imshow(picture[::3, ::3, ::-1], interpolation="none")
        axes.set(xticks=[], yticks=[])
        axes.set_title(f"seen at {moment:.0f} s", fontsize=8)
    figure.suptitle(
        f"{told['description']}: contact at {float(told['contact_speed_mps']):.2f} m/s, "
        f"{float(told['contact_miss_m']):.2f} m from the centre", fontsize=10,
    )  # fmt: skip
    a.output.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(a.output, dpi=84)
    with Image.open(a.output) as drawn:
        few = drawn.convert("RGB").quantize(96)
    few.save(a.output, optimize=True)
    print(f"wrote {a.output}, {a.output.stat().st_size / 1000:.0f} kB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
