"""Responses of the system; each is a file of this folder, registered by its `kind`."""

from importlib import import_module
from pkgutil import iter_modules
from typing import Any

from sarsplat.errors import SarsplatError, shown
from sarsplat.geometry.responses.response import GAUSSIAN, Gaussian, Response, variance_of, width_of
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
"""Response classes by kind."""


def response_of(settings: Any) -> Response:
    """Make the response that `Response.as_dict` describes, a Gaussian for None; raise if settings are invalid."""
    if settings is None:
        return GAUSSIAN
    fields = dict(settings) if isinstance(settings, dict) else {}
    kind = fields.pop("kind", None)
    if not isinstance(kind, str) or kind not in RESPONSES:
        raise SarsplatError(f"the response {shown(kind)} is unknown; choose one of {', '.join(RESPONSES)}")
    try:
        return RESPONSES[kind](**fields)
    except TypeError as error:
        message = f"a {kind} response cannot have the settings {shown(fields)}: {error}; correct them"
        raise SarsplatError(message) from error


def stated_taylor(level_db: Any, sidelobes: Any = TAYLOR.sidelobes) -> Response:
    """Return the Taylor response of a file's level in dB, of either sign; a Gaussian if it is invalid."""
    try:
        return Taylor(abs(float(level_db)), int(sidelobes))
    except (TypeError, ValueError, SarsplatError):
        return GAUSSIAN
