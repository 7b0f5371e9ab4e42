"""Heave models and forecasts -> the columns of their topics.

Stamps are the time of a model's last fix on the inertial clock, from which phases and horizons count. Heave, level and
rate are positive up, heights count from the origin of the estimates; the channels' metadata say so.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from estimation.events import AUTOPILOT
from estimation.heave.model import HeaveModel
from logs.recording import Series
from logs.topics import TOPICS, new_rows

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

SIGNS = {
    "heave": "positive up, above the origin of the estimates (frame ned, third axis reversed)",
    "time": "t = 0 and horizon 0 are the stamp: the last fix that the model was learned from",
}


def heave_model_series(
    stamp_ns: I64, arrival_ns: I64, models: Sequence[HeaveModel], *, clock: str = AUTOPILOT
) -> list[Series]:
    """Return models as ``/heave/model``: one series for each method and number of components."""
    out = []
    kinds = [(model.method, len(model.components)) for model in models]
    for kind in dict.fromkeys(kinds):
        rows = np.array([i for i, k in enumerate(kinds) if k == kind], np.int64)
        method, count = kind
        data = new_rows("/heave/model", len(rows), amplitude_m=count, period_s=count, phase_rad=count)
        for row, i in zip(data, rows, strict=True):
            model = models[int(i)]
            row["level_m"], row["level_sigma_m"] = model.level_m, model.level_sigma_m
            row["significant_height_m"], row["peak_period_s"] = model.hs_m, model.tp_s
            if count:
                components = np.array(model.components)
                row["amplitude_m"], row["period_s"], row["phase_rad"] = components.T
        strings: dict[str, str] = {"method": method}
        frame = TOPICS["/heave/model"].frame_id
        out.append(
            Series("/heave/model", stamp_ns[rows], arrival_ns[rows], data, clock, frame, strings, dict(SIGNS))
        )
    return out


def heave_forecast_series(
    stamp_ns: I64,
    arrival_ns: I64,
    horizon_s: F64,
    columns: dict[str, F64],
    window_rate_mps: float,
    window_s: float,
    *,
    clock: str = AUTOPILOT,
) -> Series:
    """Return forecasts as ``/heave/forecast``; ``columns`` holds the message's fields (n, h) by their names."""
    names = ("horizon_s", *columns)
    data = new_rows("/heave/forecast", len(stamp_ns), **dict.fromkeys(names, len(horizon_s)))
    data["horizon_s"] = horizon_s
    for name, values in columns.items():
        data[name] = values
    data["window_rate_mps"], data["window_s"] = window_rate_mps, window_s
    frame = TOPICS["/heave/forecast"].frame_id
    return Series("/heave/forecast", stamp_ns, arrival_ns, data, clock, frame, {}, dict(SIGNS))
