import json
import re
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from made import dataset_of
from made_runs import METRICS, POINT_KEYS, MadeUpRun
from programs import elsewhere
from sarsplat import Dataset, ImageGrid, Run, SarsplatError, SarsplatWarning, View, evaluate_run, write_dataset
from sarsplat.data.folders import only_writer
from sarsplat.evaluation import IMAGE_METRICS, UNSEEN_METRICS, log_correlation, nats_per_pixel, psnr_db, register
from sarsplat.evaluation.lpips import WEIGHTS_VARIABLE
from sarsplat.runs.run_folder import InMemory, RunFolder

trimesh = pytest.importorskip("trimesh")

SIZE = 64
GRID = ImageGrid(SIZE, SIZE, (0.3, 0.3), (0.3, 0.3))
CUBE = trimesh.creation.box((2, 2, 2), trimesh.transformations.translation_matrix((0, 0, 1)))
ON_THE_TOP = np.stack([*(a.ravel() for a in np.meshgrid(*[np.linspace(-1, 1, 30)] * 2)), np.full(900, 2.0)], axis=1)
LID = trimesh.Trimesh([[-1, -1, 2], [1, -1, 2], [1, 1, 2], [-1, 1, 2]], [[0, 1, 2], [0, 2, 3]])
WEIGHTS = Path(__file__).resolve().parents[3] / "shared" / "data" / "weights"
IMAGE_KEYS = [metric.key for metric in IMAGE_METRICS]
UNSEEN_KEYS = [metric.key for metric in UNSEEN_METRICS]
NOISE_FREE_ONLY, SPECKLED_ONLY = IMAGE_KEYS[:4], IMAGE_KEYS[4:]


def fake_run(dataset: Dataset, *, points=ON_THE_TOP, power=1.0, mesh=LID, path: Path | None = None) -> Any:
    """Run that renders `power` times what it is asked for, and notes the views; `mesh` may be an error to raise."""
    run = MadeUpRun(dataset=dataset, points=points, path=path, time_s=12.5, seed=3, method="sar-gs", metrics=None)
    run.asked, run.power = [], power
    run.store = RunFolder(path) if path else InMemory(None, [])
    run.keep, run.views_of = partial(Run.keep, run), partial(Run.views_of, run)
    run.normals = np.tile(np.float32([0, 0, 1]), (len(points), 1))

    def reconstructed() -> Any:
        if isinstance(mesh, SarsplatError):
            raise mesh
        return mesh

    def masks(views: list[View]) -> np.ndarray:
        low = np.zeros((len(views), SIZE, SIZE), np.uint8)
        low[:, 20:30, 20:40], low[:, 30:40, 20:40] = 1, 2
        return low

    def render(views: list[View]) -> np.ndarray:
        run.asked += views
        return np.stack([run.power * image(view.azimuth_deg) for view in views])

    run.mesh, run.masks, run.render = reconstructed, masks, render
    return run


def image(azimuth: float) -> np.ndarray:
    """Smooth positive power that depends on the azimuth."""
    x = np.arange(SIZE) / SIZE
    return (1.5 + np.sin(6 * x[:, None] + np.radians(azimuth)) * np.cos(5 * x)).astype(np.float32)


@pytest.fixture(autouse=True)
def no_weights(monkeypatch):
    monkeypatch.delenv(WEIGHTS_VARIABLE, raising=False)


@pytest.fixture
def make(tmp_path):
    def dataset(looks=None, ground=False, mesh=CUBE, scale=1.0, clean_tests=False) -> Dataset:
        splits = ("train", "test-17", "train", "test-15", "test-17")
        views = [(View(80.0 * k, 45), split) for k, split in enumerate(splits)]
        images = np.stack([scale * image(view.azimuth_deg) for view, _ in views]).astype(np.float32)
        if looks:
            speckle = np.random.default_rng(0).exponential(size=images.shape).astype(np.float32) + np.float32(1e-3)
            images *= np.where(np.array([clean_tests and s != "train" for s in splits])[:, None, None], 1, speckle)
        fields = {"looks": looks, "clean_tests": clean_tests, "ground": ground, "score_margin": 24 if looks else 0}
        made = dataset_of(GRID, views, images, **fields)
        return write_dataset(tmp_path / "dataset", made, truth_mesh=mesh, overwrite=True)

    return dataset


