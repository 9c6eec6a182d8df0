"""Frozen records that are made quickly.

A frozen dataclass fills every field through `object.__setattr__`, at some 100 ns each; a control tick makes a dozen records with a
hundred fields. `quick` gives such a class another `__init__`: the new object is of a twin class without the lock while it is filled,
and of its own class when it is done. Nothing else changes: same type, same fields, frozen, slots, comparison, pickle, `replace`.
"""

from __future__ import annotations

from dataclasses import MISSING, fields, is_dataclass
from typing import Any, TypeVar

T = TypeVar("T")


def quick(cls: type[T]) -> type[T]:
    """Class decorator, above `@dataclass(frozen=True, slots=True)`.

    Raises:
        TypeError: the class is not what it is made for: frozen, slots, plain defaults, no base, no `__post_init__`.
    """
    slots = cls.__dict__.get("__slots__")
    if not is_dataclass(cls) or slots is None or cls.__bases__ != (object,) or hasattr(cls, "__post_init__"):
        raise TypeError(f"{cls.__name__}: quick is for frozen dataclasses with slots, without base and __post_init__")
    names, parameters, known = [], [], {"_unlock": object.__setattr__, "_own": cls}
    for index, field in enumerate(fields(cls)):
        if not field.init or field.kw_only or field.default_factory is not MISSING:
            raise TypeError(f"{cls.__name__}.{field.name}: quick knows positional fields with plain defaults only")
        names.append(field.name)
        if field.default is not MISSING:
            known[f"_default_{index}"] = field.default
            parameters.append(f"{field.name}=_default_{index}")
        else:
            parameters.append(field.name)
    # Same slots and same base: the layouts are the same, and an object may change between the two.
    known["_open"] = type(cls.__name__, (), {"__slots__": slots})
    lines = [
        f"def __init__(self, {', '.join(parameters)}):",
        "    _unlock(self, '__class__', _open)",
        *(f"    self.{name} = {name}" for name in names),
        "    self.__class__ = _own",
    ]
    made: dict[str, Any] = {}
    exec("\n".join(lines), known, made)  # as dataclasses does: parameters by name cost nothing then
    made["__init__"].__qualname__ = f"{cls.__qualname__}.__init__"
    made["__init__"].__annotations__ = cls.__init__.__annotations__
    cls.__init__ = made["__init__"]  # type: ignore[method-assign]
    return cls
