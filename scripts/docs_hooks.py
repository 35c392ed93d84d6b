"""
Hooks of mkdocs.yml. Pages link to files of the repository that lie outside of ``docs/``: pictures among them are copied into
the site; what else is linked (code, results, notebooks) stays as text, since no address of the repository is known.
"""

import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File, Files

ROOT = Path(__file__).parents[1]
PICTURES = {".png", ".svg", ".gif"}
LINK = re.compile(r"(?P<picture>!?)\[(?P<text>(?:[^\[\]]|\[[^\]]*\])*)\]\((?P<target>[^)\s#]+)(?P<anchor>#[^)\s]*)?\)")
#: Files of the repository that are pages here.
PAGES = {"CHANGELOG.md": "changelog.md", "CONTRIBUTING.md": "contributing.md", "README.md": "index.md"}


def outside(target: str) -> Path | None:
    """:return: the file of the repository that a link in ``docs/`` leads out to, relative to the root; None for other links"""
    if "://" in target or not target.startswith("../"):
        return None
    return (ROOT / "docs" / target).resolve().relative_to(ROOT)


def on_files(files: Files, config: Any) -> Files:
    for page in sorted((ROOT / "docs").glob("*.md")):
        for link in LINK.finditer(page.read_text()):
            path = outside(link["target"])
            if path is None or path.suffix not in PICTURES:
                continue
            if files.get_file_from_path(path.as_posix()) is None:
                files.append(File.generated(config, path.as_posix(), abs_src_path=str(ROOT / path)))
    return files


def on_page_content(html: str, **kwargs: Any) -> str:
    """Docstrings have Sphinx' roles and literal blocks, which Markdown shows as they are."""
    html = re.sub(r":\w+:<code>~?(?:[\w.]*\.)?(\w+)</code>", r"<code>\1</code>", html)
    return html.replace("<p>::</p>", "").replace("::</p>", ":</p>")


def on_page_markdown(markdown: str, **kwargs: Any) -> str:
    return LINK.sub(_replaced, markdown)


def _replaced(link: re.Match[str]) -> str:
    path = outside(link["target"])
    if path is None:
        return link[0]
    if path.suffix in PICTURES:
        return f"{link['picture']}[{link['text']}]({path.as_posix()})"
    if path.as_posix() in PAGES:
        return f"[{link['text']}]({PAGES[path.as_posix()]}{link['anchor'] or ''})"
    return link["text"]
