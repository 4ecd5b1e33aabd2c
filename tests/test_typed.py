"""Types that are new to msgspec are learned by several threads at once."""

import subprocess
import sys

import numpy as np

from sarsplat import Dataset, DatasetEntry, ImageGrid, View, write_dataset

READ_AT_ONCE = """
import sys, threading
from pathlib import Path
from sarsplat.data.dataset_folder import read_header
sys.setswitchinterval(1e-6)
begin, read = threading.Barrier(3), []
def thread():
    begin.wait()
    read.append(read_header(Path(sys.argv[1])))
threads = [threading.Thread(target=thread) for _ in range(3)]
[one.start() for one in threads]
[one.join() for one in threads]
assert read[0] == read[1] == read[2]
"""


def test_threads_that_read_their_first_dataset_together_do_not_end_the_process(tmp_path):
    grid, entries = ImageGrid(2, 2, (0.3, 0.3), (0.3, 0.3)), (DatasetEntry(View(0.0, 40.0), "train", "0"),)
    write_dataset(tmp_path / "set", Dataset(grid, entries, np.ones((1, 2, 2), np.float32), target="a thing"))
    done = subprocess.run([sys.executable, "-c", READ_AT_ONCE, tmp_path / "set"], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
