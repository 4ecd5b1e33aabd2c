"""Ray executor: jobs on a cluster whose nodes share the folders that they read and write."""

import signal
import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec

from sarsplat.errors import SarsplatError, shown
from sarsplat.executors.executor import J, Job, Means, work_named
from sarsplat.threads import convert

_SUBMITTED_PER_CPU = 4  # submitted jobs per processor of the cluster: `ray.wait` is slow with many


def run(jobs: Sequence[J], out: Path, means: Means) -> Iterator[tuple[J, Any]]:
    """Do jobs on a cluster, each on one processor (see `Executor`); Ray restarts those whose node has died."""
    import ray

    initialised_here = not ray.is_initialized()
    if initialised_here:
        terminate = signal.getsignal(signal.SIGTERM)
        try:
            ray.init(address=means.address, log_to_driver=False, logging_level="ERROR")
        except (ConnectionError, ValueError, RuntimeError, ray.exceptions.RayError) as error:
            raise SarsplatError(
                f"there is no Ray cluster at {shown(means.address)} ({shown(str(error))}); start one with "
                "`ray start --head`, or give its address"
            ) from error
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, terminate)  # Ray's handler ends the process silently
    running: dict[Any, J] = {}
    waiting = list(reversed(jobs))
    remote = ray.remote(_do)
    try:
        while waiting or running:
            limit = _SUBMITTED_PER_CPU * max(1, int(ray.cluster_resources().get("CPU", 1)))
            while waiting and len(running) < limit:
                job = waiting.pop()
                gpus = means.gpus if means.gpus is not None else float(job.device == "cuda")
                task = remote.options(num_cpus=1, num_gpus=gpus, max_retries=means.retries, name=job.address)
                running[task.remote(job.work, msgspec.to_builtins(job), str(out), means.again)] = job
            (ready, *_), _ = ray.wait(list(running), num_returns=1)
            job = running.pop(ready)
            yield job, _result(ray, ready, job, out)
    finally:
        for task in running:
            ray.cancel(task, force=True)
        if initialised_here:
            ray.shutdown()


def _do(work: str, job: dict[str, Any], out: str, again: bool) -> dict[str, Any] | None:
    """Run the `do` of a work remotely, with plain data as arguments and result."""
    kind = work_named(work)
    result = kind.do(convert(job, kind.job), Path(out), again)
    return None if result is None else msgspec.to_builtins(result)


def _result(ray: Any, task: Any, job: Job, out: Path) -> Any:
    work = work_named(job.work)
    try:
        answer = ray.get(task)
    except ray.exceptions.RayError as error:
        first = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        return work.lost(job, out, f"its node or process ended too often ({first}); {work.go_on}")
    return None if answer is None else convert(answer, work.result)
