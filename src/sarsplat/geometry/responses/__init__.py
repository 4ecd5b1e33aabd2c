"""Responses of the system: each is a file of this folder, where it is looked up by its kind."""

from __future__ import annotations

from dataclasses import fields
from importlib import import_module
from pkgutil import iter_modules
from typing import Any

from sarsplat.errors import SarsplatError, shown
from sarsplat.geometry.responses.gaussian import GAUSSIAN, Gaussian
from sarsplat.geometry.responses.response import Response, variance_of, width_of
from sarsplat.geometry.responses.sampled import Sampled
from sarsplat.geometry.responses.taylor import UNIFORM, Taylor

__all__ = [
    "GAUSSIAN",
    "RESPONSES",
    "UNIFORM",
    "Gaussian",
    "Response",
    "Sampled",
    "Taylor",
    "response_of",
    "variance_of",
    "width_of",
]

for _info in iter_modules(__path__):
    import_module(f"{__name__}.{_info.name}")

RESPONSES: dict[str, type[Response]] = {shape.kind: shape for shape in Response.__subclasses__()}
"""Every response by the name of its kind."""


def response_of(settings: Any) -> Response:
    """The response that `Response.as_dict` described; a Gaussian for None.

    Raises
    ------
    SarsplatError
        If it is no such description, or a setting is missing, unknown or out of range.
    """
    if settings is None:
        return GAUSSIAN
    kind = settings.get("kind") if isinstance(settings, dict) else settings
    if not isinstance(settings, dict) or not isinstance(kind, str) or kind not in RESPONSES:
        raise SarsplatError(f"the response {shown(kind)} is unknown; choose one of {', '.join(RESPONSES)}")
    shape = RESPONSES[kind]
    given = {name: value for name, value in settings.items() if name != "kind"}
    try:
        return shape(**given)
    except TypeError as error:
        needed = ", ".join(field.name for field in fields(shape)) or "no settings"  # type: ignore[arg-type]
        raise SarsplatError(
            f"a {kind} response with the settings {shown(', '.join(map(str, given)))} is not possible; give {needed}"
        ) from error
