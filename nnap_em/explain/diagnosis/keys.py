"""Identity of effects, their names for a reader, and the laws that complete or replace one another."""

import re
from collections.abc import Sequence
from typing import Any

import jax

from ...machines.systems import AbstractSystem
from ...model.effects import AbstractEffect, catalogue, flat
from ...model.state_space import StateSpaceModel

Key = tuple[str, int | None, str | None, tuple[str, ...]]
"""Name, joint, channel and inputs of an effect."""


def key_of(effect: AbstractEffect) -> Key:
    """Identity of an effect: two with the same key are the same law in the same place."""
    return effect.name, effect.joint, effect.channel, effect.inputs_named()


def place_of(key: Key) -> dict[str, Any]:
    """Name of a law in the report, its place, and its name in words."""
    name, joint, channel, inputs = key
    place = {"joint": joint, "channel": channel, "inputs": list(inputs)}
    return {"name": catalogue[name].key(), **place, "law": words(key)}


def words(key: Key) -> str:
    """Name of an effect for a reader."""
    name, joint, channel, inputs = key
    text = name.replace("_", " ")
    if inputs:
        text += f" of {' and '.join(inputs)}"
    on = "all sensors" if channel == "all" else channel
    return text + (f" at joint {joint}" if joint else "") + (f" on {on}" if on else "")


def with_article(name: str) -> str:
    """Name of an effect, as `words` writes it, with its article."""
    # Last words of the laws that take no article
    mass_nouns = ("air drag", "cogging", "backlash", "friction", "inertia", "flexibility", "saturation", "emf")
    if re.split(" of | at | on ", name)[0].endswith(mass_nouns):
        return name
    return ("an " if re.match("[aeiu]|o(?!ne)", name) else "a ") + name


def listed(names: Sequence[str]) -> str:
    """Names joined as in a sentence; without any, an empty text."""
    return " and ".join(filter(None, (", ".join(names[:-1]), *names[-1:])))


def remainder_of(effect: AbstractEffect, model: StateSpaceModel) -> int | None:
    """Place of the named law whose rest an unnamed one is: a function of the same signals at the same joint."""
    laws = (i for i, e in enumerate(model.effects) if e.named and contains(effect, e, model.system))
    return next(laws, None)


def replaced(effect: AbstractEffect, model: StateSpaceModel) -> int | None:
    """Place of the law whose place `effect` takes: of the same key in another form, as one that repeats each turn."""
    places = (i for i, e in enumerate(model.effects) if key_of(e) == key_of(effect))
    if effect.named:  # of a law with a form the richer one alone
        places = (i for i in places if flat(effect).size > flat(model.effects[i]).size)
    return next((i for i in places if jax.tree.structure(model.effects[i]) != jax.tree.structure(effect)), None)


def completed(effect: AbstractEffect, model: StateSpaceModel) -> bool:
    """True if an unnamed law in the model is a function of the same signals at the same joint as a named one."""
    return effect.named and any(contains(e, effect, model.system) for e in model.effects)


def complexity(law: AbstractEffect, model: StateSpaceModel | None = None) -> int:
    """Number of signals in which a law without a name is free, 0 for one with a name; -1 for a part of what a `model`
    has already.
    """
    if model is not None and not (remainder_of(law, model) is None and replaced(law, model) is None):
        return -1
    return 0 if law.named else max(1, len(law.inputs_free()))


def elsewhere(one: Key, other: Key) -> bool:
    """True for the same law at another joint or on another reading."""
    plain = lambda key: (key[0], tuple(re.sub(r"\d+", "", name) for name in key[3]))  # noqa: E731
    return one[1:3] != other[1:3] and plain(one) == plain(other)


def contains(free: AbstractEffect, law: AbstractEffect, system: AbstractSystem) -> bool:
    """True where a function at a joint can be what `law` is: a named law of its signals, or a function of fewer; one of
    dry friction only what is dry.
    """
    signals, of_law = (set(effect.signals(system)) for effect in (free, law))
    inside = of_law == signals if law.named else of_law < signals
    return not free.named and bool(of_law) and inside and free.joint == law.joint and law.dry >= free.dry