def test_every_key_is_there_every_null_has_its_reason_and_points_are_held_against_both_surfaces(make):
    metrics = evaluate_run(fake_run(make(), power=1.1))
    assert list(metrics) == [
        *("images", "by_image", "points", "mesh", "truth", "masks", "baselines"),
        *("time_s", "undetermined", "missing", "seed", "method", "definitions", "parameters", "reasons"),
    ]
    assert list(metrics["definitions"]) == [metric.key for metric in METRICS]
    assert list(metrics["images"]) == ["test-17", "test-15"]
    assert list(metrics["points"]) == list(metrics["mesh"]) == ["visible", "whole"]
    nulls = {"undetermined", "missing"}
    for kind, keys in (("images", UNSEEN_KEYS), ("points", POINT_KEYS), ("mesh", POINT_KEYS)):
        for name, row in metrics[kind].items():
            assert list(row) == keys
            nulls |= {f"{kind}.{name}.{key}" for key, value in row.items() if value is None}
    assert set(metrics["reasons"]) == nulls
    assert (metrics["time_s"], metrics["seed"]) == (12.5, 3)
    assert json.loads(json.dumps(metrics, allow_nan=False)) == metrics

    points, mesh = metrics["points"], metrics["mesh"]["visible"]
    assert points["visible"]["accuracy_m"] == pytest.approx(0, abs=1e-9)
    assert points["visible"]["precision@0.3"] == 1.0
    assert points["visible"]["count"] == points["whole"]["count"] == 900
    # the bottom is seen from nowhere: it lowers the whole surface's recall only
    assert points["whole"]["recall@0.3"] < points["visible"]["recall@0.3"] < 1
    assert points["visible"]["f1@0.1"] < points["visible"]["f1@0.3"]
    assert mesh["accuracy_m"] == pytest.approx(0, abs=1e-6)  # of points spread over it
    assert mesh["count"] > points["visible"]["count"]
    assert 0 < mesh["completeness_m"] < points["visible"]["completeness_m"]


def test_a_rendered_set_is_scored_by_protocol_r(make):
    run = fake_run(make(), power=1.1)
    metrics = evaluate_run(run)
    truth, train = run.dataset.images("test-17"), run.dataset.images("train")
    scores, each = metrics["images"]["test-17"], metrics["by_image"]["test-17"]
    assert [view.azimuth_deg for view in run.asked] == [80, 320, 240]  # set by set, in order
    assert scores["psnr_db"] == pytest.approx(psnr_db(truth, np.float32(1.1) * truth, float(np.sqrt(train.max()))))
    assert (each["metric"], np.mean(each["scores"])) == ("psnr_db", pytest.approx(scores["psnr_db"]))
    assert 0.9 < scores["ssim"] < 1
    for kind in ("points", "mesh"):  # on the lid of a box
        found = metrics[kind]["visible"]
        assert found["normals_deg"] == pytest.approx(0, abs=1e-3)
        assert found["normals_off@30"] < 0.01  # at its edges a side may be as near
    assert metrics["parameters"]["reference_amplitude"] == pytest.approx(float(np.sqrt(train.max())))
    assert [scores[key] for key in SPECKLED_ONLY] == [None] * 4
    assert "speckle" in metrics["reasons"]["images.test-17.nats_per_pixel"]
    assert scores["lpips"] is None
    assert WEIGHTS_VARIABLE in metrics["reasons"]["images.test-17.lpips"]


