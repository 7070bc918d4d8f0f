"""The bench: strokes, a hand on the camera, sessions, a tab's actions, who the server answers."""

import asyncio
import json
import re
import socket
import sys
from io import BytesIO
from pathlib import Path

import cv2
import equinox as eqx
import numpy as np
import pytest
from folders import in_trimesh, triangles_of
from numpy.random import default_rng
from numpy.testing import assert_allclose, assert_array_equal
from oracles import drawn, lump, off
from PIL import Image
from refusals import pairs, refusal
from results import fit_at
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

import pinhole_jax as pj
from pinhole_jax import __main__ as command
from pinhole_jax._camera.axes import axes_of
from pinhole_jax._files.exif import FieldOfView
from pinhole_jax._studio import drawing, hand, session, strokes
from pinhole_jax._studio.bench import Bench, as_json
from pinhole_jax._studio.strokes import Stroke
from pinhole_jax._studio.workpiece import mesh_file, photo_file, workpiece_of
from pinhole_jax.batch.inputs import Start
from pinhole_jax.show.page import png_of as png

aiohttp = pytest.importorskip("aiohttp", reason="the page's server needs aiohttp")

W = H = 64
FOCAL = H / 2 / np.tan(0.3)
BENT = pj.Lens([30.0, 35.0], 1.1, pj.BrownConrady(-0.2, 0.05, 0.01, -0.02, 0.01))


def camera(lens=None, e=(1.0, 1.5, 5.0), size=(W, H)):
    return pj.Camera(list(e), [0.1, 0, 0], [0, 1, 0], 0.6, 1.0, *size, lens)


@pytest.fixture(scope="module")
def scene():
    return lump(2)


@pytest.fixture(scope="module")
def mask(scene):
    return drawn(camera(), scene)


def eight_bits(mask):
    return np.round(255 * mask).astype(np.uint8)


@pytest.fixture
def workpiece(scene, mask, tmp_path):
    in_trimesh(scene.mesh).export(tmp_path / "part.obj")
    pj.io.save_image(tmp_path / "photo.png", np.repeat(eight_bits(mask)[..., None], 3, axis=2))
    return workpiece_of(str(tmp_path / "part.obj"), str(tmp_path / "photo.png"))


def begun(workpiece, folder, **known):
    """Return a bench with a new session."""
    return Bench(session.new_session(workpiece, Start(**known)), folder)


@pytest.fixture
def bench(workpiece, tmp_path):
    return begun(workpiece, tmp_path / "out")


def put(bench, **changes):
    bench.session = bench.session._replace(**changes)


def do(bench, do, push=lambda news: None, **numbers):
    """Return an action's answer, gone through JSON as the page's is; `push` hears the news."""
    heard = lambda x: json.loads(as_json(x), parse_constant=pytest.fail)
    return heard(bench.act(do, heard(numbers), lambda news: push(heard(news))))


# Strokes.


def test_stroke_covers_the_pixels_around_its_points():
    ends, none = ((12.0, 20.0), (50.0, 33.5)), np.zeros((48, 60), np.uint8)
    centres = np.argwhere(none == 0)[:, ::-1] + 0.5
    far = cdist(centres, np.linspace(*ends, 1000)).min(axis=1).reshape(48, 60)
    for radius in (0.4, 3.0, 10.5):
        drawn = strokes.draw_strokes([Stroke("add", radius, ends)], {"add": 7}, none)
        assert np.all(drawn[far < radius - 1] == 7)
        assert not np.any(drawn[far > max(radius, 0.5) + 1])


def overlap(mask, truth):
    """Return the IoU of a mask of 8 bits and a truth."""
    inside = np.asarray(mask) > 127
    return np.sum(inside & truth) / np.sum(inside | truth)


