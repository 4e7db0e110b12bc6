import os
import signal
from pathlib import Path

# numbers are the same to the last bit for the same number of devices only, here and in the processes that tests start
os.environ["JAX_NUM_CPU_DEVICES"] = "1"
# Compiling took two thirds of the time of the tests.  These settings leave a third of it;
# programs run 2.5 times as long.
os.environ["JAX_DISABLE_MOST_OPTIMIZATIONS"] = "1"
os.environ["XLA_FLAGS"] = "--xla_cpu_use_fusion_emitters=false"

import jax
import pytest
from costs import Costs

ROOT = Path(__file__).resolve().parents[1]

# a shell that runs the tests in the background ignores Ctrl-C, and so would the processes that tests send it to
signal.signal(signal.SIGINT, signal.default_int_handler)
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_compilation_cache_dir", str(ROOT / ".cache" / "jax"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)  # the many small programs are what takes the time


def pytest_configure(config: pytest.Config) -> None:
    """Count what is compiled."""
    config.pluginmanager.register(Costs())


@pytest.fixture(scope="module", autouse=True)
def _programs():
    """After each file, programs are let go where they hold many memory maps: a worker runs hundreds of tests."""
    yield
    from nnap_em.numerics.programs import release_programs

    release_programs(35_000)


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder `shared` beside the checkout: logs and the paper, which are not part of the repository."""
    path = ROOT.parent / "shared"
    if not path.is_dir():
        pytest.skip("no folder `shared` beside the checkout, so no logs to read")
    return path


@pytest.fixture(scope="session")
def bench():
    """A few short sequences of the paper's acrobot, its model, and the smoothed paths."""
    # not at the top: the types of what is imported before pytest is configured are not checked
    import equinox as eqx

    from nnap_em.data.rig import Declared, Rig
    from nnap_em.em.build import build
    from nnap_em.model.base import prepare
    from nnap_em.model.simulate import paper_experiment, paper_model
    from nnap_em.smoother.gaussian import CubatureSmoother
    from nnap_em.systems.acrobot import table_i

    truth = paper_model()
    data = paper_experiment(truth, 4, 59, key=jax.random.key(5)).data
    rig = Rig(
        "bench",
        "acrobot",
        {name: Declared(value, 0.0) for name, value in table_i.items()},
        True,
        ("u",),
        (2,),
        0.01,
        "sequence",
        ("theta1", "dtheta1"),
        {"theta1": 0.01, "dtheta1": 0.05},
        {"theta2": Declared(0.0, 0.5), "dtheta1": Declared(0.0, 0.02), "dtheta2": Declared(0.0, 0.02)},
    )
    problem = build(rig, data, key=jax.random.key(0))
    model = eqx.tree_at(lambda m: (m.log_q, m.log_r), problem.model, (truth.log_q + 2.0, truth.log_r))
    smoother = CubatureSmoother(problem.bank)
    path = eqx.filter_jit(lambda d: jax.vmap(lambda s: smoother(model, prepare(model, s)))(d))(data).state
    return rig, model, problem.mstep, data, path


@pytest.fixture(scope="session")
def slide_fit():
    """A fit of `slide_rig()` to `slide_logs(0)`."""
    from rigs import slide_logs, slide_rig

    from nnap_em.fit.identify import identify

    return identify(slide_rig(), slide_logs(0), key=jax.random.key(0))
