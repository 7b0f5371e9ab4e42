"""Linear algebra on one thread.

On several, sums are taken in an order that depends on how many there are: their last bits differ, a search for the
likeliest spectrum ends elsewhere, and a log gives other estimates on another machine. Matrices of a few hundred rows
gain nothing from them either.
"""

from __future__ import annotations

import functools
import importlib
from contextlib import AbstractContextManager

from threadpoolctl import ThreadpoolController


def one_thread() -> AbstractContextManager[object]:
    """Return a context within which NumPy's and SciPy's linear algebra runs on one thread, in the whole process."""
    limited: AbstractContextManager[object] = _libraries().limit(limits=1, user_api="blas")
    return limited


@functools.cache
def _libraries() -> ThreadpoolController:
    """Return the libraries that were found, once SciPy has loaded its own."""
    importlib.import_module("scipy.linalg")
    return ThreadpoolController()
