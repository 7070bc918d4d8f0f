"""The mesh files that a URDF names: relative to it, by `file://`, or in a package of ROS."""

import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from .._files.paths import FilePath, read_text

Folders = Mapping[str, FilePath]


def check_packages(packages: Any) -> Folders:
    """Return the folders of packages by name, none for None; raise ValueError for all else."""
    expected = "`packages`: expected a mapping of package name to folder, got"
    if packages is None:
        return {}
    if not isinstance(packages, Mapping):
        raise ValueError(f"{expected} {packages!r}; give {{NAME: FOLDER}}")
    for name, folder in packages.items():
        if not (isinstance(name, str) and isinstance(folder, str | os.PathLike)):
            raise ValueError(f"{expected} {folder!r} for {name!r}")
    return packages


def mesh_path(name: str, urdf: Path, packages: Folders) -> Path:
    """Return the path of a mesh; only a package's file is known to exist.

    Raises ValueError for other kinds of URI, FileNotFoundError for packages and files in them.
    """
    kind, _, rest = name.replace("\\", "/").rpartition("://")
    if kind not in ("package", "model"):
        if kind not in ("", "file"):
            raise ValueError(f"expected a path, file:// or package://, got {name!r}")
        return urdf.parent / (unquote(rest) if kind else rest)
    package, _, rest = rest.partition("/")
    tried = []
    # A folder of the right name that lacks the file may be part of another package (of Python's,
    # say), so the next one is tried.
    for folder in [packages[package]] if package in packages else _folders(package, urdf):
        if (file := Path(folder, rest)).is_file():
            return file
        tried.append(str(folder))
    where = ", ".join(tried) or f"no such package above or beside {str(urdf.parent)!r}"
    raise FileNotFoundError(
        f"expected {rest!r} of the package {package!r}, got no such file (looked in: {where});"
        f" give `packages={{{package!r}: FOLDER}}`, or set ROS_PACKAGE_PATH"
    )


def _folders(package: str, urdf: Path) -> Iterator[Path]:
    """Yield the folders of a package: those above the URDF and beside these, the nearest first,
    then ROS's own."""
    above = Path(os.path.abspath(urdf)).parents
    ros = filter(None, os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep))
    for folder in [*above, *map(Path, ros)]:
        beside = (file.parent for file in sorted(folder.glob("*/package.xml")))
        for candidate in dict.fromkeys([folder, folder / package, *beside]):
            if _name(candidate) == package:
                yield candidate


def _name(folder: Path) -> str | None:
    """Return the name of a package: its manifest's, else its folder's."""
    try:
        named = re.search(r"<name>\s*([^<\s]+)\s*</name>", read_text(folder / "package.xml", ""))
    except (OSError, ValueError):
        named = None
    return named[1] if named else folder.name if folder.is_dir() else None
