"""Running episodes in processes of this machine."""

from __future__ import annotations

import os
import signal
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from multiprocessing import active_children, get_context, parent_process
from threading import Thread, current_thread, main_thread

from caryatid.benchmark.episodes import Episode, Outcome, run_episode
from caryatid.errors import CaryatidError
from caryatid.runtime.parallel import one_blas_thread


def run_locally(episodes: Sequence[Episode], jobs: int) -> Generator[tuple[Episode, Outcome]]:
    """Run episodes in this many processes; yield each with its outcome as soon as it is done.

    Raises:
        CaryatidError: A process was killed.
    """
    others = set(active_children())
    pool = ProcessPoolExecutor(min(jobs, len(episodes)), get_context("spawn"), initializer=_end_with_parent)
    try:
        with _interrupts_ignored():
            futures = {pool.submit(_run_alone, episode): episode for episode in episodes}
        for future in as_completed(futures):
            yield futures.pop(future), future.result()
    except BrokenExecutor:
        reason = "a process was killed, perhaps for lack of memory; finished episodes are kept"
        raise CaryatidError(f"{reason}: start again, with fewer --jobs") from None
    except BaseException:
        for process in set(active_children()) - others:
            process.terminate()
        raise
    finally:
        pool.shutdown(cancel_futures=True)


def _run_alone(episode: Episode) -> Outcome:
    """Run an episode on one thread, because each core has a process."""
    from numba import set_num_threads

    set_num_threads(1)
    return one_blas_thread(run_episode)(episode)


def _end_with_parent() -> None:
    """End this process as soon as its parent is gone, for any reason."""
    parent = parent_process()
    assert parent is not None

    def follow() -> None:
        parent.join()
        os._exit(1)

    Thread(target=follow, daemon=True).start()


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """Ignore Ctrl-C while processes are started; they keep ignoring it, and end with this one."""
    if current_thread() is not main_thread():
        yield
        return
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, handler)
