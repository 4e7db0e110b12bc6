"""The limits of the machine: the transition of the common work alone, in JAX and in C, and a smoother in C."""

import ctypes
import subprocess
import tempfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from common_work import START, START_STD, Case, Size, common_logs, common_model, compiled, one_start, smoother_case

from nnap_em.model.state_space import Inputs
from nnap_em.smoother.gaussian import ExtendedKalmanSmoother


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


def build_c(name: str, *flags: str) -> ctypes.CDLL:
    """A file of this folder as a library; gcc is needed."""
    source, library = Path(__file__).with_name(name), Path(tempfile.mkdtemp(), "compiled.so")
    command = ["gcc", "-O3", "-march=native", "-ffast-math", *flags, "-shared", "-fPIC", source, "-o", library]
    subprocess.run([*command, "-lmvec", "-lm"], check=True)
    return ctypes.CDLL(str(library))


def place(array: np.ndarray) -> ctypes.c_void_p:
    """The address of an array, for a C function."""
    return array.ctypes.data_as(ctypes.c_void_p)


def in_c() -> tuple[list[float], np.ndarray]:
    """The lumped constants of the arm and its networks, in the order of the C files."""
    model = common_model()
    arm, m22 = model.system, model.system.I2 + model.system.m2 * model.system.lc2**2
    m11 = arm.I1 + arm.m1 * arm.lc1**2 + m22 + arm.m2 * arm.l1**2
    gravity1 = (arm.m1 * arm.lc1 + arm.m2 * arm.l1) * arm.g
    weights = np.concatenate([np.ravel(w) for net in model.unknown.joints for w in net]).astype(np.float32)
    return [m11, m22, arm.m2 * arm.l1 * arm.lc2, gravity1, arm.m2 * arm.lc2 * arm.g, model.dt], weights


def propagate_in_c(library: ctypes.CDLL, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Particles (seq, state, particle) after all inputs (seq, time, 1)."""
    constants, weights = in_c()
    lumped, u, x = np.asarray(constants, np.float32), np.ascontiguousarray(u, np.float32), np.array(x, np.float32)
    for seq in range(x.shape[0]):
        library.propagate(place(lumped), place(weights), place(u[seq]), u.shape[1], place(x[seq]), x.shape[2])
    return x


def c_case(what: str, flags: tuple[str, ...], size: Size) -> Case:
    """The transition in C; its numbers are first held against the library's."""

    def prepare():
        library = build_c("transition.c", *flags)
        x, u = (np.asarray(a) for a in start_particles(size))
        move = lambda x, u: common_model().transition(x, Inputs.held(u))  # noqa: E731
        once = jax.vmap(jax.vmap(move, (1, None), 1))(jnp.asarray(x), jnp.asarray(u[:, 0]))
        gap = float(np.max(np.abs(propagate_in_c(library, x, u[:, :1]) - np.asarray(once))))
        assert gap < 1e-4, f"the C transition is off by {gap:.1e}"
        return lambda: propagate_in_c(library, x, u)

    return Case("limit", what, size, prepare)


def c_smoother_case(size: Size) -> Case:
    """The extended Kalman filter and RTS smoother in C; its means are first held against those of one pass of ours."""
    lanes = 16 * -(-size.sequences // 16)  # vectors of 512 bits; the last ones repeat sequences
    states = lambda rows: rows[:, :4, : size.sequences].transpose(2, 0, 1)  # noqa: E731

    def prepare():
        library, (constants, weights) = build_c("smoother.c", f"-DLANES={lanes}"), in_c()
        model, data, pick = common_model(), common_logs(size).data, np.arange(lanes) % size.sequences
        variances = [*np.exp(model.log_q), *np.exp(model.log_r), *START, *np.square(START_STD)]
        numbers = np.asarray([*constants, *variances], np.float32)
        u = np.ascontiguousarray(np.asarray(data.u)[pick, :, 0].T, np.float32)
        y = np.ascontiguousarray(np.asarray(data.y)[pick].transpose(1, 2, 0), np.float32)
        rows, loglik = np.zeros((len(y), 72, lanes), np.float32), np.zeros(lanes, np.float32)

        def run():
            library.smooth(*map(place, (numbers, weights, u, y)), len(y), place(rows), place(loglik))
            return rows

        ours = smoother_case("", ExtendedKalmanSmoother(one_start, iterations=0), size)
        gap = float(np.max(np.abs(states(run()) - np.asarray(ours.states(ours.prepare()())))))
        assert gap < 1e-3, f"the C smoother is off by {gap:.1e}"  # 32 bits over 500 rows: 2e-4 rad/s, 2e-5 rad
        return run

    return Case("limit", "C smoother", size, prepare, states)