def test_what_is_left_out_keeps_its_scores(make) -> None:
    run = fake_run(make(), mesh=trimesh.Trimesh())
    run.metrics = before = evaluate_run(run, quiet=True)
    del run.points  # they are not asked for
    run.power = 1.5
    after = evaluate_run(run, points=False, quiet=True)
    assert after["images"] != before["images"]
    assert after["points"] == before["points"] and after["points"]["visible"]["cd_m"] > 0
    assert after["reasons"]["mesh.whole.cd_m"] == "the points make no surface"
    assert {**after, "images": None, "by_image": None} == {**before, "images": None, "by_image": None}
    for changed in (None, {"points": {}}, {"truth": {**before["truth"], "sha256": "of another mesh"}}):
        run.metrics = None if changed is None else before | changed
        assert evaluate_run(run, points=False, quiet=True)["reasons"]["points.visible.cd_m"] == "points were left out"


def test_what_is_being_done_is_told_and_how_far(make, capsys, monkeypatch):
    monkeypatch.setattr("sarsplat.progress._SECONDS_BETWEEN_LINES", 0)
    evaluate_run(fake_run(make()))
    lines = capsys.readouterr().out.splitlines()
    counts = [tuple(map(int, re.search(r": (\d+)/(\d+) ", line).groups())) for line in lines]
    assert counts == sorted(counts)
    assert {total for _, total in counts} == {counts[-1][0]}  # and at the end all is done
    for stage in ("test views", "what the views see", "visible surface", "whole surface"):
        assert any(stage in line for line in lines)
    evaluate_run(fake_run(make()), quiet=True)
    assert capsys.readouterr().out == ""


def test_a_measured_set_is_scored_by_protocol_m_whatever_its_unit(make, tmp_path):
    run = fake_run(make(looks=1, ground=True, mesh=None, scale=50.0), power=50.0)
    metrics = evaluate_run(run)
    truth, mean = run.dataset.images("test-17"), run.dataset.images("train").mean(dtype=float)
    rendered = run.render(run.dataset.select("test-17").views)
    scores = metrics["images"]["test-17"]
    assert scores["nats_per_pixel"] == pytest.approx(nats_per_pixel(truth / mean, rendered / mean, 24))
    assert scores["nats_per_pixel"] < 2  # and not log 50 higher
    registered = register(truth / mean, rendered / mean, 24).nats.mean()
    assert scores["registered_nats_per_pixel"] == pytest.approx(registered, abs=1e-5)
    assert registered < scores["nats_per_pixel"]
    assert scores["log_correlation"] == pytest.approx(log_correlation(truth, rendered, 24))
    assert [key for key in IMAGE_KEYS if scores[key] is None] == NOISE_FREE_ONLY
    assert all("speckled" in metrics["reasons"][f"images.test-17.{key}"] for key in NOISE_FREE_ONLY)
    assert list(metrics["baselines"]) == ["test-17", "test-15"]
    assert metrics["points"]["visible"] == dict.fromkeys(POINT_KEYS)
    assert "no true mesh" in metrics["reasons"]["points.whole.count"]


def test_clean_test_images_are_scored_as_such_though_the_training_was_speckled(make):
    run = fake_run(make(looks=1, ground=True, clean_tests=True), power=1.1)
    metrics = evaluate_run(run)
    scores, truth = metrics["images"]["test-17"], run.dataset.images("test-17")
    assert [scores[key] for key in SPECKLED_ONLY] == [None] * 4
    brightest = max(run.dataset.images(split).max() for split in ("test-17", "test-15"))
    assert metrics["parameters"]["reference_amplitude"] == pytest.approx(float(np.sqrt(brightest)))
    assert brightest < run.dataset.images("train").max()  # a peak of the speckle, which nothing is to be measured by
    assert scores["psnr_db"] == pytest.approx(psnr_db(truth, np.float32(1.1) * truth, float(np.sqrt(brightest))))
    assert metrics["baselines"] is None