@pytest.mark.parametrize("size", [(90, 60), (240, 180)])  # some pixels, and more than `COARSE_PX`
@pytest.mark.parametrize("back", [False, True])
def test_strokes_on_the_object_tell_it_from_the_background(size, back):
    W, H = size
    y, x = np.mgrid[:H, :W] + 0.5
    truth = np.hypot((x - 0.45 * W) / W, (y - 0.5 * H) / H) < 0.28
    noise = default_rng(0).normal(0, 6, (H, W, 3))
    photo = np.where(truth[..., None], [200, 60, 40], [90, 120, 90]) + noise
    line = lambda kind, y, *x: Stroke(kind, W / 60, tuple((a * W, y * H) for a in x))
    guides = [line("object", 0.5, 0.35, 0.55), *[line("background", 0.1, 0.05, 0.95)] * back]
    found = strokes.guess_mask(np.clip(photo, 0, 255).astype(np.uint8), guides)
    assert overlap(found, truth) > 0.985


def test_guess_follows_the_strokes_alone_where_they_say_all():
    photo = np.zeros((20, 30, 3), np.uint8)
    assert strokes.guess_mask(photo, [Stroke("background", 2.0, ((5, 5),))]) is None
    assert np.all(strokes.guess_mask(photo, [Stroke("object", 50.0, ((15, 10),))]) == 255)


# A hand on the camera.

CENTRE = np.array([0.2, -0.1, 0.3])
POINTS = CENTRE + default_rng(2).normal(0, 0.3, (20, 3))


def seen(camera, points):
    return np.asarray(pj.project(camera, points))


def test_camera_moves_look_like_moves_of_the_object():
    before, extent = camera(pj.Lens([32.0, 32.0], 1.3)), hand.Extent(CENTRE, 0.5)
    b1, b2, v = axes_of(before)
    turn = Rotation.from_rotvec(0.3 * b2 + 0.2 * b1 + 0.5 * v)
    after = hand.moved(before, extent, (0.3, -0.2, 0.5))
    turned = CENTRE + turn.apply(POINTS - CENTRE)
    assert_allclose(seen(after, POINTS), seen(before, turned), atol=1e-9)
    after = hand.moved(before, extent, shift=(5.0, 3.0))
    assert_allclose(seen(after, CENTRE) - seen(before, CENTRE), [5, -3], atol=1e-9)
    away = lambda nearer: np.asarray(hand.moved(before, extent, nearer=nearer).e) - CENTRE
    assert_allclose(away(0.5), 0.5 * away(1.0))
    assert np.linalg.norm(away(0.0)) == pytest.approx(hand.NEAREST * 0.5)  # no nearer than this


def test_field_of_view_changes_keep_the_size():
    before = camera()
    b1, b2, _ = axes_of(before)
    plane = CENTRE + np.outer([0.3, -0.2, 0.1], b1) + np.outer([0.1, 0.4, -0.3], b2)
    after = hand.with_phi(before, CENTRE, 1.2)
    assert float(after.phi) == 1.2
    assert_allclose(seen(after, plane), seen(before, plane), atol=1e-9)


@pytest.mark.parametrize("up, front", [("x", (0, 0, 1)), ("y", (0, 0, 1)), ("z", (0, -1, 0))])
@pytest.mark.parametrize("size", [(64, 64), (120, 40), (40, 120)])
def test_framed_object_is_inside_the_picture_and_upright(up, front, size):
    extent = hand.extent_of(POINTS)
    framed = hand.frame_object(camera(size=size), extent, up)
    places = seen(framed, POINTS)
    assert np.all((places > 0) & (places < size))
    assert np.ptp(places, axis=0).max() > 0.2 * min(size)
    higher = extent.centre + 0.1 * np.eye(3)["xyz".index(up)]
    x, y = seen(framed, higher) - seen(framed, extent.centre)
    assert (abs(x) < 1e-9) & (y > 0)
    assert (np.asarray(framed.e) - extent.centre) @ front > 0


