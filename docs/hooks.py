"""This site's own additions to ProperDocs.

- With DRAFT=1 in the environment no page runs; with DRAFT=tutorials/many-fits.md this one does (of
  several there are commas between).
- Pages whose header says `run: true` are notebooks: their code runs while the site is built, in
  order, in one namespace and an empty folder. What it prints and the value of each block's last
  line follow the block. The page says where the same as an .ipynb is.
- The README, the experiments' page with its pictures and scripts, the changelog and how to
  contribute stand elsewhere in the repository: they become pages here.
"""

import ast
import base64
import contextlib
import io
import json
import os
import re
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

from properdocs.exceptions import PluginError
from properdocs.plugins import get_plugin_logger
from properdocs.structure.files import File

LOG = get_plugin_logger(__name__)
ROOT = Path(__file__).parents[1]
HEADER = re.compile(r"\A---\n(.*?)\n---\n", re.S)
BLOCK = re.compile(r"^```(python|sh)\n(.*?)^```$", re.M | re.S)
FENCED = re.compile(r"(^```.*?^```$)", re.M | re.S)
#: The lines of shell that run here; others install, or start another program.
RUNS = ("pinhole-jax ", "python ")
#: Pages that stand elsewhere in the repository.
ELSEWHERE = {
    "index.md": "README.md",
    "changelog.md": "CHANGELOG.md",
    "contributing.md": "CONTRIBUTING.md",
    "experiments/index.md": "experiments/README.md",
    "experiments/reference/index.md": "experiments/reference/README.md",
}
#: A link to a file and a place in it, which is neither an address nor an image's data.
LINK = re.compile(r"\]\((?!\w+:)([^)#\s]+)(#[^)\s]*)?\)")
NOTEBOOK = {
    "metadata": {
        "kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}
    },
    "nbformat": 4,
    "nbformat_minor": 5,
}


class Output(NamedTuple):
    """A block's output: its media type, as notebooks have it, and its text."""

    kind: str
    text: str


class Cell(NamedTuple):
    """A piece of prose, or a block of code with its language and its outputs."""

    text: str
    language: str = ""
    outputs: tuple[Output, ...] = ()


#: The cells of the pages that ran, by path.
RAN: dict[str, list[Cell]] = {}


def on_files(files: Any, config: Any) -> Any:
    """The site's files with those that stand elsewhere, and the notebooks."""
    for page, source in ELSEWHERE.items():
        text = (ROOT / source).read_text(encoding="utf-8")
        files.append(File.generated(config, page, content=text))
    for path in [*(ROOT / "experiments").glob("*.py"), *(ROOT / "experiments").glob("*/*.*")]:
        place = path.relative_to(ROOT).as_posix()
        if place not in ELSEWHERE.values() and "__pycache__" not in place:
            files.append(File.generated(config, place, abs_src_path=str(path)))
    draft = os.environ.get("DRAFT", "")
    for file in [*files.documentation_pages()]:
        header = HEADER.match(file.content_string)
        if not header or (draft and file.src_uri not in draft.split(",")):
            continue
        if "run: true" in header[1]:
            begin = time.process_time()
            RAN[file.src_uri] = run(file.content_string[header.end() :], file.src_uri)
            LOG.info("%s: %.0f s of the processor", file.src_uri, time.process_time() - begin)
            notebook = file.src_uri.removesuffix("md") + "ipynb"
            content = as_notebook(RAN[file.src_uri])
            files.append(File.generated(config, notebook, content=content))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """A page's text, with its code's output, and links as they are on this site."""
    if page.file.src_uri in RAN:
        markdown = as_page(RAN[page.file.src_uri], Path(page.file.src_uri).stem)
    source = ELSEWHERE.get(page.file.src_uri, f"docs/{page.file.src_uri}")
    here = Path(page.file.src_uri).parent

    def link(found: re.Match[str]) -> str:
        """A link to the same thing on this site as in the repository."""
        path = os.path.normpath(Path(source).parent / found[1])
        places = {source: place for place, source in ELSEWHERE.items()}
        place = places.get(path, path.removeprefix("docs/"))
        return f"]({os.path.relpath(place, here)}{found[2] or ''})"

    parts = FENCED.split(markdown)  # code is every second one
    parts[::2] = [LINK.sub(link, prose) for prose in parts[::2]]
    return "".join(parts)


