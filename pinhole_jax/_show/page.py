"""Pages that are complete in themselves: pictures are data URIs, nothing else is loaded."""

import base64
import html
import io
from collections.abc import Iterable

import numpy as np


def document(title: str, head: str, sections: Iterable[str]) -> str:
    """Return a page of a title (plain text), what stands below it, and sections."""
    from .. import __version__

    name = html.escape(title)
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{name}</title><style>{STYLE}</style></head><body>"
        f"<header><h1>{name}</h1>{head}</header><main>{''.join(sections)}</main>"
        f"<footer>pinhole_jax {__version__}</footer></body></html>\n"
    )


def facts(numbers: dict[str, str]) -> str:
    """Return a row of numbers with their names."""
    shown = "".join(f"<div><dt>{name}</dt><dd>{x}</dd></div>" for name, x in numbers.items())
    return f"<dl>{shown}</dl>"


def section(heading: str, body: str) -> str:
    """Return a section under a heading."""
    key = heading.lower().replace(" ", "-")
    return f'<section id="{key}"><h2>{heading}</h2>{body}</section>\n'


def figure(image: np.ndarray, words: str) -> str:
    """Return a picture (uint8 RGB or grey) with words below it."""
    from PIL import Image

    buffer = io.BytesIO()
    Image.fromarray(image).save(buffer, "PNG", optimize=True)
    data = base64.b64encode(buffer.getvalue()).decode()
    return (
        f'<figure><img alt="{words}" src="data:image/png;base64,{data}">'
        f"<figcaption>{words}</figcaption></figure>"
    )


def table(caption: str, heads: Iterable[str], rows: Iterable[Iterable[str]], kind: str) -> str:
    """Return a table: each row's first cell is its head, and cells may bring their own tag."""
    columns = "".join(f'<th scope="col">{head}</th>' for head in heads)
    lines = []
    for head, *cells in rows:
        filled = "".join(x if x.startswith("<td") else f"<td>{x}</td>" for x in cells)
        lines.append(f'<tr><th scope="row">{head}</th>{filled}</tr>')
    return (
        f'<div class="wide"><table class="{kind}"><caption>{caption}</caption>'
        f"<thead><tr>{columns}</tr></thead><tbody>{''.join(lines)}</tbody></table></div>"
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
.diagram svg text{fill:var(--muted)}.diagram svg line{stroke:var(--paper)}
.diagram svg rect{fill:var(--one)}.diagram svg rect:nth-of-type(even){fill:var(--two)}
.diagram svg polyline{stroke:var(--curve)}.diagram svg circle{fill:var(--curve)}
figcaption,p,li{font-size:15px}figcaption,footer,caption,small{color:var(--muted)}
.wide{overflow-x:auto}
table{border-collapse:collapse;font-size:14px;font-variant-numeric:tabular-nums}
caption{text-align:left;font-size:13px;padding-bottom:4px}
th{text-align:left;font-weight:500}thead th{color:var(--muted);font-size:13px}
td,th{padding:4px 14px 4px 0;border-bottom:1px solid var(--line)}
thead th+th,td{text-align:right}.parameters th:last-child,.parameters td:last-child{text-align:left}
small{display:block;font-size:12px}
.matrix td,.matrix thead th{padding:5px 8px}
details{margin:6px 0}summary{cursor:pointer}
pre{overflow:auto;max-height:340px;background:var(--soft);padding:12px;border-radius:4px;
 font-size:13px}
footer{margin-top:48px;font-size:13px}
@media (max-width:560px){body{padding:14px}td,th{padding-right:8px}
 .matrix{font-size:11px}.matrix td,.matrix th,.matrix thead th{padding:4px 2px;font-size:11px}}
@media print{:root{color-scheme:light;--ink:#000;--paper:#fff;--muted:#444;--line:#bbb;
 --soft:#f4f7f9;--good:#dff1e4;--bad:#fbe5d6;--one:#eef2f6;--two:#dfe7ef;--curve:#0a6b8a}
 body{max-width:none;padding:0;font-size:11pt;print-color-adjust:exact;
 -webkit-print-color-adjust:exact}
 figure,table,p,li{break-inside:avoid}h2{break-after:avoid}img{max-height:16cm}
 a[download]{display:none}pre{max-height:none;white-space:pre-wrap}.wide{overflow:visible}}
"""