def test_lens_is_changed_by_its_numbers_and_dropped_when_trivial():
    bent = hand.with_lens(camera(), {"k1": -0.1, "principal_x": 30.0})
    assert_allclose(bent.lens.principal_point, [30, 32])
    assert bent.distortion.coefficients()["k1"] == -0.1
    assert hand.with_lens(bent, {"k1": 0.0, "principal_x": 32.0}).lens is None
    assert hand.with_lens(bent, {"k1": 0.0}).distortion is None
    eye = camera(pj.Lens([32.0, 32.0], 1.0, pj.Fisheye(0.01)))
    assert isinstance(hand.with_lens(eye, {"k1": 0.02}).distortion, pj.Fisheye)
    with refusal(r"`lens`: expected some of principal_x.*, got k9"):
        hand.with_lens(camera(), {"k9": 1.0})


# What is drawn.


@pytest.mark.parametrize("bent", [None, BENT.distortion, pj.Fisheye(0.05, 0.01, -0.01, 0.002)])
def test_numbers_for_the_shader_are_the_camera_as_opencv_has_it(bent):
    lens = None if bent is None else pj.Lens([30.0, 35.0], 1.1, bent)
    numbers = drawing.camera_numbers(camera(lens))
    assert numbers["model"] == (None if bent is None else type(bent).__name__)
    (x, y), R = numbers["principal"], np.diag([1, -1, 1]) @ numbers["axes"]
    K = np.diag([*numbers["focal"], 1.0])
    K[:2, 2] = x, H - y
    model = cv2.fisheye if numbers["model"] == "Fisheye" else cv2
    known = np.array([*numbers["distortion"].values()])
    place = cv2.Rodrigues(R)[0], -R @ numbers["eye"]
    found = model.projectPoints(POINTS[:, None], *place, K, known)[0][:, 0]
    assert_allclose(found, seen(camera(lens), POINTS) * [1, -1] + [0, H], atol=1e-9)


def bend(points):
    """Return by how much places through a lens stray from a line in space (px), by OpenCV."""
    K = np.array([[1.1 * FOCAL, 0, 30.0], [0, FOCAL, H - 35.0], [0, 0, 1]])
    distortion = np.array([*BENT.distortion.coefficients().values()])
    stop = cv2.TERM_CRITERIA_COUNT, 100, 0.0
    invert = getattr(cv2, "undistortPointsIter", cv2.undistortPoints)  # its name before OpenCV 5
    ideal = invert(np.array(points), K, distortion, R=None, P=None, criteria=stop)[:, 0]
    off = ideal - ideal.mean(axis=0)
    return FOCAL * np.abs(off @ np.linalg.svd(off)[2][1]).max()


def test_lines_straight_in_space_follow_the_distortion():
    ends = ((5.0, 60.0), (58.0, 40.0))
    plain, bent = (drawing.straight_lines(camera(lens), [ends])[0] for lens in (None, BENT))
    assert_allclose(plain, np.linspace(*ends, drawing.POINTS), atol=0.006)
    assert_allclose([bent[0], bent[-1]], ends, atol=0.006)
    assert np.max(np.abs(np.subtract(bent, plain))) > 0.1
    for line in (bent, *drawing.grid_lines(camera(BENT))):
        assert bend(line) < 0.02


@pytest.mark.parametrize("lens", [None, BENT])
def test_grid_fills_the_picture(lens):
    points = np.concatenate(drawing.grid_lines(camera(lens)))
    corners = [[0, 0], [W, 0], [0, H], [W, H]]
    assert np.all(cdist(corners, points).min(axis=1) < W / drawing.GRID)


def test_page_gets_mesh_and_photo(workpiece, scene):
    data = mesh_file(workpiece)
    centre, (points, faces) = np.frombuffer(data, "<f8", 3), np.frombuffer(data, "<u4", 2, 24)
    vertices = np.frombuffer(data, "<f4", 3 * points, 32).reshape(-1, 3) + centre
    triangles = np.frombuffer(data, "<u4", 3 * faces, 32 + 12 * points).reshape(-1, 3)
    assert_allclose(vertices[triangles], triangles_of(scene.mesh), atol=1e-6)
    assert Image.open(BytesIO(photo_file(workpiece))).size == (W, H)


