"""Print the shell commands of a Markdown file that are marked to be run.

A block is run when the line before its fence is `<!-- run -->`. Everything after `#` preceded by
two blanks is a remark to the reader and goes away with it, as bash does itself.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

BLOCK = re.compile(r"^<!-- run -->\n```sh\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def commands(text: str) -> list[str]:
    """The marked blocks, in order."""
    return BLOCK.findall(text)


if __name__ == "__main__":
    found = commands(Path(sys.argv[1]).read_text(encoding="utf-8"))
    if not found:
        sys.exit(f"{sys.argv[1]}: no block is marked with <!-- run -->")
    print("\n".join(found), end="")
