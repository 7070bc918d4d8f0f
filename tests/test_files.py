"""The door of files: what is at a path, how much is read, what a hostile file may cost."""

import json
import os
import socket
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from chosen import full, long
from oracles import skew_camera
from PIL import ExifTags, Image
from processes import printed, python
from refusals import refusal

import pinhole_jax as pj
from pinhole_jax import formats, io
from pinhole_jax._files import paths

CAMERA = skew_camera(40, 31)
FILE_FORMATS = [name for name in formats.FORMATS if not name.startswith("colmap")]
SAVES = {
    "image": lambda path: io.save_image(path, np.zeros((3, 4))),
    "camera": lambda path: io.save_camera(path, CAMERA),
    **{
        name: lambda path, name=name: formats.write(path, {"a": CAMERA}, name)
        for name in FILE_FORMATS
    },
}


on_linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="reads /proc")


# --- where is written ----------------------------------------------------------------------------


def socket_at(path):
    with socket.socket(socket.AF_UNIX) as here:
        here.bind(str(path))  # it stays


#: What is no file: how it is made, and what the error says. Links, as devices need root.
NO_FILES = {
    "null": (lambda path: path.symlink_to("/dev/null"), "a device"),
    "full": (lambda path: path.symlink_to("/dev/full"), "a device"),
    "folder": (lambda path: path.mkdir(), "a folder"),
    "loop": (lambda path: path.symlink_to(path), "."),
    "pipe": (os.mkfifo, "."),  # that nobody reads: it is not waited for
    "socket": (socket_at, "a socket"),
}


@pytest.mark.parametrize("save", SAVES)
def test_folders_and_devices_are_never_replaced(tmp_path, monkeypatch, save):
    monkeypatch.chdir(tmp_path)  # a socket's path is short
    for name, (make, words) in NO_FILES.items():
        make(Path(name))
        before = os.lstat(name)
        with refusal(rf"`path`: expected a file to write.*{words}"):
            SAVES[save](name)
        after = os.lstat(name)
        assert (after.st_mode, after.st_ino) == (before.st_mode, before.st_ino)
    assert sorted(os.listdir()) == sorted(NO_FILES)


def test_link_is_replaced_and_not_its_target(tmp_path):
    (tmp_path / "there.json").write_text("kept")
    (tmp_path / "link.json").symlink_to("there.json")
    (tmp_path / "dangling.json").symlink_to("nowhere.json")
    for name in ("link.json", "dangling.json"):
        io.save_camera(tmp_path / name, CAMERA)
        assert not (tmp_path / name).is_symlink()
        io.load_camera(tmp_path / name)
    assert (tmp_path / "there.json").read_text() == "kept"
    assert not (tmp_path / "nowhere.json").exists()


@pytest.mark.parametrize("save", SAVES)
def test_pipe_with_a_reader_receives_the_file(tmp_path, save):
    SAVES[save](tmp_path / "file")
    os.mkfifo(tmp_path / "pipe")
    with subprocess.Popen(["cat", tmp_path / "pipe"], stdout=subprocess.PIPE) as reader:
        while True:  # the reader takes a moment
            try:
                SAVES[save](tmp_path / "pipe")
                break
            except ValueError:
                continue
        written = reader.communicate()[0]
    assert written == (tmp_path / "file").read_bytes()
    assert (tmp_path / "pipe").is_fifo()


def test_umask_is_respected_and_left_alone(tmp_path, monkeypatch):
    old = os.umask(0o027)
    try:
        with monkeypatch.context() as changed:  # a thread that makes a file now would see it
            changed.setattr("os.umask", lambda mask: pytest.fail("the umask was changed"))
            io.save_camera(tmp_path / "c.json", CAMERA)
    finally:
        os.umask(old)
    assert (tmp_path / "c.json").stat().st_mode & 0o777 == 0o640


def command(*arguments, **more):
    return python("-m", "pinhole_jax", *arguments, text=False, timeout=100, **more)


@pytest.mark.long
def test_output_can_go_to_standard_output(tmp_path):
    io.save_camera(tmp_path / "c.json", CAMERA)
    formats.write(tmp_path / "c.yaml", {"camera": CAMERA})
    # Not /dev/stdout itself, which a mistake here would replace; its name is checked below.
    done = command("convert", tmp_path / "c.json", "/proc/self/fd/1", "--to", "opencv")
    assert done.returncode == 0, done.stderr
    assert done.stdout == (tmp_path / "c.yaml").read_bytes()
    assert b"written    /proc/self/fd/1 (opencv, 1 camera" in done.stderr  # (after progress)
    assert all(map(paths.is_stream, ("/dev/stdout", "/dev/stderr", "/dev/fd/1")))
    assert not any(map(paths.is_stream, ("/dev/null", tmp_path / "out", "stdout")))


