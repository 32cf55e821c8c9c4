"""Workers on this machine: one process each, replaced when it dies. No library but Python's own.

`concurrent.futures` gives up all tasks when one of its processes is killed; here the one scan is tried again.
"""

from __future__ import annotations

import os
import signal
import threading
from collections import deque
from collections.abc import Generator, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from multiprocessing import connection, get_context, parent_process
from typing import Any

from ..errors import ResourceError, visible
from .job import FAILED, Job, Row, Work

TRIES = 3  # a scan is begun so often; a worker may die once or twice for another's fault
STILLBORN = 3  # workers in a row that die before their first word: it is not the scans' fault
PATIENCE_S = 5.0  # for a worker that was asked to end
# Before a library is loaded. BLAS threads would only wait for each other (see `cli`).
ALONE = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "BLIS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS")


def thread_limits(threads: int) -> dict[str, str]:
    """Of a worker's environment: OpenMP's threads, and one for BLAS."""
    return {"OMP_NUM_THREADS": str(threads)} | dict.fromkeys(ALONE, "1")


class _Worker:
    """A process, the pipe to it, and the scan it has."""

    def __init__(self, work: Work, threads: int) -> None:
        context = get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self.process: Any = context.Process(target=_serve, args=(work, theirs), daemon=True)
        with _environment(threads):
            self.process.start()
        theirs.close()
        self.ready = False
        self.job: tuple[Job, int] | None = None  # and how often it was begun

    def give(self, job: Job, attempt: int) -> None:
        self.job = job, attempt
        with suppress(OSError):  # it died just now: its end is seen next
            self.pipe.send(job)

    def take(self) -> Any:
        """Its word, or None where it ended in the middle of one."""
        try:
            return self.pipe.recv()
        except (EOFError, OSError):
            return None

    def end(self) -> None:
        self.pipe.close()
        self.process.terminate()
        self.process.join(PATIENCE_S)
        if self.process.is_alive():
            self.process.kill()
            self.process.join()


def in_processes(
    work: Work, jobs: Iterable[Job], *, workers: int, threads: int
) -> Generator[tuple[Job, Row], None, None]:
    """Each job with its row, as they are done. work : importable by name. threads : per worker.

    A scan whose worker dies is begun again by another one, `TRIES` times in all; then its row says so. Leaving the
    loop early ends the workers. Raises ResourceError where workers cannot be started.
    """
    waiting = deque((job, 1) for job in jobs)
    crew: list[_Worker] = []
    stillborn = 0
    try:
        while waiting or any(w.job for w in crew):
            while len(crew) < workers and len(crew) < len(waiting) + sum(w.job is not None for w in crew):
                crew.append(_Worker(work, threads))
            for worker in crew:
                if worker.ready and worker.job is None and waiting:
                    worker.give(*waiting.popleft())
            said = connection.wait([w.pipe for w in crew] + [w.process.sentinel for w in crew])
            for worker in [w for w in crew if w.pipe in said or w.process.sentinel in said]:
                word = worker.take() if worker.pipe.poll() else None
                if word == "ready":
                    worker.ready, stillborn = True, 0
                elif word is not None and worker.job is not None:
                    job, attempt = worker.job
                    worker.job = None
                    yield job, replace(word, attempts=attempt)
                else:
                    crew.remove(worker)
                    worker.process.join(PATIENCE_S)  # its pipe ends before it does
                    worker.end()
                    stillborn += not worker.ready
                    if stillborn >= STILLBORN:
                        raise ResourceError(f"workers end at once ({_death(worker.process.exitcode)})")
                    lost = _lost(worker, waiting)
                    if lost is not None:
                        yield lost
    finally:
        for worker in crew:
            worker.pipe.close()
        for worker in crew:
            worker.end()


def _lost(worker: _Worker, waiting: deque[tuple[Job, int]]) -> tuple[Job, Row] | None:
    """A dead worker's scan: begun again at once, or given up."""
    if worker.job is None:
        return None
    job, attempt = worker.job
    if attempt < TRIES:
        waiting.appendleft((job, attempt + 1))
        return None
    return job, killed(job, attempt, _death(worker.process.exitcode))


def killed(job: Job, attempts: int, how: str) -> Row:
    """The row of a scan in which workers died."""
    why = f"its worker died {attempts} times ({visible(how)}); if for want of memory, fewer --workers may help"
    return replace(Row.of(job.source), status=FAILED, exit_code=ResourceError.exit_code, reason=why, attempts=attempts)


def _death(code: int | None) -> str:
    if code is not None and code < 0:
        with suppress(ValueError):
            return signal.Signals(-code).name
    return f"exit code {code}"


@contextmanager
def _environment(threads: int) -> Iterator[None]:
    """What a process started meanwhile finds: `thread_limits`, and no Ctrl-C, which is its parent's."""
    wanted = thread_limits(threads)
    before = {name: os.environ.get(name) for name in wanted}
    os.environ.update(wanted)
    masks = hasattr(signal, "pthread_sigmask")
    if masks:
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        if masks:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
        for name, value in before.items():
            os.environ.pop(name, None) if value is None else os.environ.update({name: value})


def _serve(work: Work, pipe: Any) -> None:
    """A worker's life. Ctrl-C is its parent's business; when the parent is gone, it goes, whatever it does."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = parent_process()
    if parent is not None:
        threading.Thread(target=lambda: (connection.wait([parent.sentinel]), os._exit(1)), daemon=True).start()
    pipe.send("ready")
    while True:
        try:
            job = pipe.recv()
        except EOFError:
            return
        pipe.send(work(job))
