"""A configuration comes back as it was, and takes nothing that would fail an hour later."""

import json
import math
import pydoc
from dataclasses import fields, replace
from operator import attrgetter
from typing import Any

import pytest

from sarsplat import PRESETS, Config, SarsplatError, preset
from sarsplat.gaussians import SCATTERINGS
from sarsplat.settings.sections import Densification, Passes, PointExtraction, Rates, Surroundings


@pytest.mark.parametrize("name", PRESETS)
def test_round_trip_through_json(name: str) -> None:
    assert PRESETS[name].preset == name
    assert Config.from_dict(json.loads(json.dumps(PRESETS[name].as_dict()))) == PRESETS[name]


def changed(path: str, value: Any) -> dict[str, Any]:
    """A whole configuration with one setting changed."""
    data = replace(PRESETS["paper"], surroundings=Surroundings(), passes=Passes()).as_dict()
    *groups, name = path.split(".")
    record = data
    for group in groups:
        record = record[group]
    record[name] = value
    return data


@pytest.mark.parametrize(
    ("path", "value", "allowed"),
    [
        ("iterations", 0, "a whole number from 1 to 1e+08"),
        ("iterations", 2.5, "a whole number"),
        ("iterations", 10**400, "a whole number"),
        ("seed", -1, "a whole number from 0"),
        ("preset", 3, "text"),
        ("initialisation", "cube", "one of box, hemisphere"),
        ("scattering", "waves", "one of harmonics, normal-lobes"),
        ("common_law", 1.5, "true or false"),
        ("harmonics_degree", 4, "from 0 to 3"),
        ("p_min", math.nan, "a number from 0"),
        ("initial_scale", None, "a number"),
        ("initial_scale", 1e300, "a number from 1e-06 to 1e+06"),
        ("scale_bounds", [0.01], "2 values, each a number"),
        ("scale_bounds", [0.3, 0.01], "the smaller one first"),
        ("target_box", [1.0, -1.0, 0.0, -1.0, 1.0, 2.0], "give the lower corner (x, y, z) and then the upper one"),
        ("scale_bounds", [1e-9, 0.3], "2 values, each a number from 1e-06"),
        ("rates.means", 0, "a number from 1e-06"),
        ("rates.scattering", -1e-9, "a number from 0"),
        ("rates", None, "an object with means, means_end"),
        ("points.rays_per_pixel", 1e6, "a number from 0.01 to 1000"),
        ("points.optical_depth", 41, "a number from 0 to 40"),
        ("points.cluster_radius", 0, "a number from 1e-06 to 1e+06 or nothing"),
        ("densification.max_gaussians", None, "a whole number"),
        ("surroundings", 7, "or nothing"),
        ("surroundings.texture_looks", 1e-300, "give at least 1e-06, or 0 to switch it off"),
        ("passes.screen_std", 1e-30, "give at least 1e-06, or 0 to switch it off"),
        ("initialisation", "x" * 5000, "one of box, hemisphere"),
        ("warmth", 1, "the setting 'warmth' is unknown; remove it"),
        ("iteratons", 1, "the setting 'iteratons' is unknown; did you mean iterations?"),
        ("rates.mean_m", 1, "the setting 'rates.mean_m' is unknown; did you mean rates.means?"),
        ("surroundings.ground_pitch", 1, "surroundings.ground_pitch is of an earlier version; ground is a plane now"),
    ],
)
def test_wrong_values_are_refused_in_a_short_sentence(path: str, value: Any, allowed: str) -> None:
    with pytest.raises(SarsplatError) as refusal:
        Config.from_dict(changed(path, value), "my.json")
    message = str(refusal.value)
    assert message.startswith((f"my.json: {path} is ", "my.json: the setting "))
    assert allowed in message
    assert len(message) < 600
    assert "\n" not in message


@pytest.mark.parametrize(
    ("path", "default"), [("p_min", 0.03), ("rates.means", 0.15), ("densification.every", 500), ("surroundings", None)]
)
def test_absent_settings_take_their_defaults(path: str, default: object) -> None:
    """As in files from before there were these settings."""
    data = changed(path, 1)
    *groups, name = path.split(".")
    del (data[groups[0]] if groups else data)[name]
    assert attrgetter(path)(Config.from_dict(data)) == default


def test_runs_of_before_there_was_a_floor_go_on_without() -> None:
    data = changed("surroundings", {"noise_floor": 0.05})
    assert Config.of_run(data, "").surroundings == Surroundings(speckle_floor=0.0)
    del data["surroundings"]
    assert Config.of_run(data, "").surroundings is None


@pytest.mark.parametrize("data", [None, 3, [], "text"])
def test_what_is_no_record_at_all(data: object) -> None:
    with pytest.raises(SarsplatError, match="not a set of settings"):
        Config.from_dict(data)


def test_records_made_in_python_are_checked_too() -> None:
    with pytest.raises(SarsplatError, match=r"^rates\.means is nan; it must be a number from 1e-06 to 1e\+06$"):
        Rates(means=math.nan)
    whole = Config(p_min=0, scale_bounds=[1, 2])  # type: ignore[arg-type]
    assert (whole.p_min, whole.scale_bounds) == (0.0, (1.0, 2.0))
    assert isinstance(whole.p_min, float)


def test_every_law_of_scattering_can_be_configured_by_its_kind() -> None:
    assert [law.kind for law in SCATTERINGS.values()] == list(SCATTERINGS)
    for kind in SCATTERINGS:
        assert Config(scattering=kind).scattering == kind


@pytest.mark.parametrize("record", [Config, Rates, Densification, PointExtraction, Surroundings])
def test_every_field_is_explained_in_help(record: type[Config]) -> None:
    shown = pydoc.plain(pydoc.render_doc(record))
    for field in fields(record):
        assert f"{field.name} : " in shown, field.name


def test_unknown_presets_are_refused() -> None:
    with pytest.raises(SarsplatError, match="'fast' is unknown; choose one of default, quick, speckled, scene, paper"):
        preset("fast")
    with pytest.raises(SarsplatError, match="'defualt' is unknown; did you mean default"):
        preset("defualt")
