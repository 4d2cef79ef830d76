"""Running episodes in processes of this machine, or wherever an executor sends them."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor, as_completed
from contextlib import closing, contextmanager
from multiprocessing import active_children, get_context, parent_process
from threading import Thread
from typing import Protocol

from caryatid.benchmark.episodes import run_episode
from caryatid.benchmark.records import Episode, Outcome
from caryatid.benchmark.store import ResultStore
from caryatid.errors import CaryatidError
from caryatid.runtime.interrupts import interrupts_held

THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
"""Set to 1 in the environment of the processes, unless set already: they share the cores."""


class Executor(Protocol):
    """Runs episodes somewhere."""

    def run(self, episodes: Sequence[Episode]) -> Generator[tuple[Episode, Outcome]]:
        """Yield each episode with its outcome as soon as it is done, in any order; stop when closed."""
        ...


class LocalExecutor:
    """Runs episodes in processes of this machine.

    Args:
        jobs: How many at once.
    """

    def __init__(self, jobs: int) -> None:
        self._jobs = jobs

    def run(self, episodes: Sequence[Episode]) -> Generator[tuple[Episode, Outcome]]:
        """Yield each episode with its outcome as soon as it is done.

        Raises:
            CaryatidError: A process was killed.
        """
        others = set(active_children())
        pool = ProcessPoolExecutor(
            min(self._jobs, len(episodes)), get_context("spawn"), initializer=_end_with_parent
        )
        killed = False
        try:
            with _one_thread_each(), interrupts_held():
                futures: dict[Future[Outcome], Episode] = {pool.submit(run_episode, e): e for e in episodes}
            for future in as_completed(futures):
                if isinstance(future.exception(), BrokenExecutor):
                    killed = True
                else:
                    yield futures.pop(future), future.result()
        except BaseException:
            for process in set(active_children()) - others:
                process.terminate()
            raise
        finally:
            pool.shutdown(cancel_futures=True)
        if killed:
            raise CaryatidError(
                "a process was killed, perhaps for want of memory; what is done is kept: "
                "start again, with fewer --jobs"
            )


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
    with closing(executor.run(episodes)) as outcomes:
        for episode, outcome in outcomes:
            store.add(episode, outcome)
            done(episode, outcome)


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Have processes started meanwhile compute on one thread; this one, whose threads may run, goes on."""
    added = [name for name in THREADS if name not in os.environ]
    os.environ.update(dict.fromkeys(added, "1"))
    try:
        yield
    finally:
        for name in added:
            del os.environ[name]


def _end_with_parent() -> None:
    """End this process as soon as the one that started it is gone, however that ended."""
    parent = parent_process()

    def follow() -> None:
        if parent is not None:
            parent.join()
            os._exit(1)

    Thread(target=follow, daemon=True).start()
