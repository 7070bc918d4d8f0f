"""Damaged files for each reader: a `ValueError` that names what is wrong, 5 s and 1 GB at most.

    python tests/fuzz_readers.py --seconds 60 [--only obj,png]

Each reader has a process with a limit of memory; a bell rings after 5 s of the processor. libFuzzer
(atheris) damages a valid file and keeps what reaches new branches, until one breaks the contract:
then it ends with 1. Where that is missing, and in `test_garbage`, files are damaged at random.
"""

import argparse
import contextlib
import importlib
import io
import itertools
import json
import os
import re
import resource
import signal
import sys
import tempfile
import time
import traceback
from collections import namedtuple
from importlib.util import find_spec
from pathlib import Path

import jax
import numpy as np
import trimesh
from PIL import Image
from processes import python

atheris = None
with contextlib.suppress(ModuleNotFoundError):
    atheris = importlib.import_module("atheris")

SPEC = find_spec("pinhole_jax")
PACKAGE = Path(SPEC.origin).parent
#: What atheris watches: it never frees what comparing two arrays results in, so that no code that
#: works on pictures is among them. (Damaged TIFFs of 13 million pixels each filled the process.)
READERS = ("_files/", "_mesh_files/", "formats/", "robots/", "io/rle", "io/text")


def others():
    """The names of the modules that atheris does not watch."""
    names = [path.relative_to(PACKAGE).as_posix() for path in PACKAGE.rglob("*.py")]
    names = [name.removesuffix(".py") for name in names if not name.startswith(READERS)]
    return [f"pinhole_jax/{name}".removesuffix("/__init__").replace("/", ".") for name in names]


def watched():
    """In it, imported readers become such that atheris sees their branches."""
    if atheris is None:
        return contextlib.nullcontext()
    return atheris.instrument_imports(["pinhole_jax"], others())


with watched():
    from oracles import usual_camera

    import pinhole_jax as pj

    for part in ("formats", "io", "robots"):
        getattr(pj, part)

GB, SECONDS = 1 << 30, 5.0
WORDS = [*b"nan -1 0 1e400 1e300 1.7 99999999999 - null [] {} ' \xff".split(), b"9" * 5000, b""]
TOKEN = re.compile(rb"[\w.+-]+|[^\w\s]")
CAMERA = usual_camera()
URDF = b"""<robot name="r"><link name="a"><visual><geometry><box size="1 1 1"/></geometry></visual>
</link><link name="b"/><joint name="j" type="revolute"><parent link="a"/><child link="b"/>
<axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""
#: Kinds of meshes, and how trimesh writes them.
MESHES = {
    "obj": [{}],
    "ply": [{}, {"encoding": "ascii"}],
    "stl": [{}, {"file_type": "stl_ascii"}],
    "off": [{}],
    "dae": [{}],
    "glb": [{}],
    "gltf": [{"embed_buffers": True, "merge_buffers": True}],
}
#: Compressions of a TIFF that not all modes have.
COMPRESSED = {"jpeg": ("L", "RGB"), "group4": ("1",)}
#: Kinds of pictures: Pillow's modes, and what they are saved with.
PICTURES = {
    "png": (("L", "1", "P", "RGBA", "I;16"), [{}]),
    "tiff": (
        ("L", "1", "RGB", "I;16", "F"),
        [{}, *({"compression": x} for x in ("tiff_lzw", "packbits", "jpeg", "group4", "zstd"))],
    ),
    "bmp": (("L", "1", "RGB"), [{}]),
    "webp": (("RGB", "RGBA"), [{}, {"lossless": True}]),
    "pgm": (("L", "1", "RGB", "I;16"), [{}]),
    "jpeg": (("L", "RGB"), [{}, {"progressive": True}]),
}


#: A reader: the name of its file, how to read one, and valid ones.
Target = namedtuple("Target", "file read valid")


def targets(folder):
    """All readers by name."""
    kinds = [kind for kind in MESHES if kind != "dae" or find_spec("collada")]
    load_mesh = lambda path: pj.load_mesh(path, say=str)  # coarse steps are no error
    found = {kind: Target(f"mesh.{kind}", load_mesh, [*meshes(kind)]) for kind in kinds}
    found["urdf"] = Target("robot.urdf", pj.robots.load_urdf, [URDF])
    files = {"json": "camera.json", "opencv": "camera.yaml", "nerf": "transforms.json",
             "blender": "blender.json", "gltf": "camera.gltf", "pytorch3d": "pytorch3d.json",
             "mitsuba": "camera.xml", "colmap": "text", "colmap-binary": "binary"}  # fmt: skip
    for form, file in files.items():
        whole = folder / file
        pj.formats.write(whole, {"camera": CAMERA}, form)
        read = lambda _, whole=whole, form=form: pj.formats.read(whole, form)
        for path in sorted(whole.iterdir()) if whole.is_dir() else [whole]:
            name = f"{form} {path.stem}"
            found[name] = Target(str(path.relative_to(folder)), read, [path.read_bytes()])
    mask = np.asarray(pj.silhouette(CAMERA, pj.Scene(pj.shapes.bumpy(1))))
    for kind in PICTURES:
        found[kind] = Target(f"mask.{kind}", pj.io.load_mask, [*pictures(mask, kind)])
    rle = json.dumps({"size": [80, 96], "counts": [100, 20, 7560]}).encode()
    load = pj.io.load_json
    found["rle"] = Target("rle.json", lambda path: pj.io.mask_of_rle(load(path)), [rle])
    return found


def meshes(kind):
    """A box as files of a kind, each as trimesh writes it."""
    for options in MESHES[kind]:
        data = trimesh.creation.box().export(**({"file_type": kind} | options))
        data = data["model.gltf"] if isinstance(data, dict) else data
        yield data if isinstance(data, bytes) else data.encode()


def pictures(mask, kind):
    """A mask as files of a kind: each sort of pixels, each compression that Pillow writes."""
    modes, options = PICTURES[kind]
    grey = Image.fromarray(np.round(255 * mask[::4, ::4]).astype(np.uint8))
    for mode, option in itertools.product(modes, options):
        if mode not in COMPRESSED.get(option.get("compression", ""), modes):
            continue
        with contextlib.suppress(OSError), io.BytesIO() as file:  # (not all go together)
            grey.convert("L").convert(mode).save(file, kind.replace("pgm", "ppm"), **option)
            yield file.getvalue()


def damaged(valid, random):
    """One of the files with one to four wounds."""
    data = valid[random.integers(len(valid))]
    for _ in range(random.integers(1, 5)):
        at, end = np.sort(random.integers(0, len(data) + 1, 2))
        kind = random.integers(6)
        if kind == 0:
            data = data[:at]
        elif kind == 1 and end - at < 200:
            data = data[:at] + data[end:]
        elif kind == 2:
            data = (
                data[:at] + data[at : min(end, at + 200)] * int(random.integers(2, 9)) + data[at:]
            )
        elif kind == 3:
            data = data[:at] + bytes(random.integers(0, 256, 4, dtype=np.uint8)) + data[at + 4 :]
        elif tokens := list(TOKEN.finditer(data)):
            token, word = tokens[random.integers(len(tokens))], WORDS[random.integers(len(WORDS))]
            data = data[: token.start()] + word + data[token.end() :]
    return data


class SlowError(BaseException):
    """Raised by the bell."""


def ring(*_):
    raise SlowError(f"takes more than {SECONDS} s")


def broken(target, path):
    """The error that a reader's contract does not allow, if there is one."""
    signal.setitimer(signal.ITIMER_PROF, SECONDS)
    try:
        read = jax.tree.leaves(target.read(path))
        numbers = (x for x in map(np.asarray, read) if x.dtype.kind == "f")
        return None if all(map(np.all, map(np.isfinite, numbers))) else ValueError("not finite")
    except ValueError as error:
        named = re.search(r"`|\(in |, line \d", str(error))  # a field, a file, or a file's line
        return None if named and type(error) is ValueError else error
    except OSError:
        return None
    except BaseException as error:
        return error
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


