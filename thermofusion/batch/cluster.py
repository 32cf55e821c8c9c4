"""Workers of a Dask cluster: of a scheduler somewhere, or of one on this machine for the time being."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Generator, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from importlib import import_module
from typing import Any

from ..errors import RecipeError, ResourceError, told_by
from .job import Job, Row, Work
from .pool import TRIES, killed, thread_limits

LOCAL = "local"  # what --scheduler calls a cluster on this machine
CONNECT_S = 30.0  # for a scheduler to answer
RECONNECTS = 10  # a scheduler that went away is waited for so often, `CONNECT_S` each
OFF = logging.CRITICAL + 1  # above all levels
AHEAD = 4  # scans a worker has waiting: enough that none idles, few enough to take back


def in_cluster(
    work: Work, jobs: Iterable[Job], scheduler: str, *, workers: int, threads: int
) -> Generator[tuple[Job, Row], None, None]:
    """Each job with its row, as they are done. scheduler : its address, or `local`. workers, threads : of a local one.

    A scan whose worker dies is begun again elsewhere, as often as the scheduler allows (Dask: three times more), and
    last once more by itself, for Dask blames all that a dead worker had waiting. When the scheduler goes and comes
    back, what was not done is given to it again. Raises RecipeError where Dask is not installed, ResourceError where no
    scheduler answers.
    """
    dask: Any = _library()
    left = {job.source.name: job for job in jobs}
    reconnects = 0
    with _quiet(), _address(dask, scheduler, workers, threads) as address:
        while left:
            try:
                with dask.Client(address, timeout=CONNECT_S, set_as_default=False) as client:
                    for name, row in _gathered(dask, client, work, left):
                        reconnects = 0
                        yield left.pop(name), row
            except (OSError, TimeoutError) as e:  # CommClosedError is an OSError
                reconnects += 1
                if reconnects > RECONNECTS:
                    text = f"the scheduler does not answer ({told_by(e)})"
                    hint = "what is finished is kept: the same command goes on from there"
                    raise ResourceError(text, place=address, hint=hint) from None
                time.sleep(1.0)


def _gathered(dask: Any, client: Any, work: Work, left: dict[str, Job]) -> Iterator[tuple[str, Row]]:
    """(name, row) as they come. Raises OSError when the scheduler is lost."""
    waiting, names = deque(left.values()), {}
    suspects: deque[Job] = deque()
    stream = dask.as_completed(loop=client.loop, raise_errors=False)

    def submit(queue: deque[Job], count: int) -> None:
        for _ in range(min(count, len(queue))):
            job = queue.popleft()
            # not pure: the same scan may be asked for again, and must then be looked at again
            future = client.submit(work, job, pure=False)
            names[future.key] = job.source.name
            stream.add(future)

    submit(waiting, AHEAD * max(1, sum(client.nthreads().values())))
    alone = False
    for future in stream:
        name = names.pop(future.key)
        if future.status == "finished":
            yield name, future.result()
        elif future.status in ("cancelled", "lost"):
            raise OSError("it went away")
        elif isinstance(future.exception(), dask.KilledWorker) and not alone:
            suspects.append(left[name])
        else:
            yield name, _failed(dask, left[name], future.exception())
        future.release()
        submit(waiting, 1)
        if not names:
            alone = True
            submit(suspects, 1)


def _failed(dask: Any, job: Job, error: BaseException) -> Row:
    """The row of a scan that did not come back: its worker died too often, or does not know this program."""
    if isinstance(error, dask.KilledWorker):
        return killed(job, TRIES, "as the scheduler says")
    why = f"the worker could not begin: {type(error).__name__}: {error}"
    return replace(Row.of(job.source), status="failed", exit_code=1, reason=" ".join(why.split())[:600], attempts=1)


@contextmanager
def _address(dask: Any, scheduler: str, workers: int, threads: int) -> Iterator[str]:
    """A scheduler's address; a local one ends with the block."""
    if scheduler != LOCAL:
        yield scheduler
        return
    settings = {"n_workers": workers, "threads_per_worker": 1, "processes": True, "dashboard_address": None}
    with dask.LocalCluster(**settings, env=thread_limits(threads), memory_limit=0, silence_logs=OFF) as cluster:
        yield cluster.scheduler_address


@contextmanager
def _quiet() -> Iterator[None]:
    """Dask's log lines stay away from the terminal: what a user needs stands in the rows."""
    known = [n for n in logging.root.manager.loggerDict if n.partition(".")[0] in ("distributed", "tornado", "asyncio")]
    before = {name: logging.getLogger(name).level for name in known}
    for name in known:
        logging.getLogger(name).setLevel(OFF)
    try:
        yield
    finally:
        for name, level in before.items():
            logging.getLogger(name).setLevel(level)


def _library() -> Any:
    try:
        return import_module("distributed")
    except ImportError:
        hint = "pip install 'thermofusion[cluster]', or leave --scheduler out"
        raise RecipeError("--scheduler needs Dask, which is not installed", hint=hint) from None
