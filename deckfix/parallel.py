"""Tasks on several processes of this machine (joblib), or on a Dask cluster.

Which worker does a task, and in which order tasks end, never shows in a result: each is returned with the task's
index. A worker that dies is replaced and its tasks are done again.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor
from contextlib import ExitStack
from itertools import islice
from typing import Any, Generic, TypeVar

from deckfix._version import __version__
from deckfix.files import InputError

T = TypeVar("T")
R = TypeVar("R")

CONNECT_S = 10
"""How long a scheduler, and then its workers, are waited for."""


class WorkerLost(RuntimeError):
    """What a task is answered with that took its worker with it each time."""

    def __init__(self) -> None:
        super().__init__("the process that worked on it died each time; is there enough memory?")


class _Task(Generic[T, R]):
    """A function that answers with the task's index; the class is importable, so that it reaches any worker."""

    def __init__(self, function: Callable[[T], R]) -> None:
        self.function = function

    def __call__(self, index: int, task: T) -> tuple[int, R]:
        return index, self.function(task)


class Workers:
    """A context in which ``each`` does tasks: ``jobs`` processes here, or the workers of a Dask scheduler.

    Entering raises ``InputError`` where the scheduler cannot be reached, has no workers, or these have another version
    of deckfix, and ``ImportError`` where dask is not installed.
    """

    def __init__(self, jobs: int | None = None, scheduler: str | None = None) -> None:
        self.scheduler = scheduler
        self.jobs = jobs or os.cpu_count() or 1
        self._stack = ExitStack()
        self._client: Any = None
        self._parallel: Any = None

    def __enter__(self) -> Workers:
        if self.scheduler is not None:
            self._client = self._stack.enter_context(_connected(self.scheduler))
        elif self.jobs > 1:
            self._open_pool()
        return self

    def __exit__(self, *exception: object) -> None:
        self._stack.close()

    def each(self, function: Callable[[T], R], tasks: Sequence[T]) -> Iterator[tuple[int, R | WorkerLost]]:
        """Yield (index of the task, ``function(task)``) in the order in which they end.

        ``function`` must be importable on the workers, and must not raise. Tasks are handed out as workers become
        free, so that only what is worked on takes memory. A task that kills its worker three times is answered with
        ``WorkerLost``.
        """
        if self._client is not None:
            yield from self._on_cluster(function, tasks)
        elif self.jobs == 1:
            yield from ((i, function(task)) for i, task in enumerate(tasks))
        else:
            yield from self._here(function, tasks)

    def _here(self, function: Callable[[T], R], tasks: Sequence[T]) -> Iterator[tuple[int, R | WorkerLost]]:
        from joblib import delayed

        do, left = delayed(_Task(function)), dict(enumerate(tasks))
        for _ in range(2):
            try:
                for index, result in self._parallel(do(i, task) for i, task in tuple(left.items())):
                    del left[index]
                    yield index, result
                return
            except BrokenExecutor:
                # Memory ran out, or someone ended the process: the others' tasks are lost with it.
                self._stack.close()
                self._open_pool()
        for index, task in left.items():
            # One at a time, so that the one that kills is told from those that were only beside it.
            try:
                answer: R | WorkerLost = next(iter(self._parallel([do(index, task)])))[1]
            except BrokenExecutor:
                answer = WorkerLost()
                self._stack.close()
                self._open_pool()
            yield index, answer

    def _open_pool(self) -> None:
        from joblib import Parallel

        # A batch is one task: a killed worker loses no more, and results come as they are ready.
        pool = Parallel(n_jobs=self.jobs, return_as="generator_unordered", batch_size=1, mmap_mode="r")
        self._parallel = self._stack.enter_context(pool)

    def _on_cluster(
        self, function: Callable[[T], R], tasks: Sequence[T]
    ) -> Iterator[tuple[int, R | WorkerLost]]:
        """Give tasks to Dask itself: joblib's backend for it waits for ever on a task that killed its workers."""
        from distributed import KilledWorker, as_completed

        room = 2 * max(1, sum(self._client.ncores().values()))
        waiting, index_of = iter(enumerate(tasks)), dict[str, int]()
        done = as_completed(loop=self._client.loop)

        def hand_out(count: int) -> None:
            for index, task in islice(waiting, count):
                future = self._client.submit(function, task, pure=False)
                index_of[future.key] = index
                done.add(future)

        hand_out(room)
        for future in done:
            index = index_of.pop(future.key)
            if future.status == "finished":
                yield index, future.result()
            elif future.status == "error" and isinstance(future.exception(), KilledWorker):
                yield index, WorkerLost()
            elif future.status == "error":
                future.result()
            else:
                raise InputError(
                    f"{self.scheduler}: the scheduler went away; run the command again, what was done is kept"
                )
            hand_out(1)


def _connected(address: str) -> Any:
    """Return a client of a scheduler whose workers can do our tasks."""
    try:
        from distributed import Client
    except ImportError:
        raise ImportError("--scheduler needs dask; install it with: pip install 'deckfix[cluster]'") from None
    try:
        client = Client(address, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise InputError(
            f"{address}: no Dask scheduler answers ({type(error).__name__}); start one with 'dask scheduler', or "
            "leave --scheduler out"
        ) from None
    try:
        _check_workers(client, address)
    except BaseException:
        client.close()
        raise
    return client


def _check_workers(client: Any, address: str) -> None:
    try:
        client.wait_for_workers(1, timeout=CONNECT_S)
    except (TimeoutError, OSError):
        raise InputError(
            f"{address}: the scheduler has no workers; start some with 'dask worker {address}'"
        ) from None
    try:
        versions = set(client.run(installed_version).values())
    except ModuleNotFoundError as error:
        raise InputError(f"{address}: a worker lacks {error.name}; install deckfix there too") from None
    if versions != {__version__}:
        raise InputError(
            f"{address}: the workers have deckfix {', '.join(sorted(versions))}, here it is {__version__}; install "
            "the same everywhere"
        )


def installed_version() -> str:
    """Return the version of deckfix where this is called."""
    return __version__
