"""Draw the pictures of the pages that plot, by the code on these pages: `python docs/make_plots.py [FOLDER]`.

Needs the extras `plots` and `pink`.
"""

from __future__ import annotations

import contextlib
import re
import sys
from pathlib import Path

DOCS = Path(__file__).resolve().parent
PAGES = ("interop", "control")
BLOCK = re.compile(r"^(?P<skipped><!-- not run: [^\n]*\n)?```python\n(?P<code>.*?)^```", re.MULTILINE | re.DOTALL)


def main(folder: Path = DOCS / "images") -> None:
    """Run the Python of each page in the folder of the pictures, except blocks marked as not run; keep the pictures."""
    import matplotlib

    matplotlib.use("Agg")
    for page in PAGES:
        before, names = set(folder.iterdir()), dict[str, object]()
        text = (DOCS / f"{page}.md").read_text(encoding="utf-8")
        with contextlib.chdir(folder):
            for block in BLOCK.finditer(text):
                if not block["skipped"]:
                    exec(compile(block["code"], page, "exec"), names)
        for file in set(folder.iterdir()) - before:
            if file.suffix != ".png":
                file.unlink()


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
