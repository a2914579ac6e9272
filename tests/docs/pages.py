"""The pages of the project and the blocks of code in them."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGES = sorted(
    page.relative_to(ROOT)
    for pattern in ("*.md", "*/README.md", ".github/*.md")
    for page in ROOT.glob(pattern)
)

_BLOCK = re.compile(
    r"(?P<mark><!-- not run: (?P<reason>[^>]+) -->\n+)?"
    r"^```(?P<language>\w+)\n(?P<code>.*?)^```$",
    re.MULTILINE | re.DOTALL,
)


@dataclass(frozen=True, slots=True)
class Block:
    """One fenced block of a page."""

    language: str
    code: str
    line: int
    reason: str | None
    """Why the block is not run; None: it is."""


def blocks_of(page: Path, *languages: str) -> list[Block]:
    """The blocks of ``page`` in one of ``languages``, in their order."""
    text = (ROOT / page).read_text(encoding="utf-8")
    found = [
        Block(
            match["language"], match["code"], text[: match.start()].count("\n") + 1, match["reason"]
        )
        for match in _BLOCK.finditer(text)
    ]
    return [block for block in found if block.language in languages]


def commands_of(block: Block) -> list[str]:
    """The commands of a shell block, each on one line and without its comment."""
    joined = re.sub(r"\\\n\s*", "", block.code)
    lines = (re.sub(r"(^|\s+)#.*$", "", line).strip() for line in joined.splitlines())
    return [line for line in lines if line]
