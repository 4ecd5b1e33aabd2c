"""Versions of SICD: metadata of versions that sarkit does not know are rewritten to one that it does."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from sarsplat.errors import SarsplatError, shown

if TYPE_CHECKING:
    import lxml.etree

_NAMESPACE = "urn:SICD:"
_READ_AS = dict.fromkeys(("0.4.0", "0.4.1", "0.5.0", "1.0.0", "1.0.1"), "1.1.0") | {"1.2.0": "1.2.1"}
"""Versions without a schema in sarkit → the next one with it, whose fields that are used here mean the same."""


def modernise(path: Path, tree: lxml.etree._ElementTree) -> str:
    """Change metadata of a SICD to a version that sarkit has the schema of; returns the version that the file states.

    Raises
    ------
    SarsplatError
        If it is no version that can be read.
    """
    from sarkit.sicd import VERSION_INFO

    root = tree.getroot()
    version = str(root.tag).partition("}")[0].removeprefix("{" + _NAMESPACE)
    if _NAMESPACE + version in VERSION_INFO:
        return version
    if version not in _READ_AS:
        known = sorted((*_READ_AS, *(name.removeprefix(_NAMESPACE) for name in VERSION_INFO)))
        raise SarsplatError(
            f"{path} is SICD of version {shown(version)[1:-1]}, and {', '.join(known)} are read; get it in one of these"
        )
    for element in root.iter("*"):
        element.tag = f"{{{_NAMESPACE}{_READ_AS[version]}}}{str(element.tag).rpartition('}')[2]}"
        element.attrib.pop("class", None)  # types of values, up to 0.4.1
    for name in ("Row", "Col"):  # up to 0.4.1 the name of the window alone
        weighting = root.find(f"{{*}}Grid/{{*}}{name}/{{*}}WgtType")
        if weighting is not None and len(weighting) == 0:
            window = weighting.makeelement(str(weighting.tag).replace("WgtType", "WindowName"))
            window.text, weighting.text = weighting.text, None
            weighting.append(window)
    rate = root.find("{*}RMA/{*}INCA/{*}DRateSFPoly")
    if rate is not None and rate.get("order2") is None:  # of one variable in 0.4.0
        rate.set("order2", "0")
        for coefficient in rate:
            coefficient.set("exponent2", "0")
    return version