def guided(target, path, seconds, keep):
    """Read what libFuzzer makes of a valid file; ends the process, with 77 at a wrong error."""
    corpus = path.parent / "corpus"
    corpus.mkdir()
    for k, data in enumerate(target.valid):
        (corpus / str(k)).write_bytes(data)

    def read(data):
        path.write_bytes(data)
        if (error := broken(target, path)) is not None:
            raise error

    ways = (
        f"-max_total_time={seconds:.0f}",
        "-rss_limit_mb=0",
        "-verbosity=0",
        "-print_final_stats=1",
    )
    atheris.Setup([sys.argv[0], *ways, f"-artifact_prefix={keep}/", str(corpus)], read)
    atheris.Fuzz()


def at_random(target, path, seconds, keep):
    """Read damaged files, and end the process with 1 at a wrong error."""
    chance, end = np.random.default_rng(0), time.process_time() + seconds
    for count in itertools.count():
        if time.process_time() > end:
            print(f"{count} inputs", flush=True)
            return
        path.write_bytes(damaged(target.valid, chance))
        if (error := broken(target, path)) is not None:
            (keep / path.name).write_bytes(path.read_bytes())
            traceback.print_exception(error)
            sys.exit(1)


def limit_memory():
    """Let this process have one more GB."""
    size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (size + GB, size + GB))


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=60, help="in all")
    parser.add_argument("--only", type=lambda names: names.split(","), default=None)
    parser.add_argument("--keep", type=Path, default=Path(), help="inputs that broke something")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        known = targets(Path(name))
        names = [name for name in known if asked.only is None or name in asked.only]
        seconds = asked.seconds / len(names)
        if len(names) > 1:
            words = "-W", "ignore", *sys.argv, "--seconds", seconds, "--only"
            more = {"capture_output": False, "env": {**os.environ, "TMPDIR": name}}
            run = lambda kind: python(*words, kind, **more).returncode
            return max(print(kind, flush=True) or run(kind) for kind in names)
        target = known[names[0]]
        asked.keep.mkdir(exist_ok=True)
        signal.signal(signal.SIGPROF, ring)
        limit_memory()
        fuzz = at_random if atheris is None else guided
        fuzz(target, Path(name) / target.file, seconds, asked.keep)
        return 0


if __name__ == "__main__":
    sys.exit(main())
