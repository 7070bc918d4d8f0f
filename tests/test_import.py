import pytest
from processes import printed


def test_import_waits_with_what_is_heavy_and_changes_no_configuration():
    code = (
        "import sys, pinhole_jax as pj; pj.__version__; hasattr(pj, '__wrapped__')\n"
        "light = [m for m in ('jax', 'numpy') if m in sys.modules]\n"
        "import jax; before = dict(jax.config.values); pj.Camera\n"
        "assert dict(jax.config.values) == before\n"
        "heavy = ('trimesh', 'PIL', 'skimage', 'optimistix', 'beartype')\n"
        "print(light + [m for m in heavy if m in sys.modules])"
    )
    assert printed("-c", code) == "[]\n"


#: Ways to a public name, and to modules: each prints it.
WAYS = [
    "import pinhole_jax as pj; print(pj.Camera.__name__)",
    "from pinhole_jax import Camera; print(Camera.__name__)",
    "from pinhole_jax import *; print(Camera.__name__)",
    "import pinhole_jax as pj; print('Camera' * ('Camera' in dir(pj)))",
    "import pinhole_jax as pj; pj.io.load_camera; pj.Camera = int; dir(pj); pj.Lens;"
    "print('Camera' if pj.Camera is int else '')",
    *(
        f"import sys, pinhole_jax as pj; module = pj.{name};"
        f"import pinhole_jax.{name}; from pinhole_jax import {name};"
        f"assert module is {name} is sys.modules['pinhole_jax.{name}'];"
        f"pj.Camera; print('Camera' * (pj.{name} is module and '{name}' in dir(pj)))"
        for name in ("io", "plot", "formats", "report", "shapes", "testing")
    ),
]


@pytest.mark.long
def test_public_names_and_modules_load_on_demand_in_any_order():
    """One after the other in one process that keeps JAX alone."""
    code = (
        "import sys\n"
        f"for code in {WAYS!r}:\n"
        "    for name in [*sys.modules]:\n"
        "        if name.split('.')[0] == 'pinhole_jax': del sys.modules[name]\n"
        "    exec(code, {})"
    )
    assert printed("-c", code).splitlines() == ["Camera"] * len(WAYS)


def test_unknown_name_raises_attribute_error():
    import pinhole_jax

    with pytest.raises(AttributeError, match="module 'pinhole_jax' has no attribute 'camera'"):
        _ = pinhole_jax.camera
    with pytest.raises(ImportError):
        from pinhole_jax import camera as _  # noqa: F401
    assert "TYPE_CHECKING" not in dir(pinhole_jax)