# A session.


def saved(bench, *free):
    """The text of a session's file."""
    (path,) = do(bench, "save", name="work", free=free)["written"]
    return Path(path).read_text()


def stroke(**changes):
    stroke = {"kind": "add", "radius_px": 1, "points": [[1, 2]], **changes}
    return json.dumps({"strokes": [stroke]})


PNG = png(np.zeros((3, 3), np.uint8))
#: Fields of a session's file, and the error.
WRONG = {
    '{"schema": "other"}': "`schema`: expected one of pinhole_jax.studio/1, got 'other'",
    '{"mesh": 3}': "`mesh`: expected a text, got 3",
    '{"camera": {}}': "`e`: expected a camera's field",
    '{"known_phi": 4}': "`known_phi`: expected an angle",
    '{"free": ["nose"]}': r"`free`: expected some of .*, got \['nose'\]",
    '{"strokes": {}}': "`strokes`: expected a list",
    '{"strokes": [3]}': r"expected fields with names, got 3 .*, strokes\[0\]",
    stroke(kind="paint"): "`kind`: expected one of object, background, .* got 'paint'",
    stroke(points=[[1]]): r"`points`: .* of shape \(N, 2\), got \[\[1\]\]",
    stroke(radius_px=0): "`radius_px`: expected a radius above 0 px, got 0",
    stroke(points=[]): r"`points`: expected .*, got \[\]",
    stroke(points=[[1, 1e9]]): "`points`: .* on the picture",
    '{"strokes": [{"mask": "no picture"}]}': "`mask`: expected a PNG file in base64",
    f'{{"strokes": [{{"mask": "{PNG}"}}]}}': "`mask`: expected 8 bits, 64 x",
    '{"lines": [[1, 2]]}': "`line`: expected 4 finite numbers",
}


@pairs("changes, words", WRONG)
def test_bad_session_is_refused_by_name(bench, changes, words):
    text = json.dumps({**json.loads(saved(bench, "pose")), **json.loads(changes)})
    with refusal(words) as caught:
        do(bench, "open", text=text, name="some.json")
    assert "some.json" in str(caught.value)


# A tab's actions.


SMALL = png(np.zeros((20, 10), np.uint8))
#: Messages of the page, and the reason.
IMPOSSIBLE = {
    '{"do": "__init__"}': "`do`: expected one of hello, .*, got '__init__'",
    '{"do": "stand", "down": "y"}': "`stand`: ",
    '{"do": "stand", "up": "w"}': "`up`: expected one of x, y, z, got 'w'",
    f'{{"do": "load_mask", "data": "{SMALL}"}}': "`mask`: .* photo's size 64 x 64, got 10 x 20",
    '{"do": "load_mask", "data": "bm8=", "name": "a.png"}': "readable image .* got 'a.png'",
    '{"do": "move", "turn": [1, 2]}': "`turn`: expected 3 finite numbers",
    '{"do": "move", "nearer": 0}': "`nearer`: expected a positive factor, got 0",
    '{"do": "lens", "phi_degrees": 190}': "`phi`: expected an angle",
    '{"do": "undo"}': "nothing to undo",
    '{"do": "redo"}': "nothing to redo",
    '{"do": "restore"}': "there is no result yet",
    '{"do": "mode", "number": 0}': "`number`: expected one of 0 cameras",
    '{"do": "fit", "free": ["pose"]}': "there is no mask yet",
    '{"do": "export", "format": "fbx", "name": "a"}': "`format`: expected one of all.*'fbx'",
    '{"do": "export", "format": "json", "name": "../a"}': "`name`: expected letters.*'../a'",
    '{"do": "save", "name": "a", "free": []}': "`free`: expected some of",
    '{"do": "save", "name": ".a", "free": ["pose"]}': "`name`: expected letters",
}


