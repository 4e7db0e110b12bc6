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
from jaxtyping import Int

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


def each(function: Callable, common: Any, batch: Any, *, together: int | None = None) -> Any:
    """`function(common, one)` for every entry `one` along the first axis of the arrays in `batch`.

    Compiled, and cached by `function`, which therefore stands at the top of its module.  At most `together` entries
    are worked on at once by each device; without it, all are.
    """
    mesh = _mesh.get()
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves((common, batch))):
        mesh = None  # part of a larger program
    count = next(leaf for leaf in jax.tree.leaves(batch) if eqx.is_array_like(leaf)).shape[0]
    share = -(-count // (1 if mesh is None else mesh.size))
    if mesh is not None and jax.process_count() == 1:  # no more devices than have work
        mesh = Mesh(mesh.devices[: -(-count // share)], mesh.axis_names)
    rounds = -(-share // (together or share))
    group = -(-share // rounds)
    padded = group * rounds * (1 if mesh is None else mesh.size)
    if padded > count:  # padding repeats the last entry
        index = np.minimum(np.arange(padded), count - 1)
        batch = jax.tree.map(lambda a: a[index], batch)
    if mesh is None:
        common, batch = on_default_device((common, batch))
        out = _program(function)(None, group, common, batch)
    else:
        common, batch = _place(common, NamedSharding(mesh, P())), _place(batch, NamedSharding(mesh, P(AXIS)))
        out = _gather(_program(function)(mesh, group, common, batch))
    return jax.tree.map(lambda a: a[:count], out) if padded > count else out


def batches(count: int, *trees: Any) -> Iterator[tuple[Int[np.ndarray, " entry"], tuple[Any, ...]]]:
    """Batches of as many entries as there are devices: indices, and the entries of `trees`; the last is repeated at the
    end. They serve work whose results, of all entries together, would not fit the memory.
    """
    every = jax.tree.map(np.asarray, trees)  # NumPy cuts by views, JAX by a program for every shape
    for first in range(0, count, jax.device_count()):
        indices = np.minimum(np.arange(first, first + jax.device_count()), count - 1)
        yield indices, jax.tree.map(lambda a, indices=indices: a[indices], every)


@functools.cache
def _program(function: Callable) -> Callable:
    """A program under the name of what it does."""

    def run(mesh: Mesh | None, group: int, common, batch):
        numbers, static = eqx.partition(common, eqx.is_array)

        def share(numbers, batch):
            """Work of one device."""
            one = jax.vmap(lambda one: function(eqx.combine(numbers, static), one))
            size = jax.tree.leaves(batch)[0].shape[0]
            if size == group:
                return one(batch)
            out = jax.lax.map(one, jax.tree.map(lambda a: a.reshape(size // group, group, *a.shape[1:]), batch))
            return jax.tree.map(lambda a: a.reshape(size, *a.shape[2:]), out)

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
    home = jax.local_devices()[0]
    abroad = lambda a: isinstance(a, jax.Array | np.ndarray) and not _bound_to(a, home)  # noqa: E731
    arrays, others = eqx.partition(tree, abroad)  # to put a whole model where it is takes milliseconds
    if any(isinstance(leaf, Tracer) for leaf in jax.tree.leaves(tree)):
        return tree
    return eqx.combine(jax.device_put(arrays, home), others)


def _bound_to(a: Any, device: Any) -> bool:
    """True where an array is committed to this device, and to no other."""
    return isinstance(a, jax.Array) and not isinstance(a, Tracer) and a.committed and a.devices() == {device}


def _place(tree, sharding: NamedSharding):
    """Arrays that this process holds whole, where its devices' shares of them belong."""
    arrays, others = eqx.partition(tree, lambda a: isinstance(a, jax.Array | np.ndarray))
    leaves, structure = jax.tree.flatten(arrays)
    kinds = [jax.random.key_impl(a) if jnp.issubdtype(a.dtype, jax.dtypes.prng_key) else None for a in leaves]
    plain = [a if kind is None else jax.random.key_data(a) for a, kind in zip(leaves, kinds, strict=True)]
    if jax.process_count() == 1:
        if jax.default_backend() == "cpu":  # NumPy cuts by views, JAX by a program for every shape
            plain = [np.asarray(a) for a in plain]
        placed = jax.device_put(plain, sharding)  # all in one call: each takes its time
    else:
        local = [np.asarray(a) for a in plain]
        placed = [jax.make_array_from_callback(a.shape, sharding, a.__getitem__) for a in local]
    keyed = [
        a if kind is None else jax.random.wrap_key_data(a, impl=kind) for a, kind in zip(placed, kinds, strict=True)
    ]
    return eqx.combine(jax.tree.unflatten(structure, keyed), others)


def _gather(tree):
    """All of sharded arrays, on this process's first device."""
    if jax.process_count() > 1:
        return jax.tree.map(jnp.asarray, multihost_utils.process_allgather(tree, tiled=True))
    return jax.device_put(tree, jax.local_devices()[0])