# --- what is read --------------------------------------------------------------------------------

READS = {
    "mesh": pj.load_mesh,
    "image": io.load_image,
    "mask": io.load_mask,
    "fov": io.photo_fov,
    "camera": io.load_camera,
    **{
        name: lambda path, name=name: formats.read(path, name)
        for name in FILE_FORMATS
        if formats.FORMATS[name].read
    },
}
ENDLESS = {
    "zero": lambda path: path.symlink_to("/dev/zero"),
    "pipe": os.mkfifo,
    "socket": socket_at,
    "huge": lambda path: path.touch() or os.truncate(path, 1 << 37),  # takes no room
}


@pytest.mark.parametrize("read", READS)
def test_endless_files_and_folders_are_not_read(tmp_path, monkeypatch, read):
    monkeypatch.chdir(tmp_path)
    for name, make in {**ENDLESS, "folder": Path.mkdir}.items():
        if (read, name) == ("mesh", "huge"):
            continue
        make(Path(f"{name}.obj"))
        words = rf"`path`: expected .*{name}\.obj': (a device|a pipe|a socket|more|a folder)"
        with refusal(words):
            READS[read](f"{name}.obj")
    with refusal(r"`path`: expected .*too long"):
        READS[read]("a" * 5000)
    with pytest.raises(FileNotFoundError, match=r"`path`: expected .*no such file"):
        READS[read]("no.obj")


@pytest.mark.parametrize("file", ["cameras.txt", "images.txt", "cameras.bin", "images.bin"])
def test_endless_files_of_a_model_are_not_read(tmp_path, monkeypatch, file):
    formats.write(tmp_path, {"a": CAMERA}, "colmap-binary" if "bin" in file else "colmap")
    monkeypatch.chdir(tmp_path)
    for make in ENDLESS.values():
        os.unlink(file)
        make(Path(file))
        with refusal(file):
            formats.read(".")


def test_field_given_twice_is_refused(tmp_path):
    text = json.dumps(io.camera_to_dict(CAMERA))
    (tmp_path / "c.json").write_text(text[:-1] + ', "phi": 0.3}')
    with refusal(r"expected JSON, got .*c.json': the field 'phi' twice"):
        io.load_camera(tmp_path / "c.json")
    with refusal(r"`more`: expected fields that no camera has.*\['phi'\]"):
        io.save_camera(tmp_path / "d.json", CAMERA, phi=0.3)


# --- bombs ---------------------------------------------------------------------------------------

SIZE = 200_000  # bytes of a bomb


