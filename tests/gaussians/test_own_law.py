"""A scattering law of one's own: rendered, trained, saved and read like ours, here and by an entry point."""

import inspect
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar, Self

import pytest
import torch
from torch import Tensor

from made import FEW_POINTS, upright
from sarsplat import ImageGrid, Run, SarsplatError, View, preset, reconstruct, render
from sarsplat.data import Dataset, read_gaussians_ply, write_gaussians_ply
from sarsplat.gaussians import SCATTERINGS, Gaussians, Harmonics, Scattering, register_scattering


@dataclass(frozen=True)
class Fan(Scattering):
    """Brighter towards one azimuth than away from it."""

    width: float = 1.0
    kind: ClassVar[str] = "fan"

    def amplitudes(self, directions: Tensor, quaternions: Tensor, scales: Tensor) -> Tensor:
        level, x, y = torch.nn.functional.pad(self.parameters, (0, 3 - self.parameters.shape[1])).unbind(1)
        along = directions[:, :1] * x + directions[:, 1:2] * y
        return self.p_min + torch.nn.functional.softplus(level + self.width * along)[..., None]

    @classmethod
    def initial(cls, count: int, gamma0: float, p_min: float) -> Self:
        level = torch.tensor(max(gamma0 - p_min, 1e-3)).expm1().log()
        return cls(torch.cat([level.expand(count, 1), torch.zeros(count, 2)], 1), p_min)


@pytest.fixture
def forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    """What a test registers, the next one does not know."""
    monkeypatch.setattr(SCATTERINGS, "_entries", dict(SCATTERINGS._entries))


def scene(law: Scattering) -> Gaussians:
    return upright(torch.randn(len(law.parameters), 3), 0.2, law=law)


@pytest.mark.usefixtures("forgotten")
def test_registered_it_is_trained_saved_and_read(small_box: Dataset, tmp_path: Path) -> None:
    short = replace(preset("default"), iterations=40, gaussians=200, points=FEW_POINTS)
    with pytest.raises(SarsplatError, match=r"scattering is 'fan'; it must be one of .* registered first"):
        replace(short, scattering="fan")
    assert register_scattering(Fan) is Fan
    run = reconstruct(small_box, replace(short, scattering="fan"), tmp_path / "run", quiet=True)
    assert run.history[-1].loss < 0.8 * run.history[0].loss
    assert run.config.scattering == "fan"
    law = Run.load(tmp_path / "run").gaussians.scattering
    assert isinstance(law, Fan)
    assert bool((law.parameters.std(0) > 0).all())  # every column was learned
    read = read_gaussians_ply(tmp_path / "run" / "gaussians.ply")
    assert torch.equal(read.scattering.parameters, law.parameters)
    write_gaussians_ply(tmp_path / "wide.ply", scene(Fan(torch.randn(4, 3), 0.1, width=2.5)))
    assert read_gaussians_ply(tmp_path / "wide.ply").scattering.settings() == {"p_min": 0.1, "width": 2.5}


@pytest.mark.usefixtures("forgotten")
def test_without_registration_it_is_rendered_but_no_file_is_written(tmp_path: Path) -> None:
    gaussians = scene(Fan(torch.randn(5, 3).requires_grad_()))
    images = render(gaussians, [View(20, 30)], ImageGrid(12, 10, (0.3, 0.3), (0.4, 0.4))).images
    assert torch.autograd.grad(images.sum(), gaussians.scattering.parameters)[0].abs().sum() > 0
    with pytest.raises(SarsplatError, match=r"^the scattering law Fan \('fan'\) is not registered, .* decorate"):
        write_gaussians_ply(tmp_path / "a.ply", gaussians)
    assert not list(tmp_path.iterdir())
    register_scattering(Fan)
    write_gaussians_ply(tmp_path / "a.ply", gaussians)
    with pytest.raises(SarsplatError, match=r"law Fan cannot be made again from its settings \(.*not JSON"):
        write_gaussians_ply(
            tmp_path / "b.ply", replace(gaussians, scattering=Fan(torch.zeros(5, 3), width=torch.ones(())))
        )
    assert [path.name for path in tmp_path.iterdir()] == ["a.ply"]
    del SCATTERINGS._entries["fan"]
    with pytest.raises(SarsplatError, match=r"a.ply has an invalid scattering law \(.*'fan.*is unknown"):
        read_gaussians_ply(tmp_path / "a.ply")


def test_shapes_are_checked_without_a_word_from_the_law() -> None:
    assert Fan(torch.zeros(3, 2)).parameters.shape == (3, 2)
    for shape in ((3,), (3, 0), (2, 3, 4)):
        with pytest.raises(SarsplatError, match=r"scattering has shape .*; .* \(N, K\) with K at least 1"):
            Fan(torch.zeros(shape))


