import subprocess
import sys


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


def test_package_import_loads_no_jax():
    code = (
        "import sys, pinhole_jax as pj; pj.__version__; hasattr(pj, '__wrapped__');"
        "print([m for m in ('jax', 'numpy') if m in sys.modules])"
    )
    assert run(code) == "[]"


#: Ways to a public name: each prints it.
WAYS = [
    "import pinhole_jax as pj; print(pj.Camera.__name__)",
    "from pinhole_jax import Camera; print(Camera.__name__)",
    "from pinhole_jax import *; print(Camera.__name__)",
    "import pinhole_jax as pj; print('Camera' * ('Camera' in dir(pj)))",
    "import pinhole_jax as pj; pj.io.load_camera; pj.Camera = int; dir(pj); pj.Lens;"
    "print('Camera' if pj.Camera is int else '')",
]
MODULES = ["io", "plot", "formats", "report", "shapes", "testing"]


def imported_anew(codes):
    """Return what programs print, one after the other in one process that keeps JAX alone."""
    code = (
        "import sys\n"
        f"for code in {codes!r}:\n"
        "    for name in [*sys.modules]:\n"
        "        if name.split('.')[0] == 'pinhole_jax': del sys.modules[name]\n"
        "    exec(code, {})"
    )
    return run(code).splitlines()


def test_public_names_load_on_demand():
    assert imported_anew(WAYS) == ["Camera"] * len(WAYS)


def test_modules_may_be_imported_first_and_in_any_way():
    way = (
        "import sys, pinhole_jax as pj; module = pj.{0};"
        "import pinhole_jax.{0}; from pinhole_jax import {0};"
        "assert module is {0} is sys.modules['pinhole_jax.{0}'];"
        "pj.Camera; print(pj.{0} is module, '{0}' in dir(pj), 'TYPE_CHECKING' in dir(pj))"
    )
    codes = [way.format(name) for name in MODULES]
    assert imported_anew(codes) == ["True True False"] * len(MODULES)


def test_unknown_name_raises_attribute_error():
    code = (
        "import pinhole_jax\n"
        "try: pinhole_jax.camera\n"
        "except AttributeError as error: print(error)\n"
        "try: from pinhole_jax import camera\n"
        "except ImportError as error: print(type(error).__name__)"
    )
    assert run(code) == "module 'pinhole_jax' has no attribute 'camera'\nImportError"
