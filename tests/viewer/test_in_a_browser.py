"""The page in a headless Chromium, of runs and of trainings, of which watching changes nothing."""

import socket
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from chromium import chromium
from sarsplat import Trainer, View, reconstruct
from sarsplat.viewer import viewer
from sarsplat.viewer.subject import dataset_subject, scene_of, training_subject

pytest.importorskip("viser")

HEADS = "[...document.querySelectorAll('.heads')].map(e => e.innerText).join('\\n')"
FOOT = "document.querySelector('#foot')?.innerText ?? ''"
PICTURE = "document.querySelector('img[src^=\"blob:\"]')"
PIXELS = (
    "(i => {const c = document.createElement('canvas'); c.width = i.naturalWidth; c.height = i.naturalHeight;"
    f"c.getContext('2d').drawImage(i, 0, 0); return c.toDataURL()}})({PICTURE})"
)
AZIMUTH = "document.querySelector('[role=slider]')"
SHOWN_AZIMUTH = f"Number({AZIMUTH}.getAttribute('aria-valuenow'))"
PLACE = "(b => [b.left, b.top, b.width, b.height])({}.getBoundingClientRect())"


@pytest.fixture
def browser(viewer):
    with chromium() as browser:
        browser.page.size(1300, 420)
        browser.page.open(f"{viewer.address}/")
        browser.page.until(HEADS, lambda text: "rendered" in text)
        browser.page.until(f"{PICTURE} !== null && {PICTURE}.complete")
        yield browser


def test_a_drag_changes_the_image_a_click_lights_what_makes_a_pixel_and_nobody_else_is_asked(viewer, browser):
    page = browser.page
    before, heads = page.value(PIXELS), page.value(HEADS)
    assert heads.count("azimuth") >= 1 and "difference" in heads

    # the first slider, azimuth: its thumb is dragged to the right
    left, top, width, height = page.until(PLACE.format(AZIMUTH))
    azimuth = page.value(SHOWN_AZIMUTH)
    page.mouse("mousePressed", left + width / 2, top + height / 2)
    for step in range(1, 6):
        page.mouse("mouseMoved", left + width / 2 + 6 * step, top + height / 2)
        azimuth = page.until(SHOWN_AZIMUTH, lambda shown, last=azimuth: shown > last)
    page.mouse("mouseReleased", left + width / 2 + 30, top + height / 2)
    page.until(HEADS, lambda text: text.startswith(f"rendered\nazimuth {azimuth:.1f}°"))  # all of the drag has come
    assert viewer.wait(60) and viewer.view.azimuth_deg == pytest.approx(azimuth)
    page.until(PIXELS, lambda shown: shown != before)

    # the brightest pixel of the rendered image is clicked
    image = viewer._subject.render(viewer.view)
    row, column = np.unravel_index(image.argmax(), image.shape)
    x, y, width, height = page.value(PLACE.format(PICTURE))
    strip, part = viewer._strip, viewer._part
    row_in = round((viewer._subject.grid.range_m[row] - part.range_m[0]) / part.spacing_m[1])
    column_in = round((viewer._subject.grid.azimuth_m[column] - part.azimuth_m[0]) / part.spacing_m[0])
    total = strip.count * (strip._width + 6) - 6
    page.click(
        x + width * (column_in + 0.5) / part.columns * strip._width / total, y + height * (row_in + 0.5) / part.rows
    )
    page.until(FOOT, lambda text: f"Row {row}, column {column}" in text)
    assert "Gaussians at heights of" in page.value(FOOT)
    assert (viewer.pixel.row, viewer.pixel.column) == (row, column)

    asked = browser.quit()
    socket = viewer.address.replace("http", "ws")
    assert any(address.startswith(socket) for address in asked)
    assert [address for address in asked if not address.startswith((viewer.address, socket))] == []


@pytest.mark.parametrize("width", [390, 1400])
def test_images_are_large_and_the_radar_is_in_sight(viewer, browser, width):
    page = browser.page
    page.size(width, 850)
    page.open(f"{viewer.address}/")
    page.until(f"{PICTURE} !== null && {PICTURE}.complete && {PICTURE}.offsetWidth > 0")
    left, top, wide, _ = page.value(PLACE.format(PICTURE))
    page.value("new Promise(done => setTimeout(done, 1000))")  # the camera moves when the page is there
    x, y = _on_the_screen(viewer, page, viewer._stage._at(viewer.view))
    if width == 390:  # the images come first on a sheet below, then the controls
        assert left < 20 and wide > 350
        assert page.value("document.querySelector('canvas').getBoundingClientRect().top") == 0
        assert top < page.value(PLACE.format(AZIMUTH))[1]
        head = page.value(PLACE.format("document.querySelector('.heads')"))[1]
        assert 0 < x < 390 and 0 < y < head
        page.click(100, head - 70)  # the head of the sheet folds it
        page.until(PLACE.format("document.querySelector('.heads')"), lambda place: place[1] > 780 or place[3] == 0)
    else:
        assert wide > 500  # two of them
        canvas = page.value(PLACE.format("document.querySelector('canvas')"))
        assert canvas[0] < x < canvas[0] + canvas[2] and 0 < y < 850


