"""What public functions are given: another kind is refused in one sentence, before anything is done."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import is_dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypedDict, Unpack

import numpy as np
import pytest
import torch
from jaxtyping import Float
from torch import Tensor

import sarsplat
from made import small_dataset, upright
from sarsplat import Harmonics, ImageGrid, RayGrid, Run, SarImage, SarsplatError, Trainer, View, Viewer
from sarsplat.arguments import checks_arguments
from sarsplat.data import Dataset, read_points_ply, write_mesh, write_points_ply
from sarsplat.gaussians import Gaussians
from sarsplat.scenes import ScatteringLaw, law_scattering

if TYPE_CHECKING:
    import trimesh

GRID = ImageGrid(16, 16, (0.5, 0.5), (0.75, 0.75))
VIEW = View(30.0, 40.0)
DATA = small_dataset()


def scene(count: int = 3) -> Gaussians:
    return upright(torch.zeros(count, 3), 0.3)


@checks_arguments
def sample(
    view: View | None = None,
    views: Sequence[View] = (),
    path: str | Path = "",
    number: float = 0.0,
    count: int = 0,
    flag: bool = False,
    word: Literal["a", "b"] = "a",
    pair: tuple[float, float] = (0.0, 0.0),
    many: tuple[int, ...] = (),
    by_name: Mapping[str, str] | None = None,
    call: Callable[[int], int] | None = None,
    tensor: Float[Tensor, "n 3"] | None = None,
    array: Float[np.ndarray, "n 3"] | None = None,
    mesh: trimesh.Trimesh | None = None,
    lines: Iterable[str] = (),
    anything: Any = None,
) -> str:
    """One parameter of each kind."""
    return "done"


FITTING: dict[str, list[Any]] = {
    "view": [None, VIEW],
    "views": [[], (VIEW,), iter([VIEW]), np.array([VIEW])],
    "path": ["a", Path("a")],
    "number": [1, 1.5, np.float32(1), np.int64(1), float("nan"), torch.tensor(1.0), np.array(1.0)],
    "count": [1, np.int64(1), torch.tensor(1)],
    "flag": [True, np.bool_(True), 1],
    "word": ["a", "b"],
    "pair": [(1, 2), [1.0, np.float32(2)], np.ones(2)],
    "many": [(), [1, 2, 3], range(3)],
    "by_name": [{}, {"a": "b"}],
    "call": [len, lambda x: x, Run],
    "tensor": [torch.ones(1), None],
    "array": [np.ones(1), None],
    "lines": [[], ["a", "b"], iter("ab")],
    "anything": [object()],
}


@pytest.mark.parametrize(("name", "value"), [(name, value) for name, values in FITTING.items() for value in values])
def test_what_fits_is_passed_on(name: str, value: object) -> None:
    assert sample(**{name: value}) == "done"


@pytest.mark.parametrize(
    ("name", "value", "sentence"),
    [
        ("view", "x", "view is 'x'; give a View(azimuth_deg, grazing_deg)"),
        ("view", GRID, "view is an object of type ImageGrid; give"),
        ("views", VIEW, f"views is a single one, {VIEW}; put it into a list"),
        ("views", None, "views is None; give a list"),
        ("views", [VIEW, 3], "views holds 3; make each a View("),
        ("path", 3, "path is 3; give a path, a str or a pathlib.Path"),
        ("path", DATA, "path is <Dataset of unnamed: 1 train, 2 test; 16 × 12 pixels>; give a path"),
        ("number", "3", "number is '3'; give a number"),
        ("count", 1.5, "count is 1.5; give a whole number"),
        ("flag", "no", "flag is 'no'; give True or False"),
        ("flag", torch.ones(2), "flag is an object of type Tensor [2]; give True or False"),
        ("word", 3, "word is 3; give one of 'a', 'b'"),
        ("word", "c", "word is 'c'; give one of 'a', 'b'"),
        ("pair", 3, "pair is 3; give 2 values, each a number"),
        ("pair", (1, 2, 3), "pair is (1, 2, 3); give 2 values, each a number"),
        ("pair", (1, "2"), "pair holds '2'; make each a number"),
        ("many", 3, "many is a single one, 3; put it into a list"),
        ("by_name", [("a", "b")], "by_name is [('a', 'b')]; give a dict"),
        ("call", "amplitude", "call is 'amplitude'; give a function, not its name"),
        ("tensor", np.ones((2, 3)), "tensor is an object of type ndarray [2, 3]; give a torch.Tensor (torch.as_tensor"),
        ("array", torch.ones(2, 3), "array is an object of type Tensor [2, 3]; give a numpy.ndarray (numpy.asarray"),
        ("mesh", "m.ply", "mesh is 'm.ply'; give a trimesh.Trimesh, such as load_mesh(PATH) reads"),
        ("number", object(), "number is an object of type object; give a number"),
    ],
)
def test_what_does_not_fit_is_named_with_the_remedy(name: str, value: object, sentence: str) -> None:
    with pytest.raises(SarsplatError, match=rf"^{re.escape(sentence)}") as error:
        sample(**{name: value})
    assert "\n" not in str(error.value)


class About(TypedDict, total=False):
    """What is named elsewhere."""

    side: View | None


@checks_arguments
def told(path: str, **about: Unpack[About]) -> str:
    """Options that are named elsewhere."""
    return "done"


def test_options_named_elsewhere_and_arguments_by_position_are_checked_too() -> None:
    assert told("a") == told("a", side=VIEW) == told("a", side=None) == "done"
    with pytest.raises(SarsplatError, match=r"^side is 3; give a View\("):
        told("a", side=3)
    with pytest.raises(TypeError, match=r"told\(\) got an unexpected keyword argument 'sid'"):
        told("a", **{"sid": VIEW})  # type: ignore[arg-type]
    with pytest.raises(SarsplatError, match=r"^views is None"):
        sample(VIEW, None)


def test_a_class_imported_for_types_alone_is_known_by_its_name() -> None:
    trimesh = pytest.importorskip("trimesh")
    assert sample(mesh=trimesh.creation.box()) == sample(mesh=None) == "done"


def test_lists_of_numbers_are_as_good_as_arrays(tmp_path: Path) -> None:
    assert View.towards([1.0, 0.0, 1.0]) == View.towards(np.array([1.0, 0.0, 1.0]))
    write_points_ply(tmp_path / "p.ply", [(0.0, 1.0, 2.0)], normals=[[0.0, 0.0, 1.0]], weight=[0.5])
    points, columns = read_points_ply(tmp_path / "p.ply")
    assert points.tolist() == [[0.0, 1.0, 2.0]]
    found = {name: column.tolist() for name, column in columns.items()}
    assert found == {"nx": [0.0], "ny": [0.0], "nz": [1.0], "weight": [0.5]}
    assert law_scattering([[0.0, 0.0, 1.0]], [VIEW], ScatteringLaw()).shape == (1, 1)
    for wrong in ([[0.0, 1.0]], [[0.0], [1.0, 2.0]]):
        with pytest.raises(SarsplatError, match=r"^the points are"):
            write_points_ply(tmp_path / "p.ply", wrong)


# ---- all that is public ---------------------------------------------------------------------------------------------
CLASSES = (Dataset, Gaussians, RayGrid, Run, SarImage, Trainer, View, Viewer)


def public() -> list[tuple[Callable[..., Any], str]]:
    functions = [value for name in sarsplat.__all__ if inspect.isfunction(value := getattr(sarsplat, name))]
    for cls in CLASSES:
        members = {name: getattr(value, "__func__", value) for name, value in vars(cls).items()}
        own = [name for name, value in members.items() if inspect.isfunction(value) and name[0] != "_"]
        # dataclasses check themselves when they are made
        functions += [getattr(cls, name) for name in [*own, *["__init__"] * (not is_dataclass(cls))]]
    kinds = [(function, p) for function in functions for p in inspect.signature(function).parameters.values()]
    unchecked = inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL
    return [(f, p.name) for f, p in kinds if p.annotation not in (p.empty, "Any") and p.kind not in unchecked]


@pytest.mark.parametrize(("function", "name"), public(), ids=lambda part: getattr(part, "__qualname__", part))
def test_no_public_function_takes_just_anything(function: Any, name: str) -> None:
    while hasattr(getattr(function, "__wrapped__", None), "__wrapped__"):  # the tests' own look at shapes
        function = function.__wrapped__
    with pytest.raises(SarsplatError, match=rf"^{name} is an object of type object; give "):
        parameters = inspect.signature(function).parameters
        if parameters[name].kind is inspect.Parameter.POSITIONAL_ONLY:
            function(*["p.ply"] * [*parameters].index(name), object())
        else:
            function(**{name: object()})


@pytest.mark.parametrize(
    ("call", "sentence"),
    [
        (lambda: Run.from_gaussians(scene(0)), "a run needs at least one Gaussian"),
        (lambda: write_mesh("a.ply", scene()), "mesh is Gaussians(3, harmonics with 1 number, torch.float32, cpu)"),
        (lambda: scene()["x"], "the index is 'x'; give an integer, a slice, a mask [N] or integers [M]"),
        (lambda: Harmonics(torch.ones(2, 1), None), "p_min is None; give a number"),
        (lambda: Harmonics(torch.ones(2, 1)).joined(3), "other is 3; give"),
        (lambda: ScatteringLaw(floor="x"), "floor is 'x'; give a number"),
        (lambda: SarImage(np.ones((16, 16)), VIEW, VIEW), "grid is View("),
        (lambda: Dataset(None, DATA.entries, DATA.power), "grid is None; give an ImageGrid"),
        (lambda: Dataset(DATA.grid, [VIEW], DATA.power), "entries holds View("),
    ],
)
def test_what_users_mix_up(call: Callable[[], object], sentence: str) -> None:
    with pytest.raises(SarsplatError, match=rf"^{re.escape(sentence)}"):
        call()