@pairs("message, words", IMPOSSIBLE)
def test_impossible_actions_are_refused_with_the_reason(bench, message, words):
    with refusal(words):
        do(bench, **json.loads(message))


def test_strokes_are_undone_and_redone(bench):
    at = {"radius_px": 3, "points": [[W / 2, H / 2]]}
    assert do(bench, "stroke", kind="add", **at)["share"] > 0
    assert do(bench, "stroke", kind="erase", **at)["share"] == 0
    assert do(bench, "undo")["share"] > 0
    assert do(bench, "redo")["share"] == 0
    do(bench, "undo")
    told = do(bench, "undo")
    assert told["png"] is None
    assert (told["can_undo"], told["can_redo"]) == (False, True)
    assert not do(bench, "stroke", kind="add", **at)["can_redo"]
    assert do(bench, "clear")["png"] is None
    assert do(bench, "undo")["share"] > 0
    do(bench, "load_mask", data=png(np.full((H, W), 255, np.uint8)))
    assert bench.mask.min() == 255  # in place of the strokes
    assert 0 < do(bench, "stroke", kind="erase", **at)["share"] < 1  # on top of it
    assert do(bench, "undo")["share"] == 1


def test_view_guides_the_guess(bench, mask):
    put(bench, camera=camera(e=(1.1, 1.5, 5.0)))
    told = do(bench, "view_guides")
    assert {guide["kind"] for guide in told["guides"]} == {"object", "background"}
    assert overlap(bench.mask, mask > 0.5) > 0.97
    assert not do(bench, "undo")["png"]
    put(bench, camera=camera().replace(p=[0, 0, 99]))
    with refusal("the object is not in the picture"):
        do(bench, "view_guides")


@pytest.fixture
def fitted(bench, mask):
    do(bench, "load_mask", data=png(eight_bits(mask)))
    put(bench, camera=camera(e=(0.6, 1.8, 5.2)))
    return bench


@pytest.mark.long
def test_fit_finds_the_camera_and_reports_its_path(fitted):
    pushed = []
    put(fitted, known_phi=0.6)
    told = do(fitted, "fit", pushed.append, free=["position", "orientation"])
    angle, shift = pj.pose_error(fitted.session.camera, camera())
    assert np.rad2deg(angle) < 0.1
    assert shift < 0.02
    assert (told["fit"]["status"], told["fit"]["notes"]) == ("converged", [])
    assert told["view"]["is_fit"]
    band = told["fit"]["band"]
    sigma = pj.plot.outline_sigma(fitted.result, fitted.workpiece.scene)
    assert band["median_px"] == pytest.approx(np.median(sigma))
    assert_allclose(band["half_px"], sigma, atol=6e-4)
    assert len(band["lines"]) == len(sigma)
    assert [row[0] for row in told["fit"]["rows"]] == ["pitch", "yaw", "roll", "e_x", "e_y", "e_z"]
    assert len(pushed) > 1
    assert all(push["words"] and push["outline"] for push in pushed)
    stops = do(fitted, "way")["stops"]
    assert len(stops) == len(fitted.result.history)
    assert stops[-1]["camera"] == told["view"]["camera"]
    do(fitted, "move", turn=[0.1, 0, 0])
    assert not do(fitted, "look")["is_fit"]
    assert do(fitted, "restore")["is_fit"]


def test_fit_blocks_other_actions_and_can_be_stopped(fitted):
    start, met = fitted.session.camera, []

    def push(what):
        with refusal("a fit is running: wait for it, or stop it"):
            fitted.act("look", {}, met.append)
        met.append(what)
        fitted.act("stop", {}, met.append)

    with refusal("stopped: the camera has not changed"):
        fitted.act("fit", {"free": ["pose"]}, push)
    assert len(met) == 1
    assert fitted.session.camera is start
    assert fitted.result is None
    do(fitted, "look")  # it goes on


