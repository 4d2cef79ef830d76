"""Running episodes: in processes of this machine, or on the workers of a dask.distributed scheduler."""

from __future__ import annotations

import asyncio
import logging
import os
import signal
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import (
    BrokenExecutor,
    CancelledError,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    as_completed,
)
from contextlib import contextmanager
from dataclasses import replace
from multiprocessing import active_children, get_context, parent_process
from threading import Lock, Thread, current_thread, main_thread
from typing import TYPE_CHECKING

from caryatid.benchmark.episodes import Episode, Outcome, plugin_of, run_episode
from caryatid.errors import CaryatidError, InputError
from caryatid.runtime import fingerprint
from caryatid.runtime.parallel import one_blas_thread

if TYPE_CHECKING:
    from distributed import Client

Outcomes = Generator[tuple[Episode, Outcome]]

_one_at_a_time = Lock()


def run_locally(episodes: Sequence[Episode], jobs: int) -> Outcomes:
    """Run episodes in this many processes; yield each with its outcome as soon as it is done.

    Raises:
        CaryatidError: A process was killed.
    """
    others = set(active_children())
    pool = ProcessPoolExecutor(min(jobs, len(episodes)), get_context("spawn"), initializer=_end_with_parent)
    try:
        with _interrupts_ignored():
            futures = {pool.submit(run_on_worker, episode, fingerprint()): episode for episode in episodes}
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


def run_on_cluster(
    episodes: Sequence[Episode],
    address: str,
    tell: Callable[[str], None] = lambda text: None,
    patience: float = 10.0,
) -> Outcomes:
    """Run episodes on the workers of a scheduler, which must answer within `patience` [s].

    Yields each with its outcome as soon as it is done; calls `tell` if there are no workers.

    Raises:
        InputError: No scheduler answers.
        CaryatidError: The scheduler has gone, or a worker has other code.
    """
    code = fingerprint()
    with connect(address, patience) as client:
        pool = client.get_executor(pure=False)
        futures = {}
        for episode in episodes:  # workers have other working directories
            placed = replace(episode, scene=os.path.abspath(episode.scene)) if episode.content else episode
            futures[pool.submit(run_on_worker, placed, code)] = episode
        if not client.nthreads():
            tell(f"no workers; start some: dask worker {address} --nthreads 1 --nworkers N")
        for future in as_completed(futures):
            yield futures.pop(future), _cluster_outcome(future, address)


def connect(address: str, patience: float = 10.0) -> Client:
    """Connect to a scheduler of dask.distributed, which must answer within `patience` [s].

    Raises:
        InputError: No scheduler answers.
    """
    from distributed import Client, Security
    from distributed.comm import connect as open_connection

    logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # errors are reported here

    async def greet() -> None:
        """Fail at once, where a client would keep trying."""
        secrets = Security().get_connection_args("client")
        connection = open_connection(address, patience, **secrets)
        await (await asyncio.wait_for(connection, patience)).close()

    try:
        if not address:
            raise ValueError("the address is empty")
        with ThreadPoolExecutor(1) as thread:
            thread.submit(asyncio.run, greet()).result()
        return Client(address, timeout=patience, set_as_default=False)
    except (OSError, ImportError, ValueError, TypeError, RuntimeError, MemoryError) as error:
        reason = f"no scheduler answers ({' '.join(str(error).split()) or 'it is silent'})"
        remedy = "start one with `dask scheduler` and give its address, such as tcp://10.0.0.5:8786"
        raise InputError(f"--scheduler {address}", reason, remedy) from None


def run_on_worker(episode: Episode, code: str) -> Outcome:
    """Run an episode in a process of a pool or cluster, one at a time and on one thread.

    Raises:
        CaryatidError: The fingerprint of the worker's code is another, or the package of the planner is.
    """
    from numba import set_num_threads

    if fingerprint() != code:
        raise _other_code(fingerprint())
    if plugin_of(episode.planner) != episode.plugin:
        reason = f"a worker lacks the package of planner {episode.planner}, or has another version of it"
        raise CaryatidError(f"{reason}; install it there and start the worker again")
    with _one_at_a_time:
        set_num_threads(1)
        return one_blas_thread(run_episode)(episode)


def _cluster_outcome(future: Future[Outcome], address: str) -> Outcome:
    from distributed import KilledWorker

    try:
        return future.result()
    except KilledWorker as error:
        died = error.allowed_failures + 1
        return Outcome((), f"{died} workers died running it, perhaps for lack of memory")
    except CaryatidError:
        raise
    except (CancelledError, OSError):
        reason = f"the scheduler at {address} has gone; finished episodes are kept"
        raise CaryatidError(f"{reason}: start again") from None
    except Exception as error:
        raise _other_code(f"{type(error).__name__}: {error}") from None


def _other_code(found: str) -> CaryatidError:
    reason = f"a worker runs other code ({found}) than this process ({fingerprint()})"
    return CaryatidError(f"{reason}; install the same caryatid and libraries there and start it again")


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
