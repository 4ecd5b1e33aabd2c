"""Public names, and folders of modules that share their name with a function."""

from __future__ import annotations

import importlib

import pytest

import sarsplat


def test_every_public_name_is_there():
    for name in sarsplat.__all__:
        assert getattr(sarsplat, name) is not None
    assert set(sarsplat.__all__) == set(dir(sarsplat))


@pytest.mark.parametrize("name", ["render", "reconstruct"])
def test_functions_keep_their_names_and_modules_can_be_reached(name):
    folder = importlib.import_module(f"sarsplat.{name}")
    assert getattr(sarsplat, name) is getattr(folder, name)
    assert callable(getattr(sarsplat, name))


def test_modules_inside_are_imported_with_from():
    from sarsplat.reconstruct import config
    from sarsplat.reconstruct.config import Config
    from sarsplat.render import constants

    assert config.Config is Config is sarsplat.Config
    assert constants.IMAGE_CUT == 16
