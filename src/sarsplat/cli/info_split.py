"""What `sarsplat info` says of standard splits of MSTAR: of a dataset's own part, and of a folder of their datasets."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sarsplat.errors import counted

_FOR = "they count for classifiers (`sarsplat chips --measured`), and reconstructions have no use for them"


_NUMBERS = ("found", "published", "without_azimuth")


@dataclass(frozen=True)
class SplitSource:
    """What a dataset's source says of the split that it belongs to."""

    name: str
    target: str
    parts: list[dict[str, int | str]]
    """As `mstar_splits.Divided.counts`."""
    unplaced: int
    """Number of chips without azimuth."""

    @classmethod
    def of(cls, target: str, source: Mapping[str, Any]) -> SplitSource | None:
        """None if there is no split, or none of ours."""
        from sarsplat.importers.mstar_splits import SPLITS

        try:
            name, parts = source["split"]["name"], [{**part} for part in source["split"]["parts"]]
            if name not in SPLITS or not all(isinstance(part[key], int) for part in parts for key in _NUMBERS):
                return None
            if not all(part["set"] in ("train", "test") and isinstance(part["part"], str) for part in parts):
                return None
            return cls(name, target, parts, len(source.get("unplaced", ())))
        except (KeyError, TypeError, ValueError):  # a header that someone else has changed
            return None

    def rows(self) -> dict[str, str]:
        """Names and values for a table."""
        from sarsplat.importers.mstar_splits import in_words

        rows = {"split": "\n".join([f"{self.name}, of MSTAR", *in_words(self.parts)])}
        if self.unplaced:
            rows["unplaced"] = f"{counted(self.unplaced, 'chip')} without azimuth, in the folder unplaced; {_FOR}"
        return rows

    def incomplete(self) -> str:
        """How many chips there are and should be, if these are not the same; in a few words."""
        sums: dict[str, list[int]] = {}
        for part in self.parts:
            numbers = sums.setdefault(str(part["set"]), [0, 0])
            for index, key in enumerate(("found", "published")):
                numbers[index] += int(part[key])
        if all(found == published for found, published in sums.values()):
            return ""
        said = ", ".join(f"{kind} {found:,} of {published:,}" for kind, (found, published) in sums.items())
        return f"{self.target}: {said}"


def rows_of_all(sources: Sequence[SplitSource]) -> dict[str, str]:
    """What of a split is there in several datasets, one a class, and what is missing; nothing if they are of none."""
    from sarsplat.importers.mstar_chips import same_class
    from sarsplat.importers.mstar_splits import SPLITS

    rows = {}
    for name in dict.fromkeys(one.name for one in sources):
        own, split = [one for one in sources if one.name == name], SPLITS[name]  # type: ignore[index]
        missing = [one for one in split.classes if not any(same_class(other.target, one) for other in own)]
        lacking = f"; {', '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing" if missing else ""
        rows[f"split {name}"] = f"{len(split.classes) - len(missing)} of {len(split.classes)} classes{lacking}"
        found = Counter[str]()
        for part in (part for one in own for part in one.parts):
            found[str(part["set"])] += int(part["found"])
        for kind, parts in (("train", split.train), ("test", split.test)):
            published = sum(part.count for part in parts)
            rows[f"{kind} {name}"] = f"{found[kind]:,} of {published:,} chips"
        if short := [said for one in own if (said := one.incomplete())]:
            rows[f"not whole, {name}"] = "\n".join(short)
    if unplaced := sum(one.unplaced for one in sources):
        rows["unplaced"] = f"{counted(unplaced, 'chip')} without azimuth, in the datasets' folders unplaced; {_FOR}"
    return rows
