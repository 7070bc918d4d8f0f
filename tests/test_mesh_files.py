"""What mesh files say, against polygons in shapely and triangles written down by hand."""

import base64
import codecs
import json
import os
import re
import struct
import time

import numpy as np
import pytest
import shapely
import trimesh
from folders import put, triangles_of
from numpy.testing import assert_allclose, assert_array_equal
from oracles import CORNERS, QUAD
from refusals import pairs, refusal
from scipy.spatial.transform import Rotation
from test_polygons import SHAPES, covered

import pinhole_jax as pj

# --- polygons in every format --------------------------------------------------------------------

NAMES = ["chevron", "square", "L", "arrow", "star", "bridge", "corners in line"]
FLAT = [np.add(SHAPES[name], [10.0 * k, 0]) for k, name in enumerate(NAMES)]
TRIANGLE = np.array([[90, 0], [91, 0], [90, 1.0]])
FACES = [*FLAT, TRIANGLE]
POINTS = np.pad(np.concatenate(FACES), ((0, 0), (0, 1)), constant_values=0.5)
COUNTS = [len(face) for face in FACES]
INDICES = np.split(np.arange(len(POINTS)), np.cumsum(COUNTS)[:-1])


def obj(corner="{}", back=False, end="\n", more=""):
    lines = ["# a comment", "mtllib ../secret.mtl", "o one"]
    for face, corners in zip(FACES, INDICES, strict=True):
        lines += [f"v {x} {y} 0.5{more}" for x, y in face]
        lines += ["vt 0 0", "vn 0 0 1", "usemtl f_1", "s off", "l 1 2"]
        names = corners + 1 if not back else corners - corners[-1] - 1
        lines += ["f " + " ".join(corner.format(k) for k in names) + " # a face"]
    return end.join(lines).encode()


def off(kind="OFF", colour="", around=""):
    rows = [" ".join(map(str, p)) + around for p in POINTS]
    rows += [f"{len(c)} " + " ".join(map(str, c)) + colour for c in INDICES]
    return f"{kind}\n# sizes\n{len(POINTS)} {len(FACES)} 0\n\n".encode() + "\n".join(rows).encode()


#: PLY's types, as `struct` has them.
CODES = {"uchar": "B", "int": "i", "float": "f", "double": "d", "short": "h", "uint": "I",
         "ushort": "H"}  # fmt: skip


def ply(order="<", name="vertex_indices", length="uchar", index="int", real="float", more=False):
    """`more`: a table before, and more properties, lists too, before and after the vertices'."""
    form = {"<": "binary_little_endian", ">": "binary_big_endian", "": "ascii"}[order]
    head = [f"ply\nformat {form} 1.0\ncomment x\nobj_info y"]
    head += ["element note 2\nproperty list uchar short n"] * more
    head += [f"element vertex {len(POINTS)}", *["property uchar red"] * more]
    head += [*(f"property {real} {x}" for x in "xyz"), *["property double w"] * more]
    head += [f"element face {len(FACES)}", *["property list uchar float texcoord"] * more]
    head += [f"property list {length} {index} {name}"]
    head += ["property uchar flags\nproperty float area"] * more
    rows = [("uchar", 3), *(("short", k) for k in range(3)), ("uchar", 0)] if more else []
    for point in POINTS:
        rows += [("uchar", 9)] * more + [(real, x) for x in point] + [("double", 1.5)] * more
    for k, corners in enumerate(INDICES):
        rows += [("uchar", k), *[("float", 0.5)] * k] if more else []
        rows += [(length, len(corners)), *((index, int(c)) for c in corners)]
        rows += [("uchar", 7), ("float", 2.5)] if more else []
    if order:
        body = b"".join(struct.pack(order + CODES[kind], x) for kind, x in rows)
    else:
        body = " ".join(str(x) for _, x in rows).encode()
    return "\n".join([*head, "end_header\n"]).encode() + body