@pytest.fixture
def unsaid(fitted):
    """A bench whose photo has no EXIF data, off by 20 % in its field of view: 0.7 for 0.6."""
    put(fitted, camera=hand.with_phi(camera(e=(0.6, 1.8, 5.2)), np.zeros(3), 0.7))
    return fitted


def test_field_of_view_that_nobody_gives_is_free_and_named(workpiece, bench, tmp_path):
    told = do(bench, "hello")
    assert (told["W"], told["H"], told["fit"], told["mask"]["png"]) == (W, H, None, None)
    assert told["formats"] == list(pj.formats.FORMATS)
    assert len(told["view"]["outline"]) > 0
    assert (told["free"], told["view"]["upright"]) == (["pose", "phi"], "y")
    assert told["view"]["phi_is_assumed"]
    assert do(bench, "stand", up="z")["upright"] == "z"
    for known in ({"phi": 0.6}, {"camera": camera()}):
        given = begun(workpiece, tmp_path, **known)
        assert given.session.known_phi == pytest.approx(0.6)
        told = do(given, "hello")
        assert told["free"] == ["pose"]
        assert not told["view"]["phi_is_assumed"]


@pytest.mark.long
@pytest.mark.parametrize("way", ["guess", "slider", "session", "earlier fit"])
def test_fit_that_holds_an_assumed_field_of_view_is_not_converged(unsaid, way):
    words = "field of view assumed: 40.1 degrees"
    if way == "slider":
        do(unsaid, "lens", phi_degrees=36.0)
        words = "field of view assumed: 36.0 degrees"
    if way == "session":
        do(unsaid, "open", text=saved(unsaid, "pose"))
    if way == "earlier fit":
        told = do(unsaid, "fit", free=unsaid.session.free)
        assert (told["fit"]["status"], told["view"]["phi_is_assumed"]) == ("converged", False)
        angle, shift = pj.pose_error(unsaid.session.camera, camera())
        assert (np.rad2deg(angle) < 0.3) & (shift < 0.1)
        words = r"field of view from an earlier fit: 34.\d degrees"
    for told in (do(unsaid, "fit", free=["pose"]), do(unsaid, "mode", number=0)):
        assert told["fit"]["status"] not in ("converged", "non_finite")
        assert re.match(words, told["fit"]["notes"][0])
    assert do(unsaid, "hello")["fit"]["status"] != "converged"


def test_modes_are_chosen_by_number(bench):
    best = fit_at(camera(), np.full(7, 1e-3), status="ambiguous")
    bench.fits = best, best._replace(camera=camera(e=(-1, 0, 5)), iou=0.9)
    told = do(bench, "mode", number=1)["fit"]
    assert (told["modes"], told["chosen"], told["status"]) == ([best.iou, 0.9], 1, "ambiguous")
    assert bench.session.camera is bench.fits[1].camera
    with refusal("`number`: expected one of 2 cameras, got 2"):
        do(bench, "mode", number=2)


def test_camera_is_written_in_all_formats(bench):
    written = do(bench, "export", format="all", name="view")["written"]
    assert len(written) == len(pj.formats.FORMATS)
    assert all(Path(path).exists() for path in written)
    again = pj.formats.read_one(written[0])
    assert off(again, bench.session.camera) < 1e-12
    again = do(bench, "export", format="json", name="view")["written"]
    assert again == [f"{written[0]} (replaced)"]


