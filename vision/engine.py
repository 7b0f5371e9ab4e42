"""Which code does the work: compiled where numba is installed, else NumPy. Both give the same fixes."""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec
from typing import NamedTuple

from vision.area import AreaSolver, solve_area
from vision.refine import Solver, solve_profiles
from vision.rings import Labeller, label_circles


class Engine(NamedTuple):
    """The three steps of the detector that are compiled."""

    name: str
    solve: Solver
    label: Labeller
    area: AreaSolver


def engine_of(name: str) -> Engine:
    """Return the engine ``"compiled"``, ``"numpy"``, or ``"auto"``, compiled where numba is installed.

    ``ValueError`` names the argument where there is none such.
    """
    if name not in ("auto", "compiled", "numpy"):
        raise ValueError(f"engine: {name!r} is none of 'auto', 'compiled', 'numpy'")
    installed = find_spec("numba") is not None
    if name == "compiled" and not installed:
        raise ValueError("engine: 'compiled' needs numba; pip install 'deckfix[fast]'")
    if installed and name != "numpy":
        return _compiled()
    return Engine("numpy", solve_profiles, label_circles, solve_area)


@cache
def _compiled() -> Engine:
    from vision import compiled

    compiled.compile_now()
    return Engine("compiled", compiled.solve, compiled.label, compiled.solve_small)