@pytest.mark.slow
def test_the_radar_is_dragged_in_the_scene(viewer, browser):
    page = browser.page
    page.size(1400, 850)
    viewer.look_from(View(80.0, 40.0))
    page.until(HEADS, lambda text: "azimuth 80.0°, grazing 40.0°" in text)
    place = _on_the_screen(viewer, page, viewer._stage._at(viewer.view))
    page.mouse("mousePressed", *place)
    for step in range(1, 8):
        page.mouse("mouseMoved", place[0] - 6 * step, place[1] + 2 * step)
        page.value("new Promise(done => setTimeout(done, 120))")
    page.mouse("mouseReleased", place[0] - 42, place[1] + 14)
    page.until(HEADS, lambda text: "azimuth 80.0°, grazing 40.0°" not in text)
    assert viewer.wait(60)
    dragged_to = _on_the_screen(viewer, page, viewer._stage._at(viewer.view))
    assert np.hypot(dragged_to[0] - place[0] + 42, dragged_to[1] - place[1] - 14) < 25


def _on_the_screen(viewer, page, place: np.ndarray) -> tuple[float, float]:
    """Where the page shows a place of the scene."""
    client = list(viewer._server.get_clients().values())[-1]
    camera, wxyz = client.camera, client.camera.wxyz
    from scipy.spatial.transform import Rotation

    x, y, z = Rotation.from_quat(wxyz, scalar_first=True).as_matrix().T @ (place - camera.position)
    left, top, width, height = page.value(PLACE.format("document.querySelector('canvas')"))
    scale = height / 2 / np.tan(camera.fov / 2)
    return left + width / 2 + scale * x / z, top + height / 2 + scale * y / z


# ---- watching a training changes nothing of it -----------------------------------------------------------------------
def test_a_watched_training_learns_the_same_bits(dataset, config, finished, monkeypatch):
    monkeypatch.setattr(viewer, "_SHARE", 1e9)  # drawn after every step
    said, drawn = [], []
    with viewer.watched(dataset, 0, said.append) as show:

        def after_step(step):
            show(step)
            drawn.append(step.iteration)

        run = reconstruct(dataset, config, on_step=after_step, quiet=True)
    assert drawn == list(range(1, config.iterations + 1))
    assert said[0].startswith("open http://127.0.0.1:")
    for name, tensor in finished.snapshot.tensors.items():
        assert torch.equal(tensor, run.snapshot.tensors[name]), name


def test_the_page_shows_the_newest_state(dataset, config):
    trainer, pictures = Trainer(dataset, config), []
    with viewer.Viewer(dataset_subject(dataset)) as page:
        for _ in range(2):
            for _ in range(5):
                trainer.step()
            page.show(training_subject(dataset, trainer))
            assert page.wait(60)
            pictures.append(page._controls._rows[0][1].image.copy())
        assert "10 steps" in page._controls.title.content
    assert pictures[0].shape == pictures[1].shape
    assert not np.array_equal(*pictures)


def test_the_time_that_it_takes_is_a_small_share(monkeypatch):
    clock, cost, shown = [100.0], 0.5, []

    def draw(timeout_s: float) -> None:
        clock[0] += cost

    monkeypatch.setattr(viewer.time, "monotonic", lambda: clock[0])
    page = SimpleNamespace(_pause_until=0.0, show=shown.append, wait=draw)
    for _ in range(10_000):
        viewer.Viewer.keep_up(page, SimpleNamespace)
        clock[0] += 0.01
    assert len(shown) >= 3
    assert len(shown) * cost <= 0.05 * 10_000 * 0.01 + cost


def test_gaussians_of_ones_own_loop_are_shown_and_followed(finished, monkeypatch):
    """By whatever they are now, in pixels that show all of them; the loop's own tensors stay differentiable."""
    monkeypatch.setattr(viewer, "_SHARE", 1e9)
    gaussians, pictures = finished.gaussians, []
    moving = gaussians.means.clone().requires_grad_()
    with viewer.Viewer(gaussians) as page:
        assert page.wait(60)
        for _ in range(2):
            pictures.append(page._controls._rows[0][1].image.copy())
            assert pictures[-1].max() > 100
            with torch.no_grad():
                moving[:, 0] += 1.0
            page.update(gaussians.with_tensors(means=moving))
            assert page.wait(60)
        assert f"{len(gaussians):,} Gaussians" in page._controls.title.content
        server = page._server
    assert not np.array_equal(*pictures)
    assert moving.requires_grad
    view = View(10.0, 20.0)  # on a grid of one's own
    scene = scene_of(gaussians, finished.grid, [view])
    assert scene.views == [(view, "train")]
    np.testing.assert_allclose(scene.render(view), finished.render([view])[0], rtol=0.05, atol=0.05 * scene.peak)
    with pytest.raises(OSError):
        socket.create_connection(("127.0.0.1", server.get_port()), 1)
