"""Sphinx: `make docs` builds with warnings as errors."""

import importlib.metadata
import re
from pathlib import Path

import typer
from typer.cli import get_docs_for_click

from manip_learn.commands.program import program

project = "manip_learn"
author = "manip_learn developers"
project_copyright = "2026, manip_learn developers"
release = importlib.metadata.version("manip-learn")
version = release

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.mathjax",
    "sphinx.ext.viewcode",
    "sphinx_design",
]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}
exclude_patterns = ["_build"]
myst_enable_extensions = ["dollarmath", "amsmath", "deflist", "colon_fence"]
myst_heading_anchors = 3

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autodoc_typehints_format = "short"
python_maximum_signature_line_length = 90  # longer ones have a line for each argument
smartquotes = False  # --flags keep both hyphens
autodoc_type_aliases = {"ArrayLike": "ArrayLike"}
autodoc_default_options = {"members": True}
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True
napoleon_use_rtype = False
# docstrings use single backticks for code, as Markdown does
default_role = "code"


def mathjax() -> Path:
    """One file that draws formulas as SVG: pages load neither fonts nor anything from the network."""
    package = importlib.metadata.distribution("sphinx-mathjax-offline")
    return Path(str(package.locate_file("sphinx-mathjax-offline/static/mathjax/tex-svg.js")))


html_static_path = [str(mathjax())]
mathjax_path = mathjax().name

html_theme = "furo"
html_title = f"manip_learn {release}"
html_show_sphinx = False


SECTION = re.compile(r"(Args|Attributes|Returns|Yields|Raises|Examples?|Notes?):$")


def escape_formulas(app, what, name, obj, options, lines):
    """Docstrings write |A u| and constraint_ as a reader of the source expects; to Sphinx those are markup.

    Indented formulas before the first section keep their lines. They and the examples, from the first prompt to the end
    of the paragraph, are left as they are.
    """
    out, code, sections = [], False, False
    for line in lines:
        sections = sections or bool(SECTION.match(line))
        starts = not (out and out[-1].strip()) and line.startswith("    ") and not sections
        code = bool(line.strip()) and (code or starts or line.lstrip().startswith(">>>"))
        if starts and out and not any(before.endswith("::") for before in out[-2:]):
            out += ["::", ""]
        parts = line.split("`")
        if not code:
            parts[::2] = [re.sub(r"\||(?<=\w)_(?!\w)", lambda m: "\\" + m[0], part) for part in parts[::2]]
        out.append("`".join(parts))
    lines[:] = out


def name_aliases(app, what, name, obj, options, signature, returns):
    """Print the name of a type alias, not the object by which Sphinx remembers it."""
    return tuple(part and re.sub(r"TypeAliasForwardRef\('(\w+)'\)", r"\1", part) for part in (signature, returns))


def append_commands(app, docname, source):
    """Append the help of all commands to the page of the command line, as the program has it."""
    if docname == "command_line":
        context = typer.Context(program, info_name="manip-learn")
        source[0] += "\n" + get_docs_for_click(
            obj=program, ctx=context, indent=1, name="manip-learn", title="All commands"
        )


def setup(app):
    """Connect these; formulas are escaped before Napoleon reads the sections."""
    app.connect("source-read", append_commands)
    app.connect("autodoc-process-signature", name_aliases)
    app.connect("autodoc-process-docstring", escape_formulas, priority=400)