def test_session_goes_on_in_another_tab(fitted, tmp_path):
    do(fitted, "stroke", kind="erase", radius_px=2, points=[[30, 30]])
    do(fitted, "straight", grid=True, line=[[1, 2], [3, 40]])
    put(fitted, camera=camera(BENT))
    other, text = begun(fitted.workpiece, tmp_path), saved(fitted, "pose", "phi")
    do(other, "stroke", kind="add", radius_px=2, points=[[1, 1]])
    told = do(other, "open", text=text)
    assert_array_equal(other.mask, fitted.mask)
    assert (told["free"], len(told["view"]["lines"])) == (["pose", "phi"], 1)
    assert eqx.tree_equal(other.session, fitted.session)
    assert do(other, "undo")["png"] == do(fitted, "undo")["png"]
    assert not do(other, "undo")["can_undo"]  # the session before is gone
    # Files of other names are loaded.
    pj.io.save_image(tmp_path / "other.png", np.zeros((H, W, 3)))
    pj.io.save_image(tmp_path / "small.png", np.zeros((8, 8, 3)))
    do(other, "open", text=text.replace("photo.png", "other.png"))
    with refusal("`camera`: expected one of the photo's size 8 x 8"):
        do(other, "open", text=text.replace("photo.png", "small.png"))
    assert other.workpiece.photo.endswith("other.png")


# Who is answered.


def served(bench_of, ask):
    """Run `ask(address, studio)` beside a server."""
    from pinhole_jax._studio import server

    async def run():
        studio = server.Studio(bench_of)
        address = asyncio.get_running_loop().create_future()
        task = asyncio.create_task(server.serve(studio, 0, address.set_result))
        try:
            return await ask(await address, studio)
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)

    return asyncio.run(run())


def test_requests_without_the_token_are_refused(bench):
    async def ask(address, studio):
        assert address.startswith("http://127.0.0.1:")  # nobody else's machine reaches it
        bare = address.split("?")[0]
        port = bare.rstrip("/").rsplit(":", 1)[1]
        known = f"token={studio.token}"
        paths = ",scene.js,studio.js,studio.css,photo,mesh,bench,nothing"
        refused = [
            (path + query, headers)
            for path in paths.split(",")
            for query, headers in (
                ("", {}),
                ("?token=", {}),
                (f"?token={studio.token[:-1]}", {}),
                (f"?{known}", {"Host": "example.com"}),
                (f"?{known}", {"Host": f"example.com:{port}"}),
                (f"?{known}", {"Origin": "http://example.com"}),
            )
        ]
        async with aiohttp.ClientSession() as client:
            for path, headers in refused:
                async with client.get(bare + path, headers=headers) as answer:
                    assert answer.status == 403, (path, headers)
                    assert studio.token not in await answer.text()
            async with client.get(address) as answer:
                assert answer.status == 200
                page = await answer.text()
                assert f"scene.js?{known}" in page
                assert f"studio.js?{known}" in page
                assert "frame-ancestors 'none'" in answer.headers["Content-Security-Policy"]
            async with client.get(f"{bare}photo?{known}&tab=unknown") as answer:
                assert answer.status == 404

    served(lambda: bench, ask)


class Tab:
    """A tab's end of the line."""

    def __init__(self, socket):
        self.socket, self.count = socket, 0

    async def ask(self, name, **numbers):
        self.count += 1
        await self.socket.send_json({"id": self.count, "do": name, **numbers})
        while (heard := await self.socket.receive_json()).get("id") != self.count:
            pass
        return heard.get("answer", heard.get("error"))