KINDS = {"obj": obj, "off": off, "ply": ply}
FILES = {
    "plain.obj": obj(),
    "textures.obj": obj("{}/1"),
    "normals.obj": obj("{}//1"),
    "both.obj": obj("{0}/1/1"),
    "colours.obj": obj(more=" 0.1 0.2 0.3"),
    "back.obj": obj(back=True),
    "back_textures.obj": obj("{}/-1/-1", back=True),
    "windows.obj": obj(end="\r\n"),
    "indented.obj": obj(end="\n \t"),
    "split.obj": obj().replace(b"f 1 2 3", b"f 1 2 \\\n 3"),
    "plain.off": off(),
    "colours.off": off("COFF", " 0.1 0.2 0.3 1", " 255 0 0 255"),
    "normals.off": off("NOFF", " 1", " 0 0 1"),
    "no_header.off": off(""),
    "one_line.off": off("OFF").replace(b"OFF\n# sizes\n", b"OFF"),
    "little.ply": ply(),
    "big.ply": ply(">", real="double", index="uint"),
    "text.ply": ply(""),
    "name.ply": ply(name="vertex_index", length="int"),
    "short.ply": ply(">", index="ushort", name="vertex_index"),
    **{f"marked.{x}": codecs.BOM_UTF8 + make() for x, make in KINDS.items()},
    "more.ply": ply(more=True),
    "more_big.ply": ply(">", more=True),
    "more_text.ply": ply("", more=True),
}


def mesh_of(tmp_path, name, data):
    return pj.load_mesh(put(tmp_path, name, data))


