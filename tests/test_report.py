import base64
import io as bytes_io
import re
import shutil
import subprocess
from xml.etree import ElementTree

import numpy as np
import pytest
from oracles import off
from PIL import Image
from refusals import refusal
from results import fit_at
from test_plot import AHEAD, SQUARE, way_to

import pinhole_jax as pj
from pinhole_jax import formats, report
from pinhole_jax._fit.words import STATUSES
from pinhole_jax.show.trust import COLOURS

NAMES = ("rotation_b2", "e_x", "e_z")
MASK = np.zeros((80, 96), bool)
MASK[15:66, 25:76] = True  # some px too far right
FIT = fit_at(
    AHEAD,
    [1e-4, 5e-4, np.inf],
    NAMES,
    history=way_to(AHEAD),
    weak=("the distance against <the focal length> is not visible",),
    status="rank_deficient",
)
BROWSERS = "chromium-headless-shell chromium chromium-browser google-chrome chrome"


def page_of(text):
    """Return a page as a tree: it is XML but for tags that hold nothing, so that none is open."""
    text = re.sub(r"<((?:meta|img)\b[^>]*)>", r"<\1/>", text.partition(">")[2])
    return ElementTree.fromstring(text)


def words(page, section):
    return "".join(page.find(f".//section[@id='{section}']").itertext())


def count(page, section, tag):
    return len(page.findall(f".//section[@id='{section}']//{tag}"))


def data_of(uri):
    return base64.b64decode(uri.partition(";base64,")[2])