@pytest.mark.parametrize("engine", ["auto", "reference"])
@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (lambda a: a.double(), "is torch.float64 on cpu but means is torch.float32"),
        (lambda a: a.to(torch.complex64), "is torch.complex64"),
        (lambda a: a.long(), "is torch.int64"),
        (lambda a: a[:1], r"has shape \(1, 5, 1\); it must be \(2, 5, C\)"),
        (lambda a: a[..., 0], r"has shape \(2, 5\)"),
        (lambda a: a.detach().numpy(), "is of type ndarray; return a tensor"),
    ],
)
def test_what_a_law_returns_is_checked_before_an_engine_reads_it(engine, wrong, message) -> None:
    class Wrong(Fan):
        def amplitudes(self, directions, quaternions, scales):
            return wrong(super().amplitudes(directions, quaternions, scales))

    gaussians = scene(Wrong(torch.randn(5, 3)))
    with pytest.raises(SarsplatError, match=rf"^amplitudes of the scattering law Wrong {message}"):
        render(gaussians, [View(20, 30), View(50, 30)], ImageGrid(12, 10, (0.3, 0.3), (0.4, 0.4)), engine=engine)


@dataclass(frozen=True)
class Spoilt(Scattering):
    kind: ClassVar[str] = "spoilt"
    amplitudes = Fan.amplitudes
    width: ClassVar[float] = 1.0


@dataclass(frozen=True)
class Second(Scattering):
    kind: ClassVar[str] = "harmonics"
    amplitudes = Fan.amplitudes


@pytest.mark.parametrize(
    ("law", "words"),
    [
        (Second, "'harmonics' is sarsplat.*Harmonics already"),
        *(
            (thing, "give a class derived from Scattering")
            for thing in (Scattering, dict, "fan", Fan(torch.ones(1, 3)))
        ),
    ],
)
def test_what_is_no_law_of_its_kind_is_not_registered(law: object, words: str) -> None:
    with pytest.raises(SarsplatError, match=words):
        register_scattering(law)  # type: ignore[type-var]


@pytest.mark.usefixtures("forgotten")
def test_what_cannot_be_trained(small_box: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Second, "kind", "without a start")
    register_scattering(Second)
    register_scattering(Second)  # as a notebook's cell does that runs again
    with pytest.raises(SarsplatError, match="cannot start with the scattering law Second"):
        reconstruct(small_box, replace(preset("default"), iterations=1, scattering=Second.kind), quiet=True)


@pytest.mark.usefixtures("forgotten")
@pytest.mark.parametrize(
    ("start", "said"),
    [
        (lambda count: None, "returned None"),
        (lambda count: Harmonics(torch.ones(count, 1)), "returned Harmonics|returned an object of type Harmonics"),
        (lambda count: Spoilt(torch.ones(count + 1, 3)), r"returned torch.float32 \[\d+, 3\]"),
        (lambda count: Spoilt(torch.ones(count, 3).double()), r"returned torch.float64 \[\d+, 3\]"),
    ],
)
def test_a_law_that_starts_with_something_else_is_refused(small_box: Dataset, monkeypatch, start, said) -> None:
    register_scattering(Spoilt)
    monkeypatch.setattr(Spoilt, "initial", classmethod(lambda cls, count, gamma0, p_min: start(count)))
    with pytest.raises(SarsplatError, match=rf"Spoilt.initial\(\d+, …\) ({said}); it must return a Spoilt whose"):
        reconstruct(small_box, replace(preset("default"), iterations=1, scattering="spoilt"), quiet=True)


def test_the_command_line_knows_the_law_of_a_package(small_box: Dataset, tmp_path: Path, beside) -> None:
    text = inspect.getsource(sys.modules[__name__]).partition("@pytest.fixture")[0].replace("from made", "# ")
    site = tmp_path / "site"
    (site / "fans-1.0.dist-info").mkdir(parents=True)
    (site / "fans.py").write_text(text.replace("import pytest", ""))
    (site / "fans-1.0.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: fans\nVersion: 1.0\n")
    names = "[sarsplat.scattering]\nfan = fans:Fan\nfun = fans:Fan\n"
    (site / "fans-1.0.dist-info" / "entry_points.txt").write_text(names)
    few = "--preset quick --iterations 2 --gaussians 20 --points.voxel 0.3 --points.rays-per-pixel 2"
    reconstruct = f"reconstruct {small_box.path} {few} --scattering"
    done = beside(site, f"{reconstruct} fan --out run", "info run/gaussians.ply", f"{reconstruct} fun --out wrong")
    assert [code for code, _, _ in done] == [0, 0, 2]
    assert "fan, 3 numbers each" in done[1][1]
    assert "error: the entry point 'fun' of sarsplat.scattering names <class 'fans.Fan'>" in done[2][2]
