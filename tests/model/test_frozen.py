"""What `quick` makes is the frozen record that it was, only sooner."""

from __future__ import annotations

import copy
import dataclasses
import pickle
from dataclasses import dataclass, field

import pytest

from companion.model.frozen import quick


@dataclass(frozen=True, slots=True)
class Plain:
    a: float
    b: tuple[float, ...] = (1.0, 2.0)
    c: str | None = None


@quick
@dataclass(frozen=True, slots=True)
class Quick:
    a: float
    b: tuple[float, ...] = (1.0, 2.0)
    c: str | None = None


def test_by_place_by_name_and_by_default() -> None:
    assert Quick(1.0) == Quick(a=1.0, b=(1.0, 2.0), c=None)
    assert dataclasses.astuple(Quick(1.0, (3.0,), "x")) == dataclasses.astuple(Plain(1.0, (3.0,), "x"))
    assert Quick(1.0) != Quick(2.0)
    assert hash(Quick(1.0)) == hash(Plain(1.0))
    assert repr(Quick(1.0)) == repr(Plain(1.0)).replace("Plain", "Quick")


def test_it_is_of_its_own_class_and_locked() -> None:
    record = Quick(1.0)
    assert type(record) is Quick
    with pytest.raises(dataclasses.FrozenInstanceError):
        record.a = 2.0  # type: ignore[misc]
    with pytest.raises(dataclasses.FrozenInstanceError):
        del record.a
    assert not hasattr(record, "__dict__")


def test_copies_pickles_and_replaces() -> None:
    record = Quick(1.0, (5.0,), "x")
    for other in (copy.copy(record), copy.deepcopy(record), pickle.loads(pickle.dumps(record))):
        assert other == record
        assert type(other) is Quick
    assert dataclasses.replace(record, a=2.0) == Quick(2.0, (5.0,), "x")


def test_wrong_arguments_are_refused_as_ever() -> None:
    with pytest.raises(TypeError, match="missing 1 required positional argument: 'a'"):
        Quick()  # type: ignore[call-arg]
    with pytest.raises(TypeError, match="unexpected keyword argument 'd'"):
        Quick(1.0, d=2.0)  # type: ignore[call-arg]


def test_what_it_cannot_do_is_refused_when_the_class_is_made() -> None:
    with pytest.raises(TypeError, match="with slots"):

        @quick
        @dataclass(frozen=True)
        class NoSlots:
            a: float

    with pytest.raises(TypeError, match="plain defaults"):

        @quick
        @dataclass(frozen=True, slots=True)
        class Factory:
            a: list[float] = field(default_factory=list)
