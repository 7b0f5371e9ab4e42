"""Events in, estimates out: the estimator and what it is made of.

The names below are the public ones; they are loaded when they are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from estimation.config import Config, ConfigError, dump_config, load_config, parse_config
    from estimation.estimator import LandingEstimator
    from estimation.events import EventBatch
    from estimation.outcome import Outcome
    from estimation.output import Estimate, Facts, Output, Run

_HOME = {
    "Config": "config",
    "ConfigError": "config",
    "dump_config": "config",
    "load_config": "config",
    "parse_config": "config",
    "Estimate": "output",
    "Facts": "output",
    "LandingEstimator": "estimator",
    "Output": "output",
    "Run": "output",
    "EventBatch": "events",
    "Outcome": "outcome",
}

__all__ = [
    "Config",
    "ConfigError",
    "Estimate",
    "EventBatch",
    "Facts",
    "LandingEstimator",
    "Outcome",
    "Output",
    "Run",
    "dump_config",
    "load_config",
    "parse_config",
]


def __getattr__(name: str) -> Any:
    """Load a public name from its module."""
    if name not in _HOME:
        raise AttributeError(f"module 'estimation' has no attribute {name!r}")
    import importlib

    return getattr(importlib.import_module(f"estimation.{_HOME[name]}"), name)
