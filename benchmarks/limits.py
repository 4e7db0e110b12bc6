"""The transition of the common work alone, in JAX and in C: no particle filter can be faster."""

import ctypes
import subprocess
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from common_work import Case, Size, common_logs, common_model, compiled

from nnap_em.model.state_space import Inputs


def start_particles(size: Size):
    """Draws from the prior of the first row, (seq, state, particle), and the inputs (seq, time, input)."""
    model = common_model()
    noise = jax.random.normal(jax.random.key(3), (size.sequences, 4, size.particles))
    x = model.start.mean[None, :, None] + jnp.sqrt(jnp.diag(model.start.cov))[None, :, None] * noise
    return x, common_logs(size).data.u[:, : size.steps]


def transition_case(what: str, transition, axis: int, size: Size) -> Case:
    """A transition alone, over the particles of all sequences, step by step; `axis` is that of the particles."""

    def prepare():
        x, u = start_particles(size)

        def one(x, u):
            move = jax.vmap(transition, in_axes=(axis, None), out_axes=axis)
            return jax.lax.scan(lambda x, u: (move(x, u), None), x, u)[0]

        return compiled(jax.vmap(one), x if axis == 1 else jnp.swapaxes(x, 1, 2), u)

    return Case("limit", what, size, prepare)


def build_c(flags: tuple[str, ...]) -> ctypes.CDLL:
    """`transition.c` as a library; gcc is needed."""
    folder = Path(tempfile.mkdtemp())
    source, library = Path(__file__).with_name("transition.c"), folder / "transition.so"
    command = ["gcc", "-O3", "-march=native", "-ffast-math", *flags, "-shared", "-fPIC", source, "-o", library]
    subprocess.run([*command, "-lmvec", "-lm"], check=True)
    return ctypes.CDLL(str(library))


def propagate_in_c(library: ctypes.CDLL, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Particles (seq, state, particle) after all inputs (seq, time, 1)."""
    model = common_model()
    arm, m22 = model.system, model.system.I2 + model.system.m2 * model.system.lc2**2
    m11 = arm.I1 + arm.m1 * arm.lc1**2 + m22 + arm.m2 * arm.l1**2
    gravity1 = (arm.m1 * arm.lc1 + arm.m2 * arm.l1) * arm.g
    lumped = [m11, m22, arm.m2 * arm.l1 * arm.lc2, gravity1, arm.m2 * arm.lc2 * arm.g, model.dt]
    weights = np.concatenate([np.ravel(w) for net in model.unknown.joints for w in net]).astype(np.float32)
    place = lambda a: a.ctypes.data_as(ctypes.c_void_p)  # noqa: E731
    lumped, u, x = np.asarray(lumped, np.float32), np.ascontiguousarray(u, np.float32), np.array(x, np.float32)
    for seq in range(x.shape[0]):
        library.propagate(place(lumped), place(weights), place(u[seq]), u.shape[1], place(x[seq]), x.shape[2])
    return x


def c_case(what: str, flags: tuple[str, ...], size: Size) -> Case:
    """The transition in C; its numbers are first held against the library's."""

    def prepare():
        library = build_c(flags)
        x, u = (np.asarray(a) for a in start_particles(size))
        move = lambda x, u: common_model().transition(x, Inputs.held(u))  # noqa: E731
        once = jax.vmap(jax.vmap(move, (1, None), 1))(jnp.asarray(x), jnp.asarray(u[:, 0]))
        gap = float(np.max(np.abs(propagate_in_c(library, x, u[:, :1]) - np.asarray(once))))
        assert gap < 1e-4, f"the C transition is off by {gap:.1e}"
        return lambda: propagate_in_c(library, x, u)

    return Case("limit", what, size, prepare)