def test_tabs_do_not_mix_and_come_back_to_what_they_had(workpiece, tmp_path):
    async def ask(address, studio):
        line = address.replace("/?", "/bench?")
        async with aiohttp.ClientSession() as client:
            one, two = [Tab(await client.ws_connect(line)) for _ in range(2)]
            names = [(await tab.socket.receive_json())["tab"] for tab in (one, two)]
            assert names[0] != names[1]
            dot = {"kind": "add", "radius_px": 3, "points": [[9, 9]]}
            assert (await one.ask("stroke", **dot))["share"] > 0
            assert (await two.ask("hello"))["mask"]["png"] is None
            moved = await two.ask("move", turn=[0.5, 0, 0])
            assert moved["camera"]["eye"] != (await one.ask("look"))["camera"]["eye"]
            assert await one.ask("undo", x=1)  # it is an error
            again = Tab(await client.ws_connect(f"{line}&tab={names[0]}"))  # while it is open
            assert (await again.socket.receive_json())["tab"] not in names
            await one.socket.close()
            again = Tab(await client.ws_connect(f"{line}&tab={names[0]}"))
            assert (await again.socket.receive_json())["tab"] == names[0]
            assert (await again.ask("hello"))["mask"]["share"] > 0
            for nothing in ("no JSON", "[]", '{"id": 1}', '{"do": "look"}', '{"id": 1, "do": 2}'):
                await again.socket.send_str(nothing)
                assert "error" in await again.socket.receive_json()

    served(lambda: begun(workpiece, tmp_path), ask)


# The command.


def main(words):
    return command.main(["studio", *words.split(), "--no-browser", "--no-cache"])


def test_command_without_aiohttp_names_the_extra(monkeypatch, capsys, workpiece):
    import pinhole_jax._studio as package

    monkeypatch.setitem(sys.modules, "aiohttp", None)
    monkeypatch.delitem(sys.modules, "pinhole_jax._studio.server", raising=False)
    monkeypatch.delattr(package, "server", raising=False)
    assert main(f"{workpiece.mesh} {workpiece.photo}") == 2
    assert "pip install 'pinhole-jax[studio]'" in capsys.readouterr().err


@pairs(
    "arguments, words",
    {
        "": "expected MESH and PHOTO, or --session FILE",
        "part.obj": "expected MESH and PHOTO",
        "none.obj photo.png": "`MESH`: .*no such file",
        "part.obj none.png": "`PHOTO`: .*no such file",
        "--session s.json --fov 30": "`--session`: expected no MESH, PHOTO",
        "--session part.obj": "`--session`: expected ",
        "part.obj photo.png --port 70000": "`--port`: expected a port, 0 to 65535, got 70000",
        "part.obj photo.png --mask small.png": "`--mask`: expected the photo's size 64 x 64",
    },
)
def test_command_says_what_is_wrong(arguments, words, capsys, workpiece, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pj.io.save_image("small.png", np.eye(8))
    assert main(arguments) == 2
    assert re.search(words, capsys.readouterr().err)


def test_port_in_use_is_named(capsys, workpiece):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert main(f"{workpiece.mesh} {workpiece.photo} --port {port}") == 2
    assert f"`--port`: expected a port that is free, got {port}" in capsys.readouterr().err


@pytest.mark.parametrize(
    "fov, exif, phi", [("", None, 0.7), ("", 0.5, 0.5), ("--fov 30", 0.5, np.deg2rad(30))]
)
def test_command_passes_its_options_to_the_bench(monkeypatch, workpiece, tmp_path, fov, exif, phi):
    from pinhole_jax._studio import server

    benches = []

    async def serve(studio, port, ready):
        assert port == 1234
        benches.append(studio._new_bench())

    monkeypatch.setattr(server, "serve", serve)
    found = None if exif is None else FieldOfView(exif, "a focal length")
    monkeypatch.setattr(pj.io, "photo_fov", lambda path: found)
    pj.io.save_image(tmp_path / "mask.png", np.pad(np.ones((20, 20)), 22))
    files = f"{workpiece.mesh} {workpiece.photo} --mask {tmp_path}/mask.png"
    assert main(f"{files} --up z {fov} --port 1234") == 0
    (bench,) = benches
    assert np.sum(bench.mask == 255) == 400
    assert float(bench.session.camera.phi) == pytest.approx(phi)
    assert bench.session.free == (("pose", "phi") if phi == 0.7 else ("pose",))
    assert axes_of(bench.session.camera)[1][2] > 0.8
