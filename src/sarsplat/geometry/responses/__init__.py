"""Responses of the system: each is a file of this folder, where it is looked up by its kind."""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules
from typing import Any

from sarsplat.errors import SarsplatError, shown
from sarsplat.geometry.responses.gaussian import GAUSSIAN, Gaussian
from sarsplat.geometry.responses.response import Response, variance_of, width_of
from sarsplat.geometry.responses.sampled import Sampled
from sarsplat.geometry.responses.taylor import TAYLOR, UNIFORM, Taylor

__all__ = [
    "GAUSSIAN",
    "RESPONSES",
    "TAYLOR",
    "UNIFORM",
    "Gaussian",
    "Response",
    "Sampled",
    "Taylor",
    "response_of",
    "stated_taylor",
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
    given = dict(settings) if isinstance(settings, dict) else {}
    kind = given.pop("kind", None)
    if not isinstance(kind, str) or kind not in RESPONSES:
        raise SarsplatError(f"the response {shown(kind)} is unknown; choose one of {', '.join(RESPONSES)}")
    try:
        return RESPONSES[kind](**given)
    except TypeError as error:
        raise SarsplatError(
            f"a {kind} response cannot have the settings {shown(given)}: {error}; correct them"
        ) from error


def stated_taylor(level_db: Any, sidelobes: Any = TAYLOR.sidelobes) -> Response:
    """The Taylor response of a level, of either sign, that a file states; a Gaussian if that makes no sense."""
    try:
        return Taylor(abs(float(level_db)), int(sidelobes))
    except (TypeError, ValueError, SarsplatError):
        return GAUSSIAN