def test_what_is_returned_is_written_into_the_run(make, tmp_path):
    run = fake_run(make(), path=tmp_path / "run")
    run.path.mkdir()
    metrics = evaluate_run(run)
    assert json.loads((run.path / "metrics.json").read_text()) == metrics
    with pytest.raises(SarsplatError, match="non-finite"):
        evaluate_run(fake_run(run.dataset, path=run.path, power=float("nan")))
    assert json.loads((run.path / "metrics.json").read_text()) == metrics
    with elsewhere(only_writer(run.path)), pytest.raises(SarsplatError, match="in use"):
        evaluate_run(run)


def test_what_no_view_sees_belongs_to_the_whole_surface_alone(make) -> None:
    points = evaluate_run(fake_run(make(), points=ON_THE_TOP * (0.5, 0.5, 0.0)))["points"]  # below the cube
    assert points["whole"]["accuracy_m"] == pytest.approx(0, abs=1e-6)
    assert points["visible"]["accuracy_m"] > 0.4


def test_no_mesh_no_points_and_black_pixels_are_results_not_errors(make):
    for run, key, reason in (
        (fake_run(make(), mesh=trimesh.Trimesh()), "mesh.visible.cd_m", "the points make no surface"),
        (fake_run(make(), mesh=SarsplatError("too many voxels")), "mesh.whole.f1@0.3", "too many voxels"),
        (fake_run(make(), points=np.empty((0, 3))), "points.whole.cd_m", "no points"),
        (fake_run(make(looks=1), power=0.0), "images.test-17.nats_per_pixel", "noise floor"),
        (fake_run(make(looks=1), power=0.0), "images.test-17.log_correlation", "noise floor"),
    ):
        metrics = evaluate_run(run)
        kind, part, score = key.split(".", 2)
        assert metrics[kind][part][score] is None and metrics["baselines"] is None  # without ground
        assert reason in metrics["reasons"][key]
        assert (metrics["points"]["visible"]["cd_m"] is None) == (len(run.points) == 0)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"points": False, "alignment": "rigid"}, "points are left out, but"),
        ({"points": False, "mesh": "t.ply"}, "points are left out, but"),
        ({"mesh": "no-such.ply"}, "no-such"),
        ({"mesh": "broken.ply"}, r"the true mesh cannot be used: .*broken\.ply"),
        ({"alignment": "soft"}, "'soft'; give one of 'none', 'rigid'"),
        ({"alignment": "rigid"}, "has no true mesh to align the points to"),
        ({"lpips_weights": "here"}, r"here holds no usable LPIPS weights .*alexnet_features_torchvision\.npz"),
        ({WEIGHTS_VARIABLE: "absent"}, "absent holds no usable LPIPS weights"),
        ({"masks": "absent"}, "absent has no mask of any test image"),
    ],
)
def test_what_cannot_be_done_is_told_before_anything_is_rendered(make, tmp_path, monkeypatch, options, words):
    monkeypatch.chdir(tmp_path)
    Path("broken.ply").write_bytes(b"ply\nnot a mesh")
    monkeypatch.setenv(WEIGHTS_VARIABLE, (options := {**options}).pop(WEIGHTS_VARIABLE, ""))
    run = fake_run(make(mesh=None))
    with pytest.raises(SarsplatError, match=words):
        evaluate_run(run, **options, quiet=True)
    assert run.asked == []


@pytest.mark.skipif(not WEIGHTS.is_dir(), reason=f"the LPIPS weights are not in {WEIGHTS}")
def test_weights_give_lpips(make):
    metrics = evaluate_run(fake_run(make(), power=1.5), lpips_weights=WEIGHTS)
    assert 0 < metrics["images"]["test-17"]["lpips"] < 1
    assert "images.test-17.lpips" not in metrics["reasons"]


