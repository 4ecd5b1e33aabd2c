"""Structures and functions of the engine's C ABI in ctypes, parsed from csrc/api.h."""

import ctypes
import re
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from torch import Tensor

SOURCES = Path(__file__).parents[1] / "csrc"
"""Folder of the engine's source."""

HEADER = SOURCES / "api.h"

_NUMBERS = {
    **{"float": ctypes.c_float, "double": ctypes.c_double},
    **{"int32_t": ctypes.c_int32, "int64_t": ctypes.c_int64},
}
_STRUCTURE = re.compile(r"struct (\w+) \{(.*?)\n?\};", re.DOTALL)
_MEMBER = re.compile(r"(?:const )?(unsigned long long|\w+)(?: (?=[\w*])|(?=\*))(.+)", re.DOTALL)
_FUNCTION = re.compile(r"(?:const )?(\w+\*?) \(\*(\w+)\)\((.*)\)", re.DOTALL)
_OPERATION = re.compile(r"_\((\w+), (\w+)\)")


def structures(source: str, names: Iterable[str] | None = None) -> dict[str, Any]:
    """Parse the C structures that a source declares, by name; only those of `names` if given.

    Members are numbers, arrays of them, structures declared before, functions, and pointers. Pointers to structures
    of the ABI ("sg_…") are typed, others are addresses.
    """
    source = re.sub(r"//[^\n]*", "", source)
    # expand the table of operations as the preprocessor does; skip all other directives
    operations = "".join(f"int32_t (*{name})(sg_context*, const {of}*);" for name, of in _OPERATION.findall(source))
    source = re.sub(r"^#define SG_OPERATIONS(.*\\\n)*.*$", "", source, flags=re.MULTILINE)
    source = source.replace("SG_OPERATIONS(SG_MEMBER)", operations)
    source = re.sub(r"^#.*$", "", source, flags=re.MULTILINE)
    found: dict[str, Any] = {}
    for name, body in _STRUCTURE.findall(source):
        if names is None or name in names:
            fields = [field for member in body.split(";") if member.strip() for field in _fields(member.strip(), found)]
            found[name] = type(name, (ctypes.Structure,), {"_fields_": fields})
    return found


def _fields(member: str, earlier: Mapping[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield names and types in one declaration, such as `const float *power, *truth`, given earlier structures."""
    if function := _FUNCTION.fullmatch(member):
        result, name, arguments = function.groups()
        types = (next(_fields(argument.strip(), earlier))[1] for argument in arguments.split(",") if argument.strip())
        yield name, ctypes.CFUNCTYPE(_type(result, earlier), *types)
        return
    split = _MEMBER.fullmatch(member)
    assert split is not None, member
    base, declared = split.groups()
    for one in declared.split(","):
        name, *sizes = re.findall(r"\w+", one) or [""]
        of = _type(base + "*" * one.count("*"), earlier)
        yield name, of * int(sizes[0]) if sizes else of


def _type(name: str, earlier: Mapping[str, Any]) -> Any:
    base = name.rstrip("*")
    if base == name:
        return None if name == "void" else _NUMBERS[name] if name in _NUMBERS else earlier[name]
    if base == "char":
        return ctypes.c_char_p
    return ctypes.POINTER(earlier[base]) if base in earlier and base.startswith("sg_") else ctypes.c_void_p


api = SimpleNamespace(
    **{name.removeprefix("sg_"): one for name, one in structures(HEADER.read_text(encoding="utf-8")).items()}
)
"""Structures of csrc/api.h by their names without sg_, such as `api.problem(views=1)`."""


@cache
def structure_of(operation: str) -> Any:
    """Return the structure that an operation takes."""
    return dict(api.engine._fields_)[operation]._argtypes_[1]._type_


@cache
def members_of(structure: Any) -> dict[str, Any]:
    """Return the types of a structure's members, by name."""
    return dict(structure._fields_)


def filled(structure: Any, values: Mapping[str, Any]) -> Any:
    """Fill a structure with numbers, tuples of them, tensors, and lists of such values of other structures.

    It holds addresses of tensors, which must outlive it.
    """
    made, members = structure(), members_of(structure)
    for name, value in values.items():
        of = members[name]
        if isinstance(value, Tensor):
            value = value.data_ptr() if of is ctypes.c_void_p else value.item()  # a number may be a tensor, too
        elif isinstance(value, list):
            value = (of._type_ * len(value))(*(filled(of._type_, one) for one in value))
        if value is not None or of in _NUMBERS.values():  # an address is null as it begins, and a number is required
            setattr(made, name, value)
    return made
