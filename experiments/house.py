"""How is the code written: characters in a line, comments, blank lines, how long are functions?

By tokens, docstrings left out. `python experiments/house.py out [FOLDER]`.
"""

import ast
import io
import sys
import tokenize
from pathlib import Path

from _common import run

#: A function of more lines is long.
LONG = 30


def docstring_lines(node: ast.AST) -> range:
    """Return the numbers of the lines of a docstring, if there is one."""
    first = next(iter(getattr(node, "body", [])), None)
    if not isinstance(first, ast.Expr) or not isinstance(first.value, ast.Constant):
        return range(0)
    if not isinstance(first.value.value, str):
        return range(0)
    return range(first.lineno, (first.end_lineno or first.lineno) + 1)


def of_file(path: Path) -> dict:
    """Return what is counted in a file."""
    source = path.read_text()
    lines, known = source.splitlines(), set()
    functions = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef | ast.Module):
            known |= set(docstring_lines(node))
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            length = (node.end_lineno or 0) - node.lineno + 1 - len(docstring_lines(node))
            functions.append((length, f"{path.name}: {node.name}"))
    tokens = tokenize.generate_tokens(io.StringIO(source).readline)
    comments = {t.start[0] for t in tokens if t.type == tokenize.COMMENT}
    rest = {k: line.strip() for k, line in enumerate(lines, 1) if k not in known}
    code = [line for line in rest.values() if line and not line.startswith("#")]
    return {
        "lines": len(lines),
        "code": len(code),
        "characters": sum(map(len, code)),
        "comments": sum(k in comments for k in rest),
        "blank": sum(not line for line in rest.values()),
        "functions": functions,
    }


def question() -> dict:
    root = Path(sys.argv[2] if len(sys.argv) > 2 else "pinhole_jax")
    paths = sorted(root.rglob("*.py"))
    files = [of_file(path) for path in paths]
    total = {
        k: sum(f[k] for f in files) for k in ("lines", "code", "characters", "comments", "blank")
    }
    functions = sorted((one for f in files for one in f["functions"]), reverse=True)
    named = [p.parent for p in paths if p.stem != "__init__"]
    beside = [named.count(folder) for folder in named]
    short = sum(length <= LONG for length, _ in functions) / len(functions)
    answer = {
        "files": len(files),
        "lines": total["lines"],
        "files side by side, at most": max(beside),
        "characters in a line of code": round(total["characters"] / total["code"], 1),
        "comments in 100 of code": round(100 * total["comments"] / total["code"], 1),
        "blank lines in 100 of code": round(100 * total["blank"] / total["code"], 1),
        "largest file": max(f["lines"] for f in files),
        "functions of at most 30 lines": round(100 * short, 1),
        "longest functions": functions[:10],
    }
    print("\n".join(f"{name}: {value}" for name, value in answer.items()))
    return answer


if __name__ == "__main__":
    run(question)