@pairs("name, data", FILES)
def test_polygons_of_every_format_cover_what_they_cover(tmp_path, name, data):
    found = triangles_of(mesh_of(tmp_path, name, data))
    assert len(found) == sum(COUNTS) - 2 * len(COUNTS)
    assert_array_equal(found[..., 2], 0.5)
    owner = ((found[..., 0].mean(axis=1) + 3) // 10).astype(int)
    for k, face in zip((*range(len(FLAT)), 9), FACES, strict=True):
        parts = shapely.polygons(found[owner == k][..., :2])
        assert shapely.area(shapely.unary_union(parts)) == pytest.approx(covered(face), rel=1e-6)
        assert np.sum(shapely.area(parts)) == pytest.approx(covered(face), rel=1e-6)
    assert np.min(trimesh.triangles.cross(found)[:, 2]) > -1e-5


STRIPS = b"""ply
format ascii 1.0
element vertex 6
property float x
property float y
property float z
element tristrips 1
property list int int vertex_indices
end_header
0 0 0
0 1 0
1 0 0
1 1 0
5 0 0
5 1 0
9 0 2 1 3 -1 4 5 3 3
"""


def test_strips_of_a_ply_file(tmp_path):
    found = triangles_of(mesh_of(tmp_path, "s.ply", STRIPS))
    assert_allclose(np.sort(trimesh.triangles.cross(found)[:, 2]), [1, 1, 4])


def ascii_stl(corners):
    loop = "".join(f"vertex {x} 0 {x * x}\n" for x in range(corners))
    return f"solid a vertex\nfacet normal 0 0 1\nouter loop\n{loop}endloop\nendfacet\n".encode()


STL = ascii_stl(3) + b"endsolid\n"
#: A face with a number left open.
TEXTS = {
    "obj": "v 0 0 0\nv 1 0 {}\nv 0 1 0\nf 1 2 3 # a face\n",
    "off": "OFF\n3 1 0\n0 0 0\n1 0 {} # a corner\n0 1 0\n3 0 1 2\n",
    "ply": "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\n"
    "property float z\nelement face 1\nproperty list uchar int vertex_indices\nend_header\n"
    "0 0 0\n1 0 {}\n0 1 0\n3 0 1 2\n",
    "stl": "solid\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 {}\n"
    "vertex 0 1 0\nendloop\nendfacet\nendsolid\n",
}
#: How Windows writes what is no number.
WORDS = ["1.#QNAN", "-1.#IND00", "1.#INF", "1#INF", "-nan(ind)", "nan", "inf"]
OTHERS = {
    **{f"{w}.{kind}": (text.format(w).encode(), "") for kind, text in TEXTS.items() for w in WORDS},
    **{f"utf16.{kind}": (text.encode("utf-16"), "UTF-16") for kind, text in TEXTS.items()},
    "stl_quad.stl": (ascii_stl(6) + b"endsolid\n", "facets of three corners"),
    "stl_number.stl": (STL.replace(b"vertex ", b"vertex 7 ", 1), "three coordinates"),
    "stl_two.stl": (STL + STL[:-9], "without its end"),
    "stl_cut.stl": (ascii_stl(3), "without its end"),
    "stl_short.stl": (b"solid" + bytes(75) + struct.pack("<I", 2) + bytes(50), "without its end"),
    "surface.obj": (obj() + b"\nsurf 0 1 0 1 1 2 3 4", "the statement 'surf'"),
    "comma.obj": (b"v 0,5 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3", "numbers in vertices"),
    "flat.obj": (b"v 0 5\nv 1 0 0\nv 0 1 0\nf 1 2 3", "vertex 1: 2 coordinates"),
    "back.obj": (b"v 0 0 0\nf -1 -2 -3\nv 1 0 0\nv 0 1 0", "faces with vertices 0 to 2"),
    "crossed.obj": (b"v 0 0 0\nv 1 1 0\nv 1 0 0\nv 0 1 0\nf 1 2 3 4", "face 1: its sides cross"),
    "binary.off": (b"OFF BINARY\n" + bytes(99), "OFF BINARY: only text"),
    "four.off": (off("4OFF"), "only text and three dimensions"),
    "short_line.off": (b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n4 0 1 2\n", "4 corners in a line of 4"),
    "part.off": (b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 1.5\n", "whole numbers"),
    "more.ply": (ply() + b"\0", "bytes of rows as its header says"),
    "less.ply": (ply()[:-1], "ends before the 8 rows of 'face'"),
    "more_text.ply": (ply("") + b"\n1", "bytes of rows as its header says"),
    "negative.ply": (ply(length="int").replace(struct.pack("<i", 4), b"\xff" * 4, 1), "list of -1"),
    "other.ply": (ply(name="corners"), "'vertex_indices' in 'face'"),
    "no_z.ply": (ply("").replace(b"float z", b"float k"), "one x, y and z each, got x, y, k"),
    "header.ply": (ply().replace(b"1.0", b"2.0"), "the line 'format binary_little_endian 2.0'"),
    "fewer.ply": (ply().replace(b"face 8", b"face -1"), "the line 'element face -1'"),
    "faces.ply": (ply().replace(b"face 8", b"face 1000000000"), "it ends before the 10+ rows"),
    "vertices.ply": (ply("").replace(b"vertex ", b"vertex 1000000000"), "ends before the 1"),
    "faces.off": (off().replace(b" 8 0", b" 1000000000 0"), "and 1000000000 faces as its header"),
    "many.stl": (bytes(80) + struct.pack("<I", 2**32 - 1) + bytes(50), "for 4294967295 faces"),
    "nan.stl": (bytes(80) + struct.pack("<I12fH", 1, *12 * [np.nan], 0), "NaN or infinity"),
    "zero.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "vertex 0; they are counted from 1"),
    "beyond.obj": (b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "with vertices 0 to 2, .* 0 to 8"),
    "empty.obj": (b"", "no faces"),
    "points.obj": (b"v 0 0 0\nv 1 0 0\n", "no faces"),
    "noise.ply": (b"hello", "no ply at its beginning"),
    "mesh.txt": (b"v 0 0 0", "one of .dae, .obj"),
    "huge.obj": (b"v 1e400 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "finite vertices"),
}  # fmt: skip


@pairs("name, data, message", OTHERS)
def test_unsupported_features_are_refused_by_name(tmp_path, name, data, message):
    with refusal(f"`path`: expected .*{message}"):
        mesh_of(tmp_path, name, data)


def test_stl_text_has_any_names_normals_and_line_ends(tmp_path, caplog):
    plain = triangles_of(mesh_of(tmp_path, "a.stl", STL))
    for text in (
        STL.upper(),
        STL.replace(b"\n", b"\r"),
        STL.replace(b"\n", b"\r\n"),
        codecs.BOM_UTF8 + STL,
        re.sub(rb"solid[^\n]*", rb"solid vertex normal 1", STL),
        *(STL.replace(b"0 0 1\n", n) for n in (b"-1.#IND 0 0\n", b"0,0 0,0 1,0\n", b"x y z\n")),
    ):
        assert text != STL
        mesh = mesh_of(tmp_path, "b.stl", text)
        assert_array_equal(triangles_of(mesh), plain)
    assert not caplog.records


def test_no_file_that_an_obj_names_is_opened(tmp_path, monkeypatch):
    path = put(tmp_path, "a.obj", b"mtllib /etc/hostname\nmtllib ../x.mtl\n" + obj())
    opened, plain = [], os.open
    monkeypatch.setattr(os, "open", lambda p, *rest: opened.append(p) or plain(p, *rest))
    monkeypatch.setattr("builtins.open", lambda *_: pytest.fail("another file is opened"))
    pj.load_mesh(path)
    assert {*opened} == {path}


# --- glTF ----------------------------------------------------------------------------------------

KINDS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
SQUARE = np.maximum(CORNERS, 0).astype("<f4")
TWO = np.array(QUAD, "<u2")


class File:
    """A glTF file put together by hand: arrays go to one buffer, every part to its list."""

    def __init__(self):
        self.data, self.top = b"", {"asset": {"version": "2.0"}, "scene": 0}
        self.top |= {"scenes": [{"nodes": []}], "accessors": [], "bufferViews": [], "meshes": []}
        self.top["nodes"] = []

    def add(self, kind, **part):
        """Add a part to its list, and return its number."""
        self.top[kind].append(part)
        return len(self.top[kind]) - 1

    def view(self, data, **more):
        self.data += bytes(-len(self.data) % 4)
        start, self.data = len(self.data), self.data + data
        return self.add("bufferViews", buffer=0, byteOffset=start, byteLength=len(data), **more)

    def accessor(self, array):
        kind = {"componentType": KINDS[array.dtype.str[1:]], "count": len(array)}
        kind["type"] = "SCALAR" if array.ndim == 1 else "VEC3"
        return self.add("accessors", bufferView=self.view(array.tobytes()), **kind)

    def primitive(self, points, indices=None, mode=4, **more):
        own = {"attributes": {"POSITION": self.accessor(points)}, "mode": mode, **more}
        return own if indices is None else {**own, "indices": self.accessor(np.ravel(indices))}

    def mesh(self, *primitives, **more):
        return self.add("meshes", primitives=[*primitives], **more)

    def node(self, root=True, **more):
        number = self.add("nodes", **more)
        self.top["scenes"][0]["nodes"] += [number] * root
        return number

    def bytes(self, uri=None, binary=False):
        data = "data:application/octet-stream;base64," + base64.b64encode(self.data).decode()
        buffer = {"byteLength": len(self.data)} | ({} if binary else {"uri": uri or data})
        text = json.dumps({**self.top, "buffers": [buffer]}).encode()
        if not binary:
            return text
        parts = [x + b" " * (-len(x) % 4) for x in (text, self.data)]
        kinds = zip(parts, (0x4E4F534A, 0x004E4942), strict=True)
        body = b"".join(struct.pack("<2I", len(x), kind) + x for x, kind in kinds)
        return struct.pack("<3I", 0x46546C67, 2, 12 + len(body)) + body

    def load(self, tmp_path, binary=False, **more):
        name = "a.glb" if binary else "a.gltf"
        return mesh_of(tmp_path, name, self.bytes(binary=binary, **more))


def one_node(points=SQUARE, indices=TWO):
    """A file of one node, and a square or another mesh."""
    f = File()
    f.node(mesh=f.mesh(f.primitive(points, indices)))
    return f


def check_triangles(mesh, expected):
    """Assert that a mesh has these triangles (T, 3, 3), each the same way round."""

    def ordered(triangles):
        points = [[tuple(p) for p in np.round(t, 3) + 0.0] for t in triangles]
        return sorted(tuple(np.roll(t, -t.index(min(t)), axis=0).ravel()) for t in points)

    assert_allclose(ordered(triangles_of(mesh)), ordered(expected), atol=2e-3)


@pytest.mark.parametrize("kind", ["u1", "u2", "u4"])
def test_indexed_triangles(tmp_path, kind):
    f = one_node(indices=TWO.astype(kind))
    check_triangles(f.load(tmp_path, binary=kind == "u2"), SQUARE[TWO])


def test_strips_triangles_lines_and_points_in_one_mesh(tmp_path):
    strip = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 2, 0]], "<f4")
    joined = np.array([0, 1, 2, 2, 3, 3, 4, 1], "<u1")  # corners that come again join two strips
    f = File()
    parts = [f.primitive(strip, mode=5), f.primitive(strip + 30, joined, mode=5)]
    parts += [f.primitive(strip[:3] + 50, mode=mode) for mode in (0, 1, 2, 3, 4)]
    f.node(mesh=f.mesh(*parts))
    expected = [*strip[[[0, 1, 2], [1, 3, 2], [2, 3, 4]]], strip[:3] + 50]
    check_triangles(f.load(tmp_path), [*expected, *(strip + 30)[[[0, 1, 2], [3, 1, 4]]]])


@pytest.mark.parametrize("kind", ["i1", "u1", "i2", "u2"])
def test_quantized_positions(tmp_path, kind):
    top = np.iinfo(kind).max
    points = np.array([[0, 0, 0], [top, 0, 0], [top, top, top // 2]], kind)
    f = one_node(points, None)
    f.top["extensionsRequired"] = ["KHR_mesh_quantization"]
    check_triangles(f.load(tmp_path), [points])


def test_interleaved_data_at_offsets(tmp_path):
    f = File()
    rows = np.concatenate([np.full((4, 1), 7), SQUARE, np.full((4, 2), 8)], axis=1).astype("<f4")
    view = f.view(b"skip" + rows.tobytes()[:-8], byteStride=24)
    f.add("accessors", bufferView=view, byteOffset=8, componentType=5126, count=4, type="VEC3")
    index = f.accessor(TWO.ravel())
    f.node(mesh=f.mesh({"attributes": {"POSITION": 0}, "indices": index}))
    check_triangles(f.load(tmp_path), SQUARE[TWO])


def test_names_cameras_and_materials_are_no_shape(tmp_path):
    """Names that trimesh uses itself, a camera that would cost its node the children, textures."""
    f = File()
    mesh = f.mesh(f.primitive(SQUARE, TWO, material=0), name="world", extras={"skin": 1})
    child = f.node(False, mesh=mesh, name="world", translation=[0, 0, 1])
    f.node(mesh=mesh, camera=0, name="world", children=[child])
    f.top |= {"cameras": [{}], "materials": [{}], "skins": [{"joints": []}]}
    f.top |= {"images": [{"uri": "http://localhost/x.png"}]}
    for binary in (False, True):
        check_triangles(f.load(tmp_path, binary), [*SQUARE[TWO], *np.add(SQUARE, [0, 0, 1])[TWO]])


def test_nodes_place_by_matrix_and_by_parts_and_mirrors_turn_faces(tmp_path):
    turn, matrix = Rotation.random(None, 1), np.eye(4)
    matrix[:3] = [[0, -2, 0, 5], [1, 0, 0, 6], [0, 0, -1, 7]]  # it mirrors
    f = File()
    mesh, q = f.mesh(f.primitive(SQUARE, TWO)), turn.as_quat().tolist()
    child = f.node(False, mesh=mesh, translation=[1, 2, 3], rotation=q, scale=[2, 3, 4])
    f.node(matrix=matrix.T.ravel().tolist(), children=[child], mesh=mesh)
    inner = np.add(turn.apply(SQUARE * [2, 3, 4]), [1, 2, 3])
    outer = [points @ matrix[:3, :3].T + matrix[:3, 3] for points in (inner, SQUARE)]
    check_triangles(f.load(tmp_path), [x for points in outer for x in points[TWO][:, ::-1]])


# --- glTF files that lie -------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["../secret.bin", "%2e%2e/secret.bin", "{}", "file://{}",
                                  "http://localhost/x", "link.bin", "a/../../secret.bin",
                                  "folder", "no.bin", "\0", "x" * 5000])  # fmt: skip
def test_buffers_are_read_from_the_folder_only(tmp_path, kind):
    f = one_node()
    folder, secret = tmp_path / "meshes", put(tmp_path, "secret.bin", f.data)
    (folder / "folder").mkdir(parents=True)
    (folder / "link.bin").symlink_to(secret)
    with refusal(r"`path`: .*`uri`: expected a file "):
        f.load(folder, uri=kind.format(secret))
    for name in ("in a.bin", "folder/b.bin"):
        put(folder, name, f.data)
        check_triangles(f.load(folder, uri=name.replace(" ", "%20")), SQUARE[TWO])


def test_deep_and_wide_scenes_are_read_in_seconds(tmp_path):
    """Every node of a chain has the mesh, one above the other; another has all children."""
    f = File()
    mesh = f.mesh(f.primitive(SQUARE, TWO))
    leaf = f.node(False, mesh=mesh)
    for _ in range(3000):
        leaf = f.node(False, mesh=mesh, children=[leaf], translation=[0, 0, 1])
    f.node(children=[leaf, *(f.node(False, mesh=mesh) for _ in range(3000))])
    start = time.process_time()
    corners = triangles_of(f.load(tmp_path))
    assert time.process_time() - start < 10
    assert len(corners) == 12_002
    assert corners[..., 2].max() == 3000


def bomb(levels):
    f = File()
    leaf = f.node(False, mesh=f.mesh(f.primitive(SQUARE, TWO)))
    for _ in range(levels):
        leaf = f.node(False, children=[leaf] * 2)
    f.top["scenes"][0]["nodes"] = [leaf]
    return f


def many(count):
    """A file of 200 000 points, whose node is there many times."""
    f = one_node(np.tile(SQUARE, (50_000, 1)), np.tile(TWO, (5000, 1)))
    f.top["nodes"] *= count
    f.top["scenes"][0]["nodes"] = [*range(count)]
    return f


#: A field, with its new value or without one, and the error.
CHANGES = {
    "accessors.0.normalized = true": r"`normalized`.*accessors\[0\]",
    "accessors.0.count = 1000000000": r"`count`: .* got 1000000000 .*accessors\[0\]",
    "accessors.0.count = -1": "`count`: expected an integer of at least 1, got -1",
    "accessors.0.byteOffset = 1": r"`count`: expected data in 48 bytes.*accessors\[0\]",
    "accessors.0.byteOffset = -4": "`byteOffset`",
    'accessors.0.type = "VEC9"': "`type`: expected one of VEC3, got 'VEC9'",
    "accessors.0.componentType = 5124": "`componentType`: expected one of .*, got 5124",
    "accessors.0.bufferView = 9": "`bufferView`: expected a number below 2, got 9",
    "accessors.0.bufferView": "`bufferView`: .* got no such field",
    'accessors.0.sparse = {"count": 5}': "`sparse`: expected none, as it is not read",
    "accessors.1.componentType = 5122": r"`componentType`: .*5122 .*accessors\[1\]",
    "accessors.1.count = 5": "`indices`: expected three for each triangle, got 5",
    "accessors = {}": "`accessors`: expected a list",
    "bufferViews.0.byteLength = 47": "`count`: expected data in 47 bytes, got 4",
    "bufferViews.0.byteOffset = 1000000000": "`count`: expected data in 0 bytes",
    "bufferViews.0.byteStride = 100": "`count`: expected data in 48 bytes",
    "bufferViews.0.buffer = 3": r"`buffer`: .*bufferViews\[0\]",
    'bufferViews.0.extensions = {"EXT_meshopt_compression": {}}': "`EXT_meshopt_compression`",
    "nodes.0.mesh = 5": r"`mesh`: expected a number below 1, got 5 .*nodes\[0\]",
    "nodes.0.children = [0]": "`children`: expected nodes with one parent each",
    "nodes.0.children = [7]": "`children`: expected numbers of nodes below 1",
    "nodes.0.children = [0.5]": "`children`: expected numbers of nodes below 1",
    'nodes.0.children = {"0": 0}': "`children`",
    "nodes.0.matrix = [1, 0, 0]": r"`matrix`: expected finite numbers of shape \(16,\)",
    "nodes.0.rotation = [0, 0, 0, 0]": "`rotation`: expected a quaternion of length 1",
    "nodes.0.scale = [NaN, 1, 1]": "`scale`",
    "nodes.0.weights = [0, 0.5]": "morph targets",
    "nodes.0.skin = 0": r"`skin`: expected none.*nodes\[0\]",
    'nodes.0.extensions = {"EXT_mesh_gpu_instancing": {}}': "`EXT_mesh_gpu_instancing`",
    'nodes.0.extensions = {"KHR_node_visibility": {}}': "`KHR_node_visibility`",
    "nodes.0 = 5": "expected fields with names, got 5",
    "scenes.0.nodes = [0, 0]": "one parent",
    "scene = 3": "`scene`: expected a number below 1",
    "meshes.0.weights = [1.0]": r"`weights`: .*meshes\[0\]",
    "meshes.0.primitives.0.mode = 6": r"`mode`: .*fans are not read.*meshes\[0\], primitives",
    "meshes.0.primitives.0.indices = 0": r"`type`: .*accessors\[0\]",
    'meshes.0.primitives.0.extensions = {"KHR_draco_mesh_compression": {}}': "`KHR_draco",
    'asset.version = "1.0"': "`version`: expected 2.0, got 1.0 .*asset",
    'extensionsRequired = ["KHR_materials_unlit", "KHR_other"]': "got KHR_other",
    "extensionsRequired = [7]": "`extensionsRequired`: .*got 7",
    'extensionsRequired = ["KHR_materials_unlit", "KHR_texture_transform"]': None,
    "meshes.0.primitives.0.targets = [{}]": None,  # its weight is 0
}


@pairs("change, message", CHANGES)
def test_wrong_fields_of_a_gltf_file_are_named(tmp_path, change, message):
    f = one_node()
    path, _, value = change.partition(" = ")
    *parts, last = (int(x) if x.isdecimal() else x for x in path.split("."))
    part = f.top
    for step in parts:
        part = part[step]
    if not value:
        del part[last]
    else:
        part[last] = json.loads(value)
    if message is None:
        check_triangles(f.load(tmp_path), SQUARE[TWO])
        return
    with refusal(rf"`path`: expected .*a\.gltf.*{message}"):
        f.load(tmp_path)


def test_indices_beyond_the_vertices(tmp_path):
    f = one_node(indices=np.array([0, 1, 4], "<u1"))
    f.node(mesh=f.mesh(f.primitive(SQUARE, TWO)))  # all vertices together would be enough
    with refusal("expected faces with vertices 0 to 3, got 0 to 4"):
        f.load(tmp_path)


@pytest.mark.parametrize(
    "file, message", [(bomb(60), "one parent"), (many(500), "at most 67108864 corners")]
)
def test_small_files_that_stand_for_much_are_refused_in_seconds(tmp_path, file, message):
    start = time.process_time()
    with refusal(message):
        file.load(tmp_path)
    assert time.process_time() - start < 20
