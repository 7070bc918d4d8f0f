"""What notebooks show: HTML that is well-formed, escaped, complete in itself, and right."""

import html
import re
from xml.etree import ElementTree

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from oracles import usual_camera
from results import fit_at

import pinhole_jax as pj
from pinhole_jax._fit.words import STATUSES
from pinhole_jax.show.space import ROOM, H, W

CAMERA = usual_camera()
SVG = "{http://www.w3.org/2000/svg}"


def parsed(text):
    """Return HTML as a tree: it is also XML, so that nothing is left open."""
    return ElementTree.fromstring(f"<page>{text}</page>")


def a_fit(status="converged", std=(1e-3, 2e-3, np.inf), **more):
    names = ("rotation_b1", "e_x", "phi")
    return fit_at(CAMERA, std, names, status=status, **more)


def circles(tree):
    found = tree.findall(f".//{SVG}circle")
    return [(float(c.get("cx")), float(c.get("cy"))) for c in found]


def test_camera_shows_the_numbers_that_it_prints():
    lens = pj.Lens([46.0, 41.0], 1.02, pj.BrownConrady(-0.1))
    for camera in (CAMERA, CAMERA.replace(lens=lens)):
        text = camera._repr_html_()
        assert text.count("http") == 1  # the name of SVG: nothing is loaded
        tree = parsed(text)
        cells = [cell.text for cell in tree.iter() if cell.tag in ("th", "td") and cell.text]
        printed = " ".join(str(camera).split("\n", 1)[1].split())
        assert " ".join(" ".join(cells).split()) == printed


def test_picture_is_the_camera_seen_from_the_side():
    lines = parsed(CAMERA._repr_html_()).findall(f".//{SVG}polyline")
    at = lambda element: np.array(
        [tuple(map(float, p.split(","))) for p in element.get("points").split()]
    )
    film, _, tick, *rays = map(at, lines)
    eye, corners = np.array(circles(parsed(CAMERA._repr_html_()))[0]), film[:: len(film) // 4]
    for corner, ray in zip(corners, rays[:4], strict=True):  # from the eye to the film
        np.testing.assert_allclose(ray, [eye, corner], atol=0.11)
    everything = np.concatenate([corners, *map(at, lines)])
    assert np.all((everything >= ROOM - 0.1) & (everything <= np.array([W, H]) - ROOM + 0.1))
    # Parallel lines stay parallel: the film is a parallelogram, wider than high as W / H says.
    np.testing.assert_allclose(corners[0] - corners[1], corners[3] - corners[2], atol=0.21)
    assert tick[1, 1] < np.mean(corners[2:], axis=0)[1] - 5  # up is up


def test_picture_does_not_depend_on_the_unit_of_length():
    texts = []
    for unit in (1e-6, 1.0, 1e6):
        camera = CAMERA.replace(e=unit * np.array(CAMERA.e), p=unit * np.array(CAMERA.p))
        texts.append(re.sub(r".*(<svg.*</svg>).*", r"\1", camera._repr_html_()))
    assert texts[0] == texts[1] == texts[2]


def test_fit_shows_its_status_and_parameters():
    text = a_fit()._repr_html_()
    assert "not determined" in text
    assert html.escape(STATUSES["converged"]) in text
    rows = parsed(text).findall(".//tbody/tr")
    assert [row[0].text for row in rows] == ["pitch", "e_x", "phi"]
    assert rows[1][1].text == "0.3000"  # a digit more than one sigma leaves
    assert rows[1][2].text == "0.002"
    colours = {re.search("background:(#......)", a_fit(s)._repr_html_())[1] for s in STATUSES}
    assert len(colours) == 2


def test_fit_shows_the_path_of_its_eye_and_other_views():
    way = [pj.Progress(CAMERA.replace(e=e), 24, 20, 3) for e in ([3.0, 1, 4], [1.0, 1, 5])]
    history = (*way, pj.Progress(CAMERA, 96, 80, 2))
    other = a_fit()._replace(camera=CAMERA.replace(e=[-4.0, 1, 3]))
    tree = parsed(a_fit("ambiguous", history=history, modes=(other,))._repr_html_())
    assert len(circles(tree)) == 2  # the other eye, the eye
    dashed = [x for x in tree.findall(f".//{SVG}polyline") if x.get("stroke-dasharray")]
    assert len(dashed[0].get("points").split()) == 3
    assert "another view fits the mask equally well" in "".join(tree.itertext())


def test_words_are_escaped():
    text = a_fit("rank_deficient", weak=('<script>alert("x")</script> & more',))._repr_html_()
    assert "<script>" not in text
    assert '<script>alert("x")</script> & more' in "".join(parsed(text).itertext())


def test_batched_and_traced_cameras_are_shown_as_text():
    views = jax.tree.map(lambda *x: jnp.stack(x), CAMERA, CAMERA)
    assert views._repr_html_() is None
    shown = []
    jax.jit(lambda camera: shown.append(camera._repr_html_()) or camera.phi)(CAMERA)
    assert shown == [None]
    fit = a_fit()._replace(camera=views)
    with pytest.raises((TypeError, ValueError)):
        str(fit)  # (neither is a stacked fit a table)


def test_fit_that_is_not_finite_is_shown():
    nan = jax.tree.map(lambda x: jnp.full_like(x, jnp.nan), CAMERA)
    text = a_fit("non_finite", std=(np.nan,) * 3)._replace(camera=nan)._repr_html_()
    assert "svg" not in text
    assert "non_finite" in text