@pytest.mark.parametrize(("mesh", "points"), [(CUBE, ON_THE_TOP), (None, ON_THE_TOP), (CUBE, np.empty((0, 3)))])
def test_without_test_views_points_and_the_run_itself_are_scored(tmp_path, make, mesh, points):  # make: coarse surfaces
    """Measured data have neither test images nor a mesh, but training images that show what points lack."""
    scored = mesh is not None and len(points) > 0
    only_training = dataset_of(GRID, [(View(0, 45), "train")], image(0)[None])
    run = fake_run(write_dataset(tmp_path / "dataset", only_training, truth_mesh=mesh), points=points)
    few = "made from views that cannot determine the shape"
    with pytest.warns(SarsplatWarning, match=few) if scored else nullcontext():
        metrics = evaluate_run(run)
    assert metrics["images"] == {} and "no test images" in metrics["reasons"]["images"]
    assert any(metrics["points"]["visible"].values()) == scored == (metrics["points"]["visible"]["cd_m"] is not None)
    assert metrics["time_s"] == 12.5 and "missing" in metrics
    with pytest.raises(SarsplatError, match="no test images, and points are left out"):
        evaluate_run(run, points=False)


@pytest.mark.parametrize("scale", [1e-45, 1e-38, 1e16])
@pytest.mark.parametrize("looks", [None, 1])
def test_faint_and_strong_images_are_scored_without_a_warning_and_as_others_are(make, looks, scale):
    usual, scores = (
        evaluate_run(fake_run(make(looks=looks, ground=True, mesh=None, scale=k), power=1.1 * k))["images"]["test-17"]
        for k in (1.0, scale)
    )
    usual, scores = ({key: value for key, value in one.items() if value is not None} for one in (usual, scores))
    assert np.isfinite([*scores.values()]).all()
    assert scores.keys() == usual.keys()
    if scale > 1e-40:  # fainter ones have lost their digits
        assert scores == pytest.approx(usual, rel=1e-3)


def test_a_given_mesh_takes_the_place_of_the_datasets(make, tmp_path):
    trimesh.creation.box(extents=(2, 2, 4)).export(tmp_path / "tall.ply")
    points = ON_THE_TOP + np.array([0.3, -0.2, 0])
    run = fake_run(make(mesh=None), points=points)
    assert evaluate_run(run)["truth"] == {"mesh": None}
    scores = evaluate_run(run, mesh=tmp_path / "tall.ply")
    assert scores["truth"].keys() == {"mesh", "sha256"}
    assert scores["truth"]["mesh"] == str(tmp_path / "tall.ply")
    assert scores["points"]["visible"]["accuracy_m"] > 0.03  # some hang over the edge
    assert scores["points"]["visible"]["cd_m"] is not None


def test_points_are_aligned_if_asked(make):
    points = trimesh.sample.sample_surface(CUBE, 1000, seed=0)[0]  # of all sides; no view sees the bottom
    run = fake_run(make(), points=points[points[:, 2] > 0.01] + np.array([0.3, -0.2, 0.1]))
    plain, aligned = evaluate_run(run), evaluate_run(run, alignment="rigid")
    assert "shift_m" not in plain["truth"]
    np.testing.assert_allclose(aligned["truth"]["shift_m"], [-0.3, 0.2, -0.1], atol=0.1)
    assert aligned["points"]["visible"]["accuracy_m"] < plain["points"]["visible"]["accuracy_m"] / 2
    assert aligned["mesh"]["visible"]["accuracy_m"] > plain["mesh"]["visible"]["accuracy_m"]  # moved the same way


@pytest.mark.parametrize("ground", [False, True])
def test_masks_are_scored_if_they_are_given(make, tmp_path, ground):
    image_module = pytest.importorskip("PIL.Image")
    true = np.zeros((SIZE, SIZE), np.uint8)
    true[20:25, 20:40], true[25:40, 20:40] = 1, 2
    for name in ("001", "004"):  # two of the three test images
        image_module.fromarray(true).save(tmp_path / f"{name}.png")
    metrics = evaluate_run(fake_run(make(ground=ground)), masks=tmp_path)
    scores = metrics["images"]["test-17"]
    assert scores["target_iou"] == 0.5
    assert scores["shadow_iou"] == (pytest.approx(2 / 3) if ground else None)
    assert metrics["images"]["test-15"]["target_iou"] is None
    assert "no true masks" in metrics["reasons"]["images.test-15.target_iou"]
    assert metrics["masks"] == str(tmp_path)
