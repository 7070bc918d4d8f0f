"""Self-contained HTML pages: pictures are data URIs, and nothing else is loaded."""

import base64
import html
from collections.abc import Iterable, Mapping
from io import BytesIO

import numpy as np

from .. import Fit, JointFit, __version__
from ..names import STATUSES

#: The ending of a camera's file, or of its folder, after its name, by format.
ENDINGS = {
    "json": ".json",
    "opencv": ".yaml",
    "colmap": "_colmap",
    "colmap-binary": "_colmap_binary",
    "nerf": "_transforms.json",
    "blender": "_blender.json",
    "blender-script": "_blender.py",
    "gltf": ".gltf",
    "pytorch3d": "_pytorch3d.json",
    "mitsuba": ".xml",
}


class Html(str):
    """HTML text; all other text is escaped."""


class Svg(Html):
    """SVG text, which notebooks show as a picture.

    ```python
    diagram.partition(">")[0]  # text: write it to a file as it is
    ```
    """

    def _repr_svg_(self) -> str:
        return str(self)


def as_html(text: str) -> str:
    """Return text as HTML."""
    return text if isinstance(text, Html) else html.escape(text)


def document(
    title: str, fit: Fit | JointFit, numbers: Mapping[str, str], sections: Mapping[str, str]
) -> str:
    """Return a page: a title, a fit's status with its meaning, a row of numbers with their names,
    and sections by their headings."""
    name, meaning = html.escape(title), STATUSES[fit.status]
    facts = "".join(f"<div><dt>{name}</dt><dd>{x}</dd></div>" for name, x in numbers.items())
    body = "".join(
        f'<section id="{heading.lower().replace(" ", "-")}"><h2>{heading}</h2>{text}</section>\n'
        for heading, text in sections.items()
    )
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{name}</title><style>{STYLE}</style></head><body><header><h1>{name}</h1>"
        f'<p class="status {fit.status}"><b>{fit.status}</b> {meaning[0].upper()}{meaning[1:]}.</p>'
        f"<dl>{facts}</dl></header><main>{body}</main>"
        f"<footer>pinhole_jax {__version__}</footer></body></html>\n"
    )


def items(sentences: Iterable[str]) -> str:
    """Return a list of sentences, or nothing if there are none."""
    each = [f"<li>{as_html(words.removesuffix('.'))}.</li>" for words in sentences]
    return f"<ul>{''.join(each)}</ul>" if each else ""


def figure(picture: np.ndarray | Svg, words: str) -> str:
    """Return a picture (uint8 RGB or grey, or a diagram) with a caption."""
    caption = f"<figcaption>{as_html(words)}</figcaption></figure>"
    if isinstance(picture, Svg):
        return f'<figure class="diagram">{picture}{caption}'
    alt = html.escape(words)
    return f'<figure><img alt="{alt}" src="data:image/png;base64,{png_of(picture)}">{caption}'


def png_of(picture: np.ndarray) -> str:
    """Return a picture (uint8, RGB or grey) as a PNG file in base64."""
    from PIL import Image

    data = BytesIO()
    Image.fromarray(picture).save(data, "PNG")
    return base64.b64encode(data.getvalue()).decode()


def table(
    heads: Iterable[str], rows: Iterable[Iterable[str]], caption: str = "", kind: str = "parameters"
) -> str:
    """Return a table: each row's first cell is its head."""
    columns = "".join(f'<th scope="col">{as_html(head)}</th>' for head in heads)
    first = f"<thead><tr>{columns}</tr></thead>" if columns else ""
    lines = []
    for head, *cells in rows:
        filled = "".join(f"<td>{as_html(cell)}</td>" for cell in cells)
        lines.append(f'<tr><th scope="row">{as_html(head)}</th>{filled}</tr>')
    named = f"<caption>{as_html(caption)}</caption>" if caption else ""
    return (
        f'<div class="wide"><table class="{kind}">{named}{first}'
        f"<tbody>{''.join(lines)}</tbody></table></div>"
    )


STYLE = """
:root{color-scheme:light dark;--ink:#1c2b36;--paper:#fff;--muted:#566b7a;--line:#d8e0e6;
 --soft:#f4f7f9;--good:#dff1e4;--bad:#fbe5d6;--one:#eef2f6;--two:#dfe7ef;--curve:#0a6b8a}
@media (prefers-color-scheme:dark){:root{--ink:#e4ebf0;--paper:#14191d;--muted:#9db0bd;
 --line:#33414b;--soft:#1d252b;--good:#1d4a2b;--bad:#5a3318;--one:#222c33;--two:#2b3740;
 --curve:#5cc8e8}}
body{margin:0 auto;max-width:880px;padding:24px;color:var(--ink);background:var(--paper);
 font:16px/1.5 system-ui,sans-serif}
h1{font-size:26px;margin:0 0 8px;overflow-wrap:anywhere}
h2{font-size:19px;margin:40px 0 10px;padding-top:14px;border-top:1px solid var(--line)}
h3{font-size:16px;margin:24px 0 8px}
.status{padding:10px 14px;border-radius:6px;background:var(--bad)}
.status.converged{background:var(--good)}
.status b{margin-right:6px}
dl{display:flex;flex-wrap:wrap;gap:8px 36px;margin:0}
dt{font-size:13px;color:var(--muted)}dd{margin:0;font-size:20px}
figure{margin:0 0 18px}img{max-width:100%;height:auto;display:block;border-radius:4px}
svg{width:100%;min-width:520px;height:auto}.diagram{overflow-x:auto}
.diagram svg text{fill:var(--muted)}
[aria-label=convergence] line{stroke:var(--paper)}
[aria-label=convergence] rect{fill:var(--one)}
[aria-label=convergence] rect:nth-of-type(even){fill:var(--two)}
[aria-label=convergence] polyline{stroke:var(--curve)}
[aria-label=convergence] circle{fill:var(--curve)}
figcaption,p,li{font-size:15px}li::first-letter{text-transform:uppercase}figcaption,footer,caption,small{color:var(--muted)}
.wide{overflow-x:auto}
table{border-collapse:collapse;font-size:14px;font-variant-numeric:tabular-nums}
caption{text-align:left;font-size:13px;padding-bottom:4px}
th{text-align:left;font-weight:500}thead th{color:var(--muted);font-size:13px}
td,th{padding:4px 14px 4px 0;border-bottom:1px solid var(--line)}
thead th+th,td{text-align:right}.parameters :is(th,td):nth-last-child(-n+2){text-align:left}
.matrix td{padding:0}.matrix span{display:block}.matrix span,.matrix thead th{padding:5px 8px}
details{margin:6px 0}summary{cursor:pointer}
pre{overflow:auto;max-height:340px;background:var(--soft);padding:12px;border-radius:4px;
 font-size:13px}
footer{margin-top:48px;font-size:13px}
@media (max-width:560px){body{padding:14px}td,th{padding-right:8px}
 .matrix{font-size:11px}.matrix span,.matrix th,.matrix thead th{padding:4px 2px;font-size:11px}}
@media print{:root{color-scheme:light;--ink:#000;--paper:#fff;--muted:#444;--line:#bbb;
 --soft:#f4f7f9;--good:#dff1e4;--bad:#fbe5d6;--one:#eef2f6;--two:#dfe7ef;--curve:#0a6b8a}
 body{max-width:none;padding:0;font-size:11pt;print-color-adjust:exact;
 -webkit-print-color-adjust:exact}
 figure,table,p,li{break-inside:avoid}h2{break-after:avoid}img{max-height:16cm}
 a[download]{display:none}pre{max-height:none;white-space:pre-wrap}.wide{overflow:visible}}
"""
