import subprocess
import sys


def test_import_waits_with_what_is_heavy_and_changes_no_configuration():
    code = (
        "import jax; before = dict(jax.config.values); import pinhole_jax, sys;"
        "assert dict(jax.config.values) == before;"
        "heavy = ('trimesh', 'PIL', 'skimage', 'optimistix', 'beartype');"
        "print([m for m in heavy if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.stdout.strip() == "[]", done.stderr
