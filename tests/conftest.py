"""JAX made strict: float64, no silent promotion of types or ranks; every test closes its oracle.

Programs are compiled as users have them, and kept in `.pytest_cache`: modules and processes share
them, and the next run.
"""

import gc
import importlib
import os
import time
from contextlib import suppress
from pathlib import Path

import jax
import jaxtyping
import pytest

PACKAGE = Path(__file__).parents[1] / "pinhole_jax"
gc.set_threshold(1_000_000)  # tracing makes objects that stay: looking through them takes a third
jax.config.update("jax_enable_x64", True)
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update(
    "jax_compilation_cache_dir", str(Path(__file__).parents[1] / ".pytest_cache" / "programs")
)
jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)  # (small ones: by the hundred)

#: Programs are kept for later modules while a process has fewer memory maps: 1.5 GB.
KEPT = 4000

SHARED = Path(__file__).parents[2] / "shared" / "data"


def pytest_addoption(parser):
    parser.addoption("--exhaustive", action="store_true", help="every test, at full size: hours")


def pytest_configure(config):
    """Check the annotations of modules with shapes; pyright checks types.

    `--jaxtyping-packages=pinhole_jax,beartype.beartype` checks all, in a twentieth more time.
    """
    if not config.option.jaxtyping_packages:
        tells = lambda path: "from jaxtyping" in path.read_text(encoding="utf-8")
        paths = [p.relative_to(PACKAGE.parent) for p in PACKAGE.rglob("*.py") if tells(p)]
        names = [".".join(path.with_suffix("").parts) for path in paths]
        jaxtyping.install_import_hook(names, "beartype.beartype")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers():
    """Return the number of workers of `-n auto`: each takes about 1 GB."""
    return min(os.cpu_count() or 1, 8)


@pytest.fixture
def in_arrays(monkeypatch):
    """Draw silhouettes by JAX's arrays, as where there is no compiled library."""
    monkeypatch.setattr("pinhole_jax._silhouette.silhouette.is_available", lambda: False)
    jax.clear_caches()  # (programs that call the library)
    yield
    jax.clear_caches()


@pytest.fixture(params=["library", pytest.param("arrays", marks=pytest.mark.long)])
def both_ways(request):
    """Draw by the library, and once more by arrays."""
    if request.param == "arrays":
        request.getfixturevalue("in_arrays")


@pytest.fixture
def exhaustive(pytestconfig):
    """Whether tests are to run at full size."""
    return pytestconfig.option.exhaustive


def pytest_collection_modifyitems(config, items):
    """Leave out what takes long, unless it is asked for."""
    if config.option.exhaustive or any("::" in argument for argument in config.args):
        return
    left_out = {"full"} if "long" in config.option.markexpr else {"full", "long"}
    out = [item for item in items if left_out & {mark.name for mark in item.iter_markers()}]
    config.hook.pytest_deselected(items=out)
    items[:] = [item for item in items if item not in set(out)]


@pytest.fixture
def shared():
    """The folder of real meshes and photos; tests that need it are skipped where it is not."""
    if not SHARED.exists():
        pytest.skip(f"no real data at {SHARED}")
    return SHARED


@pytest.fixture
def compiled():
    """Return the programs that are compiled (or read) from now on: a growing list."""
    programs = []

    def listen(event, duration, **_):
        if event == "/jax/core/compile/backend_compile_duration":
            programs.append(duration)

    jax.monitoring.register_event_duration_secs_listener(listen)
    yield programs
    with suppress(AttributeError):  # (there from JAX 0.8 on)
        jax.monitoring.unregister_event_duration_listener(listen)


def memory_maps():
    """Return the number that the process has; where that is unknown, more than are kept."""
    maps = Path("/proc/self/maps")
    return maps.read_bytes().count(b"\n") if maps.exists() else KEPT


@pytest.fixture(scope="module", autouse=True)
def programs_are_let_go():
    """Compiled programs hold memory maps, and a process may have 65530: let go of a module's, where
    there are many. (Without it the compiler aborts in a long run.)
    """
    yield
    if memory_maps() >= KEPT:
        jax.clear_caches()


@pytest.fixture(autouse=True)
def maps_are_not_used_up():
    """Let go of programs within a module too, where it has compiled very many.

    To count takes as long as most tests do: it is left out after those that took too little time to
    compile any.
    """
    begin = time.perf_counter()
    yield
    slow = time.perf_counter() - begin > 0.1
    if slow and memory_maps() > 30_000:
        jax.clear_caches()


def _of_the_arm(name):
    """A fixture that is made in `arm.py`, once this file's hooks check what that imports."""
    return pytest.fixture(scope="session", name=name)(
        lambda: getattr(importlib.import_module("arm"), name)()
    )


arm, noisy, scenes, views = map(_of_the_arm, ("arm", "noisy", "scenes", "views"))