@pytest.fixture(scope="module")
def text(tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "deep" / "page.html"
    report.write(path, FIT, SQUARE, MASK, title="part <b>1</b> & \udcffmask")
    return path.read_text(encoding="utf-8")


def test_page_has_all_sections_and_loads_nothing(text):
    page = page_of(text)
    sections = """outline where-the-error-shows where-mask-and-camera-differ parameters correlations
        what-the-mask-leaves-open convergence object-and-camera the-camera-for-other-programs"""
    assert [section.get("id") for section in page.iter("section")] == sections.split()
    assert not [*page.iter("script"), *page.iter("link")]
    for tag in (*page.iter("img"), *page.iter("a")):
        assert tag.get("src", tag.get("href")).startswith("data:")
    assert text.count("http") == 2  # the name of SVG
    assert r"part <b>1</b> & \udcffmask" in "".join(page.itertext())
    assert len([*page.iter("b")]) == 1
    assert page.find(".//p").get("class") == "status rank_deficient"


@pytest.mark.parametrize("status", [s for s in STATUSES if s != "non_finite"])
def test_page_explains_the_status(status):
    page = page_of(report.page(FIT._replace(status=status), SQUARE, MASK))
    assert page.find(".//p").get("class") == f"status {status}"
    assert f"{status} {STATUSES[status]}.".lower() in "".join(page.itertext()).lower()


def test_pictures_decode_and_tables_have_a_row_for_each_parameter(text):
    page = page_of(text)
    for section in ("outline", "where-mask-and-camera-differ", "object-and-camera"):
        (picture,) = page.findall(f".//section[@id='{section}']//img")
        image = np.asarray(Image.open(bytes_io.BytesIO(data_of(picture.get("src")))))
        assert image.shape[2] == 3
        assert max(image.shape) >= 800
        assert np.ptp(image) > 100
    assert count(page, "parameters", "tr") == 1 + len(NAMES)
    assert "not determined" in words(page, "parameters")
    assert {cell.get("scope") for cell in page.iter("th")} == {"col", "row"}
    assert "rotation_b2" not in text  # users know it as yaw
    assert count(page, "correlations", "td") == len(NAMES) ** 2
    assert "1.00" in words(page, "correlations")
    assert "<the focal length> is not visible." in words(page, "what-the-mask-leaves-open")
    assert re.search(
        r"one sigma is 0\.0\d+ px \(median; largest 0\.\d+ px\)", words(page, "outline")
    )
    assert "undetermined, and left out: 1." in words(page, "outline")
    assert count(page, "convergence", "tr") == 1 + 3  # the start and two levels
    assert "48 x 40 px" in words(page, "convergence")


def test_page_locates_the_disagreement(text):
    assert "of the mask's edge (near column" in words(page_of(text), "where-mask-and-camera-differ")


def test_page_holds_the_camera_in_all_formats(text, tmp_path):
    files = {a.get("download"): data_of(a.get("href")) for a in page_of(text).iter("a")}
    assert {"camera_blender.py", "images.txt", "cameras.txt"} < set(files)
    for ending in (".json", ".yaml", "_transforms.json", ".gltf", ".xml"):
        name = f"camera{ending}"
        (tmp_path / name).write_bytes(files[name])
        (camera,) = formats.read(tmp_path / name, size=(96, 80)).values()
        assert off(camera, AHEAD) < 1e-6


@pytest.mark.long
def test_page_names_formats_that_cannot_hold_the_camera():
    camera = AHEAD.replace(lens=pj.Lens([40.0, 40], 1.0))
    page = page_of(report.page(fit_at(camera, [1e-3], ("e_x",)), SQUARE, MASK))
    assert "camera.gltf" not in [a.get("download") for a in page.iter("a")]
    assert "principal point" in words(page, "the-camera-for-other-programs")
    assert "were not recorded" in words(page, "convergence")
    assert "no other view fits" in words(page, "what-the-mask-leaves-open")


def test_bad_arguments_of_a_page_are_refused():
    with refusal("`fit`: expected a finite camera, got status non_finite"):
        report.page(FIT._replace(status="non_finite"), SQUARE, MASK)
    with refusal("`image`: expected the camera's size"):
        report.page(FIT, SQUARE, MASK, np.zeros((9, 9), np.uint8))


#: The colours of the map of trust.
BANDS = [tuple(bytes.fromhex(colour[1:])) for colour in COLOURS]


@pytest.mark.long
def test_browser_shows_the_page(text, tmp_path):
    browser = next(filter(None, map(shutil.which, BROWSERS.split())), None)
    if browser is None:
        pytest.skip(f"no browser: none of {BROWSERS} is installed")
    # A script of the test's own writes down what the browser made of the page.
    measure = """<script>onload=()=>{const r=document.documentElement,
      i=[...document.images].map(x=>x.naturalWidth>0&&x.getBoundingClientRect().width>300),
      s=[...document.querySelectorAll('section')].map(x=>x.getBoundingClientRect().height>40),
      g=document.querySelector('svg').getBoundingClientRect();
      document.body.id=[i.length,i.every(x=>x),s.length,s.every(x=>x),
        r.scrollWidth<=innerWidth,g.width>400&&g.height>150].join()}</script>"""
    path = tmp_path / "page.html"
    path.write_text(text.replace("</body>", measure + "</body>"), encoding="utf-8")
    common = "--headless --no-sandbox --disable-gpu --hide-scrollbars --window-size=1000,4800"
    given = browser, *common.split(), f"--user-data-dir={tmp_path / 'user'}"
    ask = lambda what: subprocess.run(
        [*given, what, path.as_uri()], capture_output=True, timeout=120, check=True
    )
    assert b'<body id="3,true,9,true,true,true">' in ask("--dump-dom").stdout
    ask(f"--screenshot={tmp_path / 'page.png'}")
    shot = np.asarray(Image.open(tmp_path / "page.png").convert("RGB")).astype(int)
    assert shot.shape == (4800, 1000, 3)
    near = lambda colour: np.sum(np.max(np.abs(shot - colour), axis=2) < 8)
    assert near((251, 229, 214)) > 20_000  # the status, not to be trusted
    assert near((0, 240, 255)) > 300  # the outline
    assert near((230, 90, 20)) > 500  # the mask's error
    assert near((238, 242, 246)) > 5_000  # levels of the diagram
    assert sum(map(near, BANDS)) > 50_000  # where the error shows
    assert near((255, 255, 255)) > 0.4 * shot[..., 0].size
