import os
from pathlib import Path

# numbers are the same to the last bit for the same number of devices only, here and in the processes that tests start
os.environ["JAX_NUM_CPU_DEVICES"] = "1"

import jax
import pytest

ROOT = Path(__file__).resolve().parents[1]

jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_compilation_cache_dir", str(ROOT / ".cache" / "jax"))
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)  # the many small programs are what takes the time


@pytest.fixture(scope="session")
def shared() -> Path:
    """Folder `shared` beside the checkout: logs and the paper, which are not part of the repository."""
    path = ROOT.parent / "shared"
    if not path.is_dir():
        pytest.skip("no folder `shared` beside the checkout, so no logs to read")
    return path
