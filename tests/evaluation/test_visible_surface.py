import numpy as np
import pytest

from sarsplat import SarsplatError, View, visible_surface

trimesh = pytest.importorskip("trimesh")
pytest.importorskip("embreex")

FOUR_SIDES = [View(azimuth, 45) for azimuth in (0, 90, 180, 270)]


def box(size, centre):
    return trimesh.creation.box(size, trimesh.transformations.translation_matrix(centre))


def sheet(x0, x1, y0, y1, z):
    """A horizontal rectangle of two triangles."""
    corners = [[x0, y0, z], [x1, y0, z], [x1, y1, z], [x0, y1, z]]
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)


@pytest.mark.parametrize(("azimuth", "axis", "side"), [(0, 0, 1), (90, 1, -1)])
def test_a_box_is_seen_from_above_and_from_the_radars_side_only(azimuth, axis, side):
    """At azimuth 0 the radar stands at +x, at 90°, clockwise, at −y."""
    surface = visible_surface(box((2, 2, 2), (0, 0, 1)), [View(azimuth, 45)], ray_spacing=0.01, samples=4000)
    assert surface.all_triangles.shape == (12, 3, 3)
    assert surface.triangles.shape == (4, 3, 3)
    assert surface.samples.dtype == np.float32
    top = np.isclose(surface.samples[:, 2], 2, atol=1e-5)
    assert (top | np.isclose(surface.samples[:, axis], side, atol=1e-5)).all()
    assert top.mean() == pytest.approx(0.5, abs=0.03)


def test_four_sides_see_everything_but_the_bottom():
    surface = visible_surface(box((2, 2, 2), (0, 0, 1)), FOUR_SIDES, ray_spacing=0.01, samples=20_000)
    assert len(surface.triangles) == 10
    assert len(surface.samples) == len(surface.samples_whole) == 20_000
    assert np.isclose(surface.samples[:, 2], 2, atol=1e-5).mean() == pytest.approx(1 / 5, abs=0.015)
    assert surface.samples[:, 2].min() > 1e-4
    assert np.isclose(surface.samples_whole[:, 2], 0, atol=1e-5).mean() == pytest.approx(1 / 6, abs=0.015)


def test_a_large_scene_takes_no_more_rays_than_are_allowed(monkeypatch):
    """A square kilometre a millimetre apart would be 10¹² rays."""
    monkeypatch.setattr("sarsplat.evaluation.surface._MAX_RAYS", 10_000)
    plain = sheet(-500, 500, -500, 500, 0)
    plain.invert()  # surfaces are two-sided
    surface = visible_surface(plain, [View(0, 45)], ray_spacing=0.001, samples=1000)
    assert len(surface.triangles) == 2
    assert len(surface.samples) == 1000


def test_samples_in_shadow_are_rejected_though_their_triangle_is_visible():
    # a 2 m cube on a floor, seen from +x at 45°: the shadow covers −3 < x < −1 beside |y| < 1 and the foot |x| < 1
    scene = trimesh.util.concatenate([box((2, 2, 2), (0, 0, 1)), sheet(-5, 5, -5, 5, 0)])
    surface = visible_surface(scene, [View(0, 45)], ray_spacing=0.01, samples=50_000)
    assert len(surface.samples) == 50_000
    x, y, z = surface.samples.T
    floor = np.isclose(z, 0, atol=1e-5) & (x < 0.999)
    assert not (floor & (x > -2.999) & (np.abs(y) < 0.999)).any()
    # lit: the floor without shadow and foot (100 − 8 m²), the top and the near side (4 m² each)
    assert np.isclose(z, 0, atol=1e-5).mean() == pytest.approx(92 / 100, abs=0.005)


def test_what_no_ray_hits_is_not_visible():
    # a sheet below another one of the same extent: hidden from steep views
    scene = trimesh.util.concatenate([sheet(-1, 1, -1, 1, 1), sheet(-0.5, 0.5, -0.5, 0.5, 0.9)])
    surface = visible_surface(scene, [View(azimuth, 80) for azimuth in (0, 120, 240)], ray_spacing=0.01, samples=100)
    assert np.allclose(surface.triangles[..., 2], 1)


def test_more_than_one_batch_of_rays(monkeypatch):
    monkeypatch.setattr("sarsplat.evaluation.surface._BATCH", 1000)
    ball = trimesh.creation.icosphere(subdivisions=2)
    surface = visible_surface(ball, FOUR_SIDES, samples=10, ray_spacing=0.02)
    monkeypatch.undo()
    assert np.array_equal(surface.triangles, visible_surface(ball, FOUR_SIDES, samples=10, ray_spacing=0.02).triangles)


def test_samples_depend_on_the_seed_alone():
    mesh = trimesh.creation.icosphere(subdivisions=1)
    first, again, other = (
        visible_surface(mesh, FOUR_SIDES, ray_spacing=0.01, samples=100, seed=seed) for seed in (3, 3, 4)
    )
    assert np.array_equal(first.samples, again.samples)
    assert np.array_equal(first.samples_whole, again.samples_whole)
    assert not np.array_equal(first.samples, other.samples)


def test_bad_input_is_told():
    mesh = box((1, 1, 1), (0, 0, 0))
    with pytest.raises(SarsplatError, match="at least one view"):
        visible_surface(mesh, [], ray_spacing=0.01)
    for words in ({"ray_spacing": float("nan")}, {"ray_spacing": 0.1, "samples": 0}):
        with pytest.raises(SarsplatError, match="give a number"):
            visible_surface(mesh, [View(0, 45)], **words)
    with pytest.raises(SarsplatError, match="spacing of 50 m"):
        visible_surface(mesh, [View(0, 45)], ray_spacing=50)
    line = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], process=False)
    with pytest.raises(SarsplatError, match="no surface"):
        visible_surface(line, [View(0, 45)], ray_spacing=0.01)
