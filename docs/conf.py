"""Configuration of the documentation site: `make docs` writes it to build/docs/."""

import re
from importlib.metadata import version as _version
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
ROOT_PAGES = {"README.md", "ARCHITECTURE.md", "CONTRIBUTING.md", "CHANGELOG.md", "SECURITY.md"}
"""Pages outside docs/; each is shown as the page of its name in docs/project/."""

project = "hilrig"
author = "The hilrig authors"
copyright = "The hilrig authors"
version = release = _version("hilrig")

extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon"]
exclude_patterns = ["conf.py"]
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3
# Links to files of the repository that are no pages, as examples, become downloads.
myst_links_external_new_tab = False

autodoc_member_order = "bysource"
autodoc_typehints = "description"
napoleon_google_docstring = True

html_theme = "furo"
html_static_path = ["style"]
html_css_files = ["site.css"]
html_title = f"hilrig {version}"
html_copy_source = False
html_show_sphinx = False


def _link(match: re.Match[str]) -> str:
    """Rewrite a link of a page outside docs/ for its place in docs/project/."""
    target = match[1]
    path, _, anchor = target.partition("#")
    if "://" in target or not path:
        return match[0]
    if path in ROOT_PAGES:
        path = path.lower()
    elif (ROOT / path / "README.md").exists():
        path = f"../../{path}/README.md"
    else:
        path = f"../../{path}"
    return f"]({path}#{anchor})" if anchor else f"]({path})"


def _read_root_page(_: Any, name: str, source: list[str]) -> None:
    folder, _, page = name.partition("/")
    if folder == "project":
        text = (ROOT / f"{page.upper()}.md").read_text(encoding="utf-8")
        source[0] = re.sub(r"\]\(([^)\s]+)\)", _link, text)


def setup(app: Any) -> None:
    """Show the pages outside docs/ within the site."""
    app.connect("source-read", _read_root_page)
