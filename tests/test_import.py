import subprocess
import sys

import pytest
from chosen import first


def run(code):
    """Return what a program prints, in a process of its own."""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_import_waits_with_what_is_heavy_and_changes_no_configuration():
    code = (
        "import jax; before = dict(jax.config.values); import pinhole_jax, sys; pinhole_jax.Camera;"
        "assert dict(jax.config.values) == before;"
        "heavy = ('trimesh', 'PIL', 'skimage', 'optimistix', 'beartype');"
        "print([m for m in heavy if m in sys.modules])"
    )
    assert run(code) == "[]"


def test_the_package_alone_imports_no_jax():
    code = (
        "import sys, pinhole_jax as pj; pj.__version__; hasattr(pj, '__wrapped__');"
        "print([m for m in ('jax', 'numpy') if m in sys.modules])"
    )
    assert run(code) == "[]"


@pytest.mark.parametrize(
    "code",
    first(
        3,
        [
            "import pinhole_jax as pj; print(pj.Camera.__name__)",
            "from pinhole_jax import Camera; print(Camera.__name__)",
            "from pinhole_jax import *; print(Camera.__name__)",
            "import pinhole_jax as pj; print('Camera' * ('Camera' in dir(pj)))",
            "import pinhole_jax as pj; pj.io.load_camera; pj.Camera = int; dir(pj); pj.Lens;"
            "print('Camera' if pj.Camera is int else '')",
        ],
    ),
)
def test_a_public_name_is_there_when_it_is_asked_for(code):
    assert run(code) == "Camera"


@pytest.mark.parametrize("name", first(2, ["io", "plot", "formats", "report", "shapes", "testing"]))
def test_modules_may_be_imported_first_and_in_any_way(name):
    code = (
        f"import sys, pinhole_jax as pj; module = pj.{name};"
        f"import pinhole_jax.{name}; from pinhole_jax import {name};"
        f"assert module is {name} is sys.modules['pinhole_jax.{name}'];"
        f"pj.Camera; print(pj.{name} is module, '{name}' in dir(pj), 'TYPE_CHECKING' in dir(pj))"
    )
    assert run(code) == "True True False"


def test_a_name_that_is_not_there_is_told():
    code = (
        "import pinhole_jax\n"
        "try: pinhole_jax.camera\n"
        "except AttributeError as error: print(error)\n"
        "try: from pinhole_jax import camera\n"
        "except ImportError as error: print(type(error).__name__)"
    )
    assert run(code) == "module 'pinhole_jax' has no attribute 'camera'\nImportError"
