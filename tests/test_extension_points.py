"""What is listed in more than one place is the same in all of them."""

import inspect
import typing

from spt_jax import fit as public
from spt_jax import self_intersection_penalty
from spt_jax.cli.fit import fit
from spt_jax.fit import Regularizer, SelfIntersection, as_regularizer, regularizer_names
from spt_jax.overlap.measure import Value


def choices(function, name):
    """The strings that an argument may be."""
    annotation = inspect.signature(function).parameters[name].annotation
    members = (annotation, *typing.get_args(annotation))
    literals = [m for m in members if typing.get_origin(m) is typing.Literal]
    return {choice for literal in literals for choice in typing.get_args(literal)}


def test_regularizers_have_the_same_names_everywhere():
    names = regularizer_names()
    assert choices(fit, "regularizer") == set(names)
    found = {type(as_regularizer(name)) for name in names}
    assert [as_regularizer(name).name for name in names] == list(names)
    exported = {getattr(public, name) for name in public.__all__}
    kinds = {kind for kind in exported if isinstance(kind, type) and issubclass(kind, Regularizer)}
    assert found == kinds - {Regularizer}


def test_criteria_have_the_same_names_everywhere():
    known = set(typing.get_args(Value))
    assert choices(self_intersection_penalty, "value") == known
    assert choices(SelfIntersection, "value") == known
