"""What the built distribution says of itself: the README, its links as addresses.

In the repository its pictures and links are beside it. Where a package index shows it they are not:
there each becomes an address that begins with `Repository` of `[project.urls]`.
"""

import re
from pathlib import Path

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
