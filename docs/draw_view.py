"""The page of `sarsplat view`, as a browser shows it.

Run as `python docs/draw_view.py RUN`, with a run of simulated images. Writes docs/images/view.png. Needs Chromium.
"""

from __future__ import annotations

import io
import sys
import time
from pathlib import Path

import numpy as np
from PIL import Image

from sarsplat import View
from sarsplat.radar import Pixel
from sarsplat.viewer import Viewer, subject_at

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE.parent / "tests"))
from chromium import chromium  # noqa: E402

PICTURE = HERE / "images" / "view.png"
SIZE = (1400, 900)
VIEW = View(50.0, 35.0)
SECONDS = 60  # in which the scene fades in, drawn in software


def main(run: str) -> None:
    """Draw one view with the brightest pixel picked."""
    viewer = Viewer(subject_at(run))
    viewer.look_from(VIEW)
    image = subject_at(run).render(VIEW)
    row, column = np.unravel_index(image.argmax(), image.shape)
    viewer.pick(Pixel(int(row), int(column)))
    viewer.wait(60)
    with chromium() as browser:
        page = browser.page
        page.size(*SIZE)
        page.open(f"{viewer.address}/")
        page.until("document.querySelector('.heads') !== null")
        page.until("document.querySelector('.mantine-Notification-closeButton') !== null", timeout_s=SECONDS)
        page.value("document.querySelector('.mantine-Notification-closeButton').click()")  # "software rendering"
        time.sleep(SECONDS)
        shot = Image.open(io.BytesIO(page.picture()))
    viewer.close()
    shot.convert("RGB").save(PICTURE, optimize=True)


if __name__ == "__main__":
    main(sys.argv[1])
