"""`sarsplat sweep`: carry out the runs of a plan, and tabulate their scores."""

import shlex
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from sarsplat.cli import console
from sarsplat.cli.arguments import Folder, Group, Workers, one_of
from sarsplat.cli.signals import keeping
from sarsplat.errors import counted
from sarsplat.executors import EXECUTORS, Means

_FAILED = 1  # exit code if a run has failed

Device = Literal["cpu", "cuda"]

if TYPE_CHECKING:
    ExecutorName = str
else:
    ExecutorName = tyro.extras.literal_type_from_choices(EXECUTORS)


def sweep(
    plan: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PLAN")],
    *,
    out: Folder,
    executor: ExecutorName = "local",
    device: Annotated[Device | None, one_of(Device)] = None,
    workers: Group[Workers],
    shard: Annotated[str | None, tyro.conf.arg(metavar="I/N", help_behavior_hint="(optional)")] = None,
    again: bool = False,
    show: bool = False,
) -> int:
    """Reconstruct and score every combination of datasets, methods, settings and seeds of a plan.

    Parameters
    ----------
    plan
        TOML file: datasets (patterns), methods, preset, seeds, and settings, of which every list is swept
        (docs/how-to/sweep.md).
    out
        Folder of the sweep: results.csv, index.html and the runs. Only missing runs are done:
        Ctrl-C stops at once, and the same command continues.
    executor
        Executor: local, this machine, or ray, a Ray cluster.
    device
        Device of the trainings, cpu or cuda (default: as the plan says).
    workers
        Local processes, or Ray cluster; a job is a run.
    shard
        Only a share of the runs, such as 2/8, the second of eight: for job arrays.
    again
        Also repeat failed runs.
    show
        Only write and show the results so far.
    """
    from sarsplat.sweeps import sweep as do

    means = Means(**asdict(workers), again=again)
    words = shlex.join(["sarsplat", "sweep", str(plan), "--out", str(out)])
    with keeping(lambda: f"what is finished is kept, and `{words}` with the same options continues"):
        results = do(plan, out, executor=executor, means=means, device=device, shard=shard, run=not show)
    console.show(results.table())
    if worse := results.beaten:
        console.warn(worse)
    done = sum(one.finished for one in results.results)
    console.finish(
        f"{out / 'results.csv'} and {out / 'index.html'}: {done} of {counted(len(results.results), 'run')}",
        f"open {out / 'index.html'} in a browser",
    )
    if not (failed := results.failed):
        return 0
    reasons = Counter(one.reason for one in failed)
    reason = reasons.most_common(1)[0][0]
    first = next(one for one in failed if one.reason == reason)
    more = f" (and {counted(len(reasons) - 1, 'other reason')})" if len(reasons) > 1 else ""
    console.complain(
        f"{len(failed)} of {counted(len(results.results), 'run')} failed: {reason}{more}; the first is "
        f"{results.called(first)}"
    )
    return _FAILED
