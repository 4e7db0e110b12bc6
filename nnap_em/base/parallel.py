"""The same work for every sequence, over the devices of a mesh, in groups that bound the memory.

    with over(all_devices()):
        fitted = identify(rig, data, key=key)

Sequences are independent but for sums in the M-step, so that nothing is exchanged while a program runs: results are
gathered after it, within a machine by a copy, among processes (`jax.distributed`) by one collective.
"""

import contextlib
import contextvars
import functools
from collections.abc import Callable, Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.experimental import multihost_utils
from jax.sharding import Mesh, NamedSharding
from jax.sharding import PartitionSpec as P

from .digest import is_key
from .traced import traced

AXIS = "seq"
_mesh: contextvars.ContextVar[Mesh | None] = contextvars.ContextVar("nnap_em_mesh", default=None)


@contextlib.contextmanager
def over(mesh: Mesh) -> Iterator[None]:
    """Spread sequences over `mesh`, which has one axis "seq", in what is called inside.

    Raises ValueError where the mesh has other axes.
    """
    if mesh.axis_names != (AXIS,):
        raise ValueError(f'the axes of the mesh are {mesh.axis_names}; make it with the one axis "{AXIS}"')
    token = _mesh.set(mesh)
    try:
        yield
    finally:
        _mesh.reset(token)


def all_devices() -> Mesh:
    """Every device of every process."""
    return jax.make_mesh((jax.device_count(),), (AXIS,), axis_types=(jax.sharding.AxisType.Auto,))


def everywhere(flag: bool) -> bool:
    """True where `flag` is true in every process."""
    if jax.process_count() == 1:
        return flag
    return bool(np.all(multihost_utils.process_allgather(np.asarray(flag))))


def use_every_device() -> None:
    """Spread sequences over all devices from here on; commands and examples do."""
    if jax.device_count() > 1:
        _mesh.set(all_devices())


GROUP = 4
"""Entries on which a device of the processor works at once, so that one program serves any number of them: long work,
whose start costs nothing beside it.

All of 20 sequences at once are smoothed in four fifths of the time, and compiled anew for every number.
"""


def few_sizes(count: int) -> int:
    """Size of arrays that hold as many entries: 32, or the next power of two."""
    return 1 << max(5, (count - 1).bit_length())


def each(function: Callable, common: Any, batch: Any, *, together: int | None = None, group: int = GROUP) -> Any:
    """`function(common, one)` for every entry `one` along the first axis of the arrays in `batch`, as many as the first
    of these has.

    Compiled, and cached by `function`, which therefore stands at the top of its module.  At most `together` entries
    are worked on at once by each device; without it, on an accelerator, all are, and on a processor a `group`.
    """
    count = next(leaf for leaf in jax.tree.leaves(batch) if eqx.is_array_like(leaf)).shape[0]
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((common, batch))):  # part of a larger program
        return jax.vmap(lambda one: function(common, one))(jax.tree.map(lambda a: a[:count], batch))
    mesh = _mesh.get()
    share = -(-count // (1 if mesh is None else mesh.size))
    if mesh is not None and jax.process_count() == 1:  # no more devices than have work
        mesh = Mesh(mesh.devices[: -(-count // share)], mesh.axis_names)
    on_processor = jax.default_backend() == "cpu"
    if not on_processor:
        group = min(together or share, share)
    else:
        group = min(together or group, 1 << (share - 1).bit_length() if share <= GROUP else group)  # few programs
    at_once = group * (1 if mesh is None else mesh.size)
    program, parts = _program(function), []
    common = on_default_device(common) if mesh is None else _place(common, NamedSharding(mesh, P()))
    for first in range(0, count, at_once):
        index = np.minimum(np.arange(first, first + at_once), count - 1)  # padding repeats the last entry
        some = jax.tree.map(lambda a: a if len(a) == at_once else _by_numbers(lambda n: n[index], a), batch)  # noqa: B023
        if mesh is None:
            parts.append(program(None, common, on_default_device(some)))
        else:
            parts.append(_gather(program(mesh, common, _place(some, NamedSharding(mesh, P(AXIS))))))
    if count == at_once:
        return parts[0]
    if on_processor:  # NumPy joins without a program for every shape
        joined = jax.tree.map(lambda *a: np.concatenate([np.asarray(one) for one in a])[:count], *parts)
        return jax.device_put(joined, jax.local_devices()[0])
    return jax.tree.map(lambda *a: jnp.concatenate(a)[:count], *parts)


@functools.cache
def _program(function: Callable) -> Callable:
    """A program under the name of what it does."""

    def run(mesh: Mesh | None, common, batch):
        numbers, static = eqx.partition(common, eqx.is_array)

        def share(numbers, batch):
            """Work of one device."""
            return jax.vmap(lambda one: function(eqx.combine(numbers, static), one))(batch)

        if mesh is None:
            return share(numbers, batch)
        # check_vma is about scans that begin with what all devices share and go on with their own: all of ours do
        specs = {"in_specs": (P(), P(AXIS)), "out_specs": P(AXIS)}
        return jax.shard_map(share, mesh=mesh, check_vma=False, **specs)(numbers, batch)

    run.__name__ = run.__qualname__ = f"each{function.__name__}"
    return traced(run, function)


def on_default_device(tree: Any) -> Any:
    """Arrays on this process's first device, where `each` leaves its results.

    A program is compiled once for arrays that are bound to a device, and once more where one of them is not.
    """
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree)):
        return tree
    home = jax.local_devices()[0]

    def abroad(a: Any) -> bool:
        at_home = isinstance(a, jax.Array) and a.committed and a.devices() == {home}
        return isinstance(a, jax.Array | np.ndarray) and not at_home

    arrays, others = eqx.partition(tree, abroad)  # to put a whole model where it is takes milliseconds
    return eqx.combine(jax.device_put(arrays, home), others)


def _by_numbers(change: Callable, a: Any) -> Any:
    """`change` of an array, or of the numbers of random keys."""
    if not is_key(a):
        return change(np.asarray(a))
    return jax.random.wrap_key_data(change(np.asarray(jax.random.key_data(a))), impl=jax.random.key_impl(a))


def _place(tree, sharding: NamedSharding):
    """Arrays that this process holds whole, where its devices' shares of them belong."""
    arrays, others = eqx.partition(tree, lambda a: isinstance(a, jax.Array | np.ndarray))
    if jax.process_count() == 1:
        if jax.default_backend() == "cpu":  # NumPy cuts by views, JAX by a program for every shape
            arrays = jax.tree.map(lambda a: a if is_key(a) else np.asarray(a), arrays)
        return eqx.combine(jax.device_put(arrays, sharding), others)  # all in one call: each takes its time
    spread = lambda a: jax.make_array_from_callback(a.shape, sharding, a.__getitem__)  # noqa: E731
    return eqx.combine(jax.tree.map(lambda a: _by_numbers(spread, a), arrays), others)


def _gather(tree):
    """All of sharded arrays, on this process's first device."""
    if jax.process_count() > 1:
        return jax.tree.map(jnp.asarray, multihost_utils.process_allgather(tree, tiled=True))
    return jax.device_put(tree, jax.local_devices()[0])
