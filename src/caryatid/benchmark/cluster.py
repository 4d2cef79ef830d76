"""Running episodes on a cluster, through a scheduler of dask.distributed that is there already."""

from __future__ import annotations

import asyncio
import logging
import os
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from dataclasses import replace
from queue import Empty, Queue
from threading import Lock
from typing import TYPE_CHECKING

from caryatid.benchmark.episodes import run_episode
from caryatid.benchmark.plugins import plugin_of
from caryatid.benchmark.records import Episode, Outcome
from caryatid.errors import CaryatidError, InputError
from caryatid.runtime.fingerprint import fingerprint
from caryatid.runtime.threads import one_blas_thread

if TYPE_CHECKING:
    from distributed import Client, Future

PATIENCE = 10.0
"""How long a scheduler may take to answer [s]."""

_ONE_AT_A_TIME = Lock()


class ClusterExecutor:
    """Runs episodes on the workers of a scheduler; those whose worker dies are run again on another.

    Args:
        address: Of the scheduler, say `tcp://10.0.0.5:8786`.
        tell: Told what the user should know while waiting.
        patience: How long the scheduler may take to answer [s].
    """

    def __init__(
        self, address: str, tell: Callable[[str], None] = lambda text: None, *, patience: float = PATIENCE
    ) -> None:
        self._address = address
        self._tell = tell
        self._patience = patience

    def check(self) -> None:
        """See whether the scheduler answers.

        Raises:
            InputError: dask.distributed is not installed, or no scheduler answers.
        """
        self._connected().close()

    def run(self, episodes: Sequence[Episode]) -> Generator[tuple[Episode, Outcome]]:
        """Yield each episode with its outcome as soon as it is done.

        Raises:
            InputError: dask.distributed is not installed, or no scheduler answers.
            CaryatidError: A worker runs other code than this process, or the scheduler is gone.
        """
        with self._connected() as client:
            self._check_workers(client)
            scenes = [_from_anywhere(e) for e in episodes]
            futures = client.map(run_on_worker, scenes, code=fingerprint(), pure=False)
            waiting = {future.key: episode for future, episode in zip(futures, episodes, strict=True)}
            for future in self._completed(client, futures):
                yield waiting.pop(future.key), self._outcome(future)
                future.release()

    def _completed(self, client: Client, futures: Sequence[Future]) -> Iterator[Future]:
        """Yield what is done as soon as it is; say so where there is nobody to do it."""
        done: Queue[Future] = Queue()
        for future in futures:
            future.add_done_callback(done.put)
        left, told = len(futures), False
        while left:
            try:
                yield done.get(timeout=self._patience)
                left -= 1
            except Empty:
                alone = _deserted(client)
                if alone and not told:
                    self._tell(
                        f"no workers; waiting for some: dask worker {self._address} --nthreads 1 --nworkers N"
                    )
                told = alone

    def _outcome(self, future: Future) -> Outcome:
        from distributed import KilledWorker

        try:
            outcome: Outcome = future.result()
        except KilledWorker as error:
            died = error.allowed_failures + 1
            return Outcome((), f"{died} workers died running it, perhaps for want of memory")
        except CaryatidError:
            raise
        except (CancelledError, OSError):
            raise CaryatidError(
                f"the scheduler at {self._address} is gone; what is done is kept: start again"
            ) from None
        except Exception as error:
            raise _other_code("a worker", f"{type(error).__name__}: {error}") from None
        return outcome

    def _connected(self) -> Client:
        """A client of the scheduler."""
        try:
            from distributed import Client, Security
            from distributed.comm import connect
        except ImportError:
            raise InputError(
                "--scheduler", "needs dask.distributed", 'pip install "caryatid[cluster]"'
            ) from None

        logging.getLogger("distributed.client").setLevel(logging.CRITICAL)  # what it says is said here

        async def greet() -> None:
            secrets = Security().get_connection_args("client")
            comm = await asyncio.wait_for(connect(self._address, self._patience, **secrets), self._patience)
            await comm.close()

        try:
            with ThreadPoolExecutor(1) as thread:
                thread.submit(asyncio.run, greet()).result()
            return Client(self._address, timeout=self._patience, set_as_default=False)
        except (OSError, ImportError, ValueError, TypeError, RuntimeError, MemoryError) as error:
            raise InputError(
                f"--scheduler {self._address}",
                f"no scheduler answers ({' '.join(str(error).split()) or 'it is silent'})",
                "start one with `dask scheduler` and give the address it tells, such as tcp://10.0.0.5:8786",
            ) from None

    def _check_workers(self, client: Client) -> None:
        """Compare the code of the workers there are with this process's; a later one compares its own."""
        for worker, code in client.run(fingerprint, on_error="return").items():
            if code != fingerprint() and not isinstance(code, OSError):
                raise _other_code(f"worker {worker}", str(code))


def run_on_worker(episode: Episode, code: str) -> Outcome:
    """Run an episode on a worker, one at a time and on one thread, whatever threads the worker has.

    Args:
        episode: What to run; a scene folder must be readable here.
        code: Fingerprint the worker's code must have.

    Raises:
        CaryatidError: It has another, or another package that offers the planner.
    """
    from numba import set_num_threads

    if fingerprint() != code:
        raise _other_code("a worker", fingerprint())
    if plugin_of(episode.planner) != episode.plugin:
        raise CaryatidError(
            f"a worker has not the same package that offers the planner {episode.planner}; "
            "install it there and start the worker again"
        )
    with _ONE_AT_A_TIME:
        set_num_threads(1)
        return one_blas_thread(run_episode)(episode)


def _deserted(client: Client) -> bool:
    """Whether the scheduler says that it has no workers."""
    try:
        return not client.nthreads()
    except OSError:
        return False


def _other_code(worker: str, found: str) -> CaryatidError:
    return CaryatidError(
        f"{worker} runs other code ({found}) than this process ({fingerprint()}); "
        "install the same caryatid and the same libraries there and start it again"
    )


def _from_anywhere(episode: Episode) -> Episode:
    """The episode with the full path of its scene folder: workers have other current folders."""
    return replace(episode, scene=os.path.abspath(episode.scene)) if episode.content else episode