def fill(unit, before="", after=""):
    return before + unit * (SIZE // len(unit)) + after


def defaults(count):
    rows = [f'<default name="a{k}" value="{f"$a{k - 1}" * 10}"/>' for k in range(1, count)]
    used = f'<sensor type="perspective"><float name="fov" value="$a{count - 1}"/></sensor>'
    return "<scene><default name='a0' value='0123456789'/>" + "".join(rows) + used + "</scene>"


def sensor(inside):
    return (
        f"<scene><default name='a0' value='x'/><sensor type='perspective'>{inside}</sensor></scene>"
    )


def laughs():
    rows = [f'<!ENTITY a{k} "{f"&a{k - 1};" * 10}">' for k in range(1, 9)]
    return '<!DOCTYPE s [<!ENTITY a0 "ha">' + "".join(rows) + "]><scene>&a8;</scene>"


# A long chain of nodes; its last have cameras, the last of all one that there is not.
NODES = [{"children": [k + 1], "name": f"{k}"} for k in range(6000)]
NODES += [{"children": [6001 + k], "name": f"c{k}", "camera": 0} for k in range(200)]
VIEW = {"type": "perspective", "perspective": {"yfov": 1}, "extras": {"W": 8, "H": 6}}
CHAIN = {"nodes": [*NODES, {"camera": 1}], "cameras": [VIEW]}
DEEP = ["[" * SIZE, fill('{"a":'), '{"a":' + "[" * 500 + "]" * 500 + "}", "[" * 99 + "]" * 99]
JSON = [
    "null",
    *DEEP,
    '{"a":' + "9" * SIZE,
    fill('"a":1,', "{", '"b":1}'),
    fill("[],", '{"frames":[', "[]]}"),
]
YAML = [
    fill(" ", "a", "b"),
    fill('"\\'),
    fill('"', "a: "),
    fill("' ", "a: "),
    fill("data: [ ", "camera_matrix: !!opencv-matrix\n   rows: 3\n   "),
    fill("a:[", "camera_matrix: !!opencv-matrix\n   rows: 3\n   cols: 3\n   data: [ ", " ]"),
    fill("1", "camera_matrix: ", "x"),
    fill("1", "camera_matrix: "),
    fill("9", "camera_matrix: !!opencv-matrix\n   rows: ", "\n   cols: 3\n   data: [ 1 ]"),
    fill('"\\",', "camera_names: [ "),
    fill("a", "x: !!opencv-", ""),
    fill("rows: ", "camera_matrix:\n   data: ", ""),
    fill(" # ", "a: '"),
]
XML = [
    defaults(11),
    defaults(2000),
    '<scene><default name="a" value="' + "x" * 60000 + '"/>'
    + "".join(f'<default name="b{k}" value="$a"/>' for k in range(1000)) + "</scene>",
    laughs(),
    fill("<a>"),
    fill("<a>") + fill("</a>"),
    sensor(fill("$a0", "<float name='fov' value='", "'/>")),
    sensor(fill("1,", "<float name='fov' value='4'/><transform name='to_world'><matrix value='",
                "'/></transform>")),
    sensor(fill("aA", "<float name='", "' value='x'/>")),
    f"<default name='{'a' * SIZE}' value='1'/>",
]  # fmt: skip
FIRST = "1 0 1 0 0 -1 2 3 1 a.png\n\n"
MODELS = [
    (fill("1 "), ""),
    (fill("1 PINHOLE\n"), ""),
    ("9" * 5000 + " PINHOLE 8 6 4 4 4 3\n", FIRST),
    ("1 PINHOLE 8 6 4 4 4 3\n", fill("1 2 3 ", FIRST[:-1])[:-2]),
    ("1 PINHOLE 8 6 4 4 4 3\n", FIRST * 2),
]
BOMBS = {
    "json": JSON,
    "transforms.json": JSON,
    "blender.json": JSON,
    "gltf": [*JSON, json.dumps(CHAIN), '{"nodes":[{"children":5}]}',
             '{"nodes":[{"children":[[1]]}]}', '{"nodes":[{"children":{"a":0}}]}'],
    "glb": [struct.pack("<5I", 0x46546C67, 2, 20 + len(x), len(x), 0x4E4F534A) + x.encode()
            for x in DEEP] + [struct.pack("<5I", 0x46546C67, 2, 20, 2**32 - 1, 0x4E4F534A)],
    "yaml": YAML,
    "xml": XML,
    "model": MODELS,
}  # fmt: skip
#: Each reader on its own, and the command: 2 s of processor time, 500 MB more than they began with.
#: (The longest, a file with 200 cameras, takes either 0.6 s.)
READ_ALL = """
import resource, signal, sys
from pathlib import Path
from pinhole_jax import __main__, formats, io
folder = Path(sys.argv[1])
formats.read(sys.argv[2])  # JAX makes its threads
start = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (start + 500_000_000,) * 2)
for path in sorted(folder.iterdir()):
    readers = [formats.read] + [io.load_camera] * (path.suffix == ".json")
    for read in readers:
        print(path.name, flush=True)
        signal.setitimer(signal.ITIMER_VIRTUAL, 2)
        try:
            read(path)
            sys.exit("was read")
        except ValueError as error:
            assert len(str(error)) < 1000, f"long: {len(str(error))}"
            assert path.name in str(error) or path.is_dir(), f"not named: {error}"
    out = folder / "out.json"
    signal.setitimer(signal.ITIMER_VIRTUAL, 2)
    assert __main__.main(["convert", str(path), str(out)]) == 2
    assert not out.exists()
    signal.setitimer(signal.ITIMER_VIRTUAL, 0)
"""


@on_linux
def test_hostile_files_are_refused_soon_and_in_little_room(tmp_path):
    """All in one process: to start it takes longer than to refuse them."""
    bombs = [(ending, bomb) for ending in BOMBS for bomb in BOMBS[ending]]
    for number, (ending, bomb) in enumerate(bombs):
        path = tmp_path / f"{number:03}.{ending}"
        if ending == "model":
            path.mkdir()
            for part, text in zip(("cameras.txt", "images.txt"), bomb, strict=True):
                (path / part).write_text(text)
        else:
            path.write_bytes(bomb if isinstance(bomb, bytes) else bomb.encode())
    good = tmp_path.parent / f"{tmp_path.name}.json"
    io.save_camera(good, CAMERA)
    done = python("-c", READ_ALL, tmp_path, good, timeout=300)
    seen = done.stdout.split()
    assert done.returncode == 0, (seen[-1:], done.returncode, done.stderr[-2000:])
    assert sorted({*seen}) == sorted(os.listdir(tmp_path))


# --- pictures ------------------------------------------------------------------------------------

#: (MPO: the JPEG of many telephones.)
KNOWN = {"PNG", "JPEG", "TIFF", "WEBP", "BMP", "PPM", "MPO"}


def test_picture_formats_alone_are_opened(tmp_path):
    Image.init()
    image = Image.fromarray(np.full((20, 30, 3), 255, np.uint8))
    tried = 0
    for format in sorted(Image.SAVE):
        path = tmp_path / "x.picture"  # the content counts, not the name
        try:
            image.save(path, format)
        except Exception:  # it wants another mode, or a library
            continue
        tried += 1
        if format in KNOWN:
            assert io.load_image(path).shape == (20, 30, 3)
        elif format != "DIB":
            with refusal(r"expected a readable image \(PNG, JPEG, TIFF"):
                io.load_image(path)
    assert tried > 12


def photo_at(path, n):
    """A turned photo of a disk before white, n x n pixels."""
    y, x = np.ogrid[:n, :n]
    disk = (x - n / 2) ** 2 + (y - n / 2) ** 2 < (n / 3) ** 2
    image = Image.fromarray(np.where(disk[..., None], np.uint8([200, 60, 40]), np.uint8(255)))
    image.getexif()[ExifTags.Base.Orientation] = 6
    image.save(path, exif=image.getexif())


#: The resident memory that reading a picture adds, above what the same with a small one does.
MEASURE = """
import re, sys
from pathlib import Path
from pinhole_jax import io
path, way, small = sys.argv[1:]
read = lambda path: io.load_image(path) if way == "None" else io.load_mask(path, way or None)
def most():  # not ru_maxrss, which begins with what the parent had
    return int(re.search(r"VmHWM:\\s*(\\d+)", Path("/proc/self/status").read_text())[1]) * 1024
read(small)
before = most()
read(path)
print(most() - before)
"""


@on_linux
@pytest.mark.parametrize("way", [full("None"), long("background=white")])
def test_large_picture_takes_ten_bytes_a_pixel(tmp_path, exhaustive, way):
    n = 6000 if exhaustive else 4000
    large, small = tmp_path / "large.jpg", tmp_path / "small.jpg"
    photo_at(large, n)
    photo_at(small, 600)
    added = int(printed("-c", MEASURE, large, way, small))
    assert added < 10 * n * n + 10e6  # what a band takes does not grow with the picture


def test_webp_that_takes_too_much_memory_is_refused(tmp_path):
    path = tmp_path / "w.webp"
    Image.new("L", (30, 20), 255).save(path, lossless=True)
    assert io.load_image(path).shape[:2] == (20, 30)
    data = bytearray(path.read_bytes())
    struct.pack_into("<I", data, data.index(b"VP8L") + 9, 14_000 - 1 | 7_000 - 1 << 14)
    path.write_bytes(data)
    with refusal("a WebP of more than 89478485 pixels"):
        io.load_image(path)


@pytest.mark.long
def test_file_names_need_not_be_text(tmp_path):
    path = tmp_path / os.fsdecode(b"a\n\xff.json")
    try:
        io.save_camera(path, CAMERA)
    except OSError:
        pytest.skip("this file system takes text alone as names")
    strict = {**os.environ, "PYTHONIOENCODING": "utf-8:strict"}
    done = command("convert", path, tmp_path / os.fsdecode(b"\xfe.yaml"), env=strict)
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"\\udcfe.yaml" in done.stdout
    path.write_bytes(b"{")
    done = command("convert", path, tmp_path / "b.yaml", env=strict)
    assert done.returncode == 2
    assert b"\\udcff.json'" in done.stderr


@pytest.mark.parametrize("path", ["", "x" * 5000 + ".json", "x" * 5000])
def test_impossible_path_is_refused(path):
    with refusal("`path`: expected a"):
        formats.read(path)
