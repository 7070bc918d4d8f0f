"""JAX made strict: float64, no silent promotion of types or ranks; every test closes its oracle.

Compiled programs are kept in `.pytest_cache`: modules and processes share them, and the next run.
"""

import gc
from pathlib import Path

import jax
import pytest

gc.set_threshold(1_000_000)  # tracing makes objects that stay: looking through them takes a third
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update(
    "jax_compilation_cache_dir", str(Path(__file__).parents[1] / ".pytest_cache" / "programs")
)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.1)

SHARED = Path(__file__).parents[2] / "shared" / "data"


def is_full(config: pytest.Config) -> bool:
    return "slow" in config.option.markexpr


@pytest.fixture
def exhaustive(pytestconfig) -> bool:
    """Whether slow tests are to run in full."""
    return is_full(pytestconfig)


def pytest_collection_modifyitems(config, items):
    """Leave out what only a full run has."""
    if not is_full(config):
        out = [item for item in items if item.get_closest_marker("full")]
        config.hook.pytest_deselected(items=out)
        items[:] = [item for item in items if item not in out]


@pytest.fixture
def shared() -> Path:
    """The folder of real meshes and photos; tests that need it are skipped where it is not."""
    if not SHARED.exists():
        pytest.skip(f"no real data at {SHARED}")
    return SHARED


@pytest.fixture(scope="module", autouse=True)
def programs_are_let_go():
    """Compiled programs hold memory maps, of which a process may have 65530: let go of a module's.

    Without it the compiler aborts in the middle of a long run.
    """
    yield
    jax.clear_caches()


@pytest.fixture(autouse=True)
def maps_are_not_used_up():
    """Let go of programs within a module too, where it has compiled very many."""
    yield
    maps = Path("/proc/self/maps")
    if maps.exists() and maps.read_bytes().count(b"\n") > 30_000:
        jax.clear_caches()
