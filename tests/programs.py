"""Programs in interpreters of their own, and contexts in threads of their own."""

import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]


def python(*words: object, **options: Any) -> subprocess.CompletedProcess[str]:
    """What a fresh interpreter does with these words."""
    command = [sys.executable, *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, check=False, **{"timeout": 600, **options})


@contextmanager
def elsewhere(context: AbstractContextManager) -> Iterator[None]:
    """Be in a context in another thread, as another writer: a lock belongs to a process and a thread.

    What entering it raises is raised here.
    """
    with ThreadPoolExecutor(1) as pool:
        pool.submit(context.__enter__).result()
        try:
            yield
        finally:
            pool.submit(context.__exit__, None, None, None).result()
