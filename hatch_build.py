"""How the distribution is built: its README, with links as addresses, and its compiled library.

In the repository its pictures and links are beside it. Where a package index shows it they are not:
there each becomes an address that begins with `Repository` of `[project.urls]`.
"""

import os
import re
import shlex
import shutil
import subprocess
import sysconfig
from pathlib import Path

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from hatchling.metadata.plugin.interface import MetadataHookInterface

LINK = re.compile(r"(!?)\[([^\]]*)\]\((?!\w+:|#)([^)]+)\)")


def with_addresses(text: str, repository: str) -> str:
    """Return Markdown whose relative links and pictures lead to the main branch of a repository."""

    def absolute(found: re.Match[str]) -> str:
        picture, words, path = found.groups()
        return f"{picture}[{words}]({repository}/{'raw' if picture else 'blob'}/main/{path})"

    return LINK.sub(absolute, text)


class CustomMetadataHook(MetadataHookInterface):
    """Gives the project its readme."""

    def update(self, metadata: dict) -> None:
        """Set what pyproject.toml calls dynamic, but for the version."""
        text = (Path(self.root) / "README.md").read_text(encoding="utf-8")
        text = with_addresses(text, metadata["urls"]["Repository"])
        metadata["readme"] = {"content-type": "text/markdown", "text": text}


class CustomBuildHook(BuildHookInterface):
    """Compiles the loops of `pinhole_jax/_native` into a library beside their sources.

    Without a C++ compiler, or where compiling fails, the package is built without: it says so where
    it is used, and what is slower. A release says which platform `CXX` compiles for, as wheels name
    it (`PINHOLE_JAX_PLATFORM`), and is not built without.
    """

    def initialize(self, version: str, build_data: dict) -> None:
        """Compile it, and have the wheel say for which platform."""
        del version
        if self.target_name != "wheel":
            return
        folder = Path(self.root) / "pinhole_jax" / "_native"
        platform = os.environ.get("PINHOLE_JAX_PLATFORM", "")
        system = (platform or sysconfig.get_platform()).partition("_")[0].partition("-")[0]
        library = folder / LIBRARIES.get(system, "libpinhole.so")
        why = compiled(folder / "handlers.cc", library, seconds=1800 if platform else 300)
        if why and platform:
            raise RuntimeError(f"The compiled library for {platform}: {why}")
        if why:
            self.app.display_warning(f"The compiled library is left out: {why}")
            return
        build_data["artifacts"].append(str(library.relative_to(self.root)))
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{platform or platform_tag()}"


#: The library's name by the first word of a platform.
LIBRARIES = {"macosx": "libpinhole.dylib", "win": "pinhole.dll", "mingw": "pinhole.dll"}
#: Products are rounded before they are added: shared points come out alike everywhere.
FLAGS = shlex.split("-std=c++17 -O3 -ffp-contract=off -shared -fPIC -fvisibility=hidden -pthread")


def compiled(source: Path, library: Path, seconds: float) -> str:
    """Compile the library; why it failed, or an empty string."""
    names = [os.environ["CXX"]] if os.environ.get("CXX") else ["c++", "g++", "clang++"]
    compiler = next((name for name in names if shutil.which(shlex.split(name)[0])), None)
    if compiler is None:
        return f"no C++ compiler was found ({', '.join(names)})"
    command = [*shlex.split(compiler), *FLAGS, str(source), "-o", str(library)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=seconds, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return str(error)
    if done.returncode:
        library.unlink(missing_ok=True)
        return (done.stderr.strip() or f"{compiler} failed").splitlines()[-1]
    return ""


def platform_tag() -> str:
    """The platform that a wheel built here is for, as wheels name it."""
    return sysconfig.get_platform().replace("-", "_").replace(".", "_")