def run(text: str, name: str) -> list[Cell]:
    """Run a page's code; return its cells."""
    import pinhole_jax as pj

    pj.cache()
    cells, end, names = [], 0, {"__name__": "__main__"}
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        Path("experiments").symlink_to(ROOT / "experiments")
        for block in BLOCK.finditer(text):
            cells.append(Cell(text[end : block.start()].strip()))
            language, code = block.groups()
            try:
                outputs = python(code, names) if language == "python" else shell(code)
            except Exception as error:
                raise PluginError(f"{name}, block {len(cells)}: {error!r}\n{code}") from error
            cells.append(Cell(code.rstrip(), language, tuple(outputs)))
            end = block.end()
    return [*cells, Cell(text[end:].strip())]


def python(code: str, names: dict[str, Any]) -> list[Output]:
    """The output of Python: what it prints, and the value of its last line."""
    tree, last = ast.parse(code), None
    if tree.body and isinstance(tree.body[-1], ast.Expr):
        last = ast.Expression(tree.body.pop().value)
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        exec(compile(tree, "page", "exec"), names)
        value = None if last is None else eval(compile(last, "page", "eval"), names)
    outputs = [Output("stdout", printed.getvalue())] if printed.getvalue() else []
    return outputs if value is None else [*outputs, shown(value)]


def shown(value: Any) -> Output:
    """A value as a notebook shows it."""
    if hasattr(value, "savefig"):  # matplotlib's figures
        value.savefig(drawn := io.BytesIO(), bbox_inches="tight", dpi=110)
        return Output("image/png", base64.b64encode(drawn.getvalue()).decode())
    if hasattr(value, "_repr_png_"):
        return Output("image/png", base64.b64encode(value._repr_png_()).decode())
    if hasattr(value, "_repr_svg_"):
        return Output("image/svg+xml", value._repr_svg_())
    if hasattr(value, "_repr_html_"):
        return Output("text/html", value._repr_html_())
    return Output("text/plain", repr(value))


def shell(code: str) -> list[Output]:
    """The output of commands; an exit status of 1 is a fit that is not to be trusted."""
    outputs = []
    environment = {
        **os.environ,
        "PATH": f"{Path(sys.executable).parent}:{os.environ['PATH']}",
        "COLUMNS": "88",
    }
    for line in code.replace("\\\n", " ").splitlines():
        if line.startswith(RUNS):
            words = shlex.split(line)
            done = subprocess.run(
                words, env=environment, capture_output=True, text=True, check=False
            )
            if done.returncode not in (0, 1) or "Traceback" in done.stderr:
                raise RuntimeError(f"{line}: {done.stderr}")
            outputs.append(Output("stdout", done.stdout))
    return outputs


def as_page(cells: list[Cell], name: str) -> str:
    """Cells as a page's Markdown, with a link to the notebook."""
    parts = [
        cells[0].text,
        f"*Every block ran when this page was made; as a [notebook]({name}.ipynb).*{{ .ran }}",
    ]
    for cell in cells[1:]:
        if not cell.language:
            parts.append(cell.text)
            continue
        parts.append(f"```{cell.language}\n{cell.text}\n```")
        parts += [as_markdown(output) for output in cell.outputs]
    return "\n\n".join(parts)


def as_markdown(output: Output) -> str:
    """A block's output, as Markdown to stand below it."""
    if output.kind in ("stdout", "text/plain"):
        return f"```{{ .text .output .no-copy }}\n{output.text.rstrip()}\n```"
    if output.kind == "image/png":
        inside = f'<img alt="what the code above draws" src="data:image/png;base64,{output.text}">'
    elif output.kind == "image/svg+xml":
        data = base64.b64encode(output.text.encode()).decode()
        inside = f'<img alt="what the code above draws" src="data:image/svg+xml;base64,{data}">'
    else:
        inside = re.sub(r"\n\s*", " ", output.text)
    return f'<div class="output">{inside}</div>'


def as_notebook(cells: list[Cell]) -> str:
    """Cells with their outputs as an .ipynb file."""
    content, number = [], 0
    for cell in cells:
        lines = cell.text.splitlines(keepends=True)
        if not cell.language:
            content.append({"cell_type": "markdown", "metadata": {}, "source": lines})
            continue
        number += 1
        source = lines if cell.language == "python" else [f"!{line}" for line in lines]
        left = [as_json(output, number) for output in cell.outputs]
        content.append(
            {
                "cell_type": "code",
                "execution_count": number,
                "metadata": {},
                "outputs": left,
                "source": source,
            }
        )
    for number, cell in enumerate(content):
        cell["id"] = f"cell-{number}"
    return json.dumps({**NOTEBOOK, "cells": content}, indent=1)


def as_json(output: Output, number: int) -> dict[str, Any]:
    """A block's output as notebooks store it."""
    if output.kind == "stdout":
        return {"output_type": "stream", "name": "stdout", "text": output.text}
    data = {output.kind: output.text}
    return {
        "output_type": "execute_result",
        "execution_count": number,
        "data": data,
        "metadata": {},
    }
