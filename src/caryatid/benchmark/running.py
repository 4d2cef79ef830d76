"""Running episodes in processes of this machine, or wherever an executor sends them."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from typing import Protocol

from caryatid.benchmark.episodes import run_episode
from caryatid.benchmark.records import Episode, Outcome
from caryatid.benchmark.store import ResultStore
from caryatid.errors import CaryatidError

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
"""Set to 1 for the processes, unless set already: they share the cores."""


class Executor(Protocol):
    """Runs episodes somewhere."""

    def run(self, episodes: Sequence[Episode]) -> Iterator[tuple[Episode, Outcome]]:
        """Yield each episode with its outcome as soon as it is done, in any order."""
        ...


class LocalExecutor:
    """Runs episodes in processes of this machine.

    Args:
        jobs: How many at once.
    """

    def __init__(self, jobs: int) -> None:
        self._jobs = jobs

    def run(self, episodes: Sequence[Episode]) -> Iterator[tuple[Episode, Outcome]]:
        """Yield each episode with its outcome as soon as it is done.

        Raises:
            CaryatidError: A process was killed.
        """
        for name in THREADS:
            os.environ.setdefault(name, "1")
        pool = ProcessPoolExecutor(min(self._jobs, len(episodes)), get_context("spawn"))
        try:
            futures: dict[Future[Outcome], Episode] = {pool.submit(run_episode, e): e for e in episodes}
            for future in as_completed(futures):
                yield futures.pop(future), future.result()
        except BrokenExecutor:
            raise CaryatidError(
                "a process was killed, perhaps for want of memory; what is done is kept: "
                "start again, with fewer --jobs"
            ) from None
        finally:
            pool.shutdown(cancel_futures=True)


def run_all(
    store: ResultStore,
    episodes: Sequence[Episode],
    executor: Executor,
    done: Callable[[Episode, Outcome], None] = lambda episode, outcome: None,
) -> None:
    """Run episodes and keep what each gives as soon as it is there.

    Args:
        store: Where to.
        episodes: What to run.
        executor: Runs them.
        done: Told of each that is kept.
    """
    if not episodes:
        return
    for episode, outcome in executor.run(episodes):
        store.add(episode, outcome)
        done(episode, outcome)
