"""What is listed in more than one place is the same in all of them."""

import inspect
import typing

from spt_jax import fit_pose, self_intersection_penalty
from spt_jax.cli.fit import fit
from spt_jax.fit.terms.regularisers import NAMED, SelfIntersection
from spt_jax.overlap.measure import Value


def choices(function, name):
    """The strings that an argument may be."""
    annotation = inspect.signature(function).parameters[name].annotation
    members = (annotation, *typing.get_args(annotation))
    literals = [m for m in members if typing.get_origin(m) is typing.Literal]
    return {choice for literal in literals for choice in typing.get_args(literal)}


def test_regularisers_have_the_same_names_everywhere():
    assert choices(fit_pose, "regulariser") == choices(fit, "regulariser") == NAMED.keys()
    assert all(NAMED[name]().name == name for name in NAMED)


def test_criteria_have_the_same_names_everywhere():
    known = set(typing.get_args(Value))
    assert choices(self_intersection_penalty, "value") == known
    assert choices(SelfIntersection, "value") == known
