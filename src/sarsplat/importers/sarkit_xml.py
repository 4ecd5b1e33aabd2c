"""Metadata of SICD and CPHD files: untrusted XML, whose elements are read by sarkit."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sarsplat.errors import SarsplatError, shown

if TYPE_CHECKING:
    import lxml.etree

LONGEST_XML = 4 << 20
"""Maximum size of metadata, bytes."""
_HIGHEST_ORDER = 20


@dataclass(frozen=True)
class Metadata:
    """Metadata of one file of any version; elements are named by their path, such as "Grid/Row/SS"."""

    path: Path
    tree: lxml.etree._ElementTree

    def text(self, name: str) -> str:
        """Return the printable text of an element; "" if it is missing."""
        return printable(self.tree.findtext(any_version(name)))


def any_version(name: str) -> str:
    """Return a path of elements of any namespace, which differs between versions."""
    return "/".join("{*}" + part for part in name.split("/"))


def printable(text: str | None) -> str:
    """Return text without unprintable letters, cut to 80."""
    return "".join(letter if letter.isprintable() else "?" for letter in (text or "").strip())[:80]


def plain_xml(path: Path, text: bytes, kind: str) -> lxml.etree._ElementTree:
    """Parse the XML of a SICD or another `kind` without resolving entities; raise for a DOCTYPE or absurd exponents."""
    import lxml.etree

    plain = lxml.etree.XMLParser(resolve_entities=False, no_network=True, load_dtd=False, huge_tree=False)
    try:
        tree = lxml.etree.fromstring(text, plain).getroottree()
    except (lxml.etree.LxmlError, ValueError) as error:
        raise SarsplatError(
            f"{path} has metadata that are not valid XML ({shown(str(error))}); get it again"
        ) from error
    if tree.docinfo.doctype or tree.docinfo.internalDTD is not None:
        raise SarsplatError(f"{path} has a DOCTYPE in its XML, which no {kind} has, and is not read; get it elsewhere")
    for element in tree.iter("{*}Coef"):  # sarkit makes an array as large as the highest exponents say
        for power in (element.get(name, "0") for name in ("exponent1", "exponent2")):
            if not (power.isascii() and power.isdigit() and int(power[:9]) <= _HIGHEST_ORDER):
                raise SarsplatError(
                    f"{path} has a polynomial with the exponent {shown(power)}; at most {_HIGHEST_ORDER} is plausible, "
                    "so get it again"
                )
    return tree


@contextmanager
def sarkit_errors(path: Path, kind: str = "SICD") -> Iterator[None]:
    """Turn any exception of sarkit, which trusts its files, into one sentence, and hide its warnings."""
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    except (SarsplatError, OSError, MemoryError):
        raise
    except Exception as error:
        problem = shown(f"{type(error).__name__}: {error}")
        raise SarsplatError(f"{path} is not a valid {kind} (sarkit says {problem}); get it again") from error
