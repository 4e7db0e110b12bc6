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
    from nnap_em.base.programs import release_programs

    release_programs(35_000)


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder `shared` beside the checkout: logs and the paper, which are not part of the repository."""
    path = ROOT.parent / "shared"
    if not path.is_dir():
        pytest.skip("no folder `shared` beside the checkout, so no logs to read")
    return path


@pytest.fixture(scope="session")
def slide_fit():
    """A fit of `slide_rig()` to `slide_logs(0)`."""
    from rigs import slide_logs, slide_rig

    from nnap_em.estimate.identify import identify

    return identify(slide_rig(), slide_logs(0), key=jax.random.key(0))
