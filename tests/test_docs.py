"""The documentation: it builds without a warning, its code runs, and what it says of errors is what the code says."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = sorted((ROOT / "docs").glob("*.md"))
BLOCK = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)


def blocks() -> list[tuple[str, int, str]]:
    """:return: page, number and text of all blocks of Python"""
    return [(page.stem, i, text) for page in PAGES for i, text in enumerate(BLOCK.findall(page.read_text()))]


@pytest.mark.parametrize("page, number, text", blocks(), ids=[f"{page}-{number}" for page, number, _ in blocks()])
def test_code_is_python(page: str, number: int, text: str) -> None:
    compile(text, f"{page}.md", "exec")


#: Pages whose blocks are whole programs, from the first import on.
PROGRAMS = ("quickstart", "own_environment", "images_and_clouds", "resume", "maniskill")


@pytest.mark.slow
@pytest.mark.parametrize(
    "page", [pytest.param(page, marks=[pytest.mark.maniskill] if page == "maniskill" else []) for page in PROGRAMS]
)
def test_programs_run(page: str, tmp_path: Path) -> None:
    programs = [text for name, _, text in blocks() if name == page]
    assert programs, page
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", "\n".join(programs)], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr[-2000:]


# ---------------------------------------------------------------------- errors by their text


def said(node: ast.AST) -> str:
    """:return: the text of a message, without what is filled in"""
    if isinstance(node, ast.Constant) and isinstance(node.value, str):
        return node.value
    if isinstance(node, ast.JoinedStr):
        return "".join(said(value) for value in node.values)
    if isinstance(node, ast.BinOp):
        return said(node.left) + said(node.right)
    return "…"


def messages() -> dict[str, list[str]]:
    """:return: what errors and functions that make some say, by room of the package"""
    found: dict[str, list[str]] = {}
    for path in sorted((ROOT / "sb3_cpm").rglob("*.py")):
        room = path.relative_to(ROOT / "sb3_cpm").parts[0]
        tree = ast.parse(path.read_text())
        texts = [said(node) for node in ast.walk(tree) if isinstance(node, (ast.JoinedStr, ast.Constant))]
        if any(isinstance(node, ast.Raise) for node in ast.walk(tree)):
            found.setdefault(room, []).extend(texts)
    return found


def entries() -> list[str]:
    page = (ROOT / "docs" / "troubleshooting.md").read_text()
    return re.findall(r"^\| `([^`]+)` \|", page, re.MULTILINE)


def raising_rooms() -> set[str]:
    """Rooms that raise often enough to be a family of their own."""
    rooms: dict[str, int] = {}
    for path in (ROOT / "sb3_cpm").rglob("*.py"):
        room = path.relative_to(ROOT / "sb3_cpm").parts[0]
        nodes = ast.walk(ast.parse(path.read_text()))
        rooms[room] = rooms.get(room, 0) + sum(isinstance(node, ast.Raise) and node.exc is not None for node in nodes)
    return {room for room, n in rooms.items() if n >= 5}


def test_every_error_on_the_page_is_one_of_the_package() -> None:
    everything = [text for texts in messages().values() for text in texts]
    absent = [entry for entry in entries() if not any(entry in text for text in everything)]
    assert len(entries()) > 40 and not absent


def test_every_family_of_errors_has_an_entry() -> None:
    by_room = messages()
    told = {room for room, texts in by_room.items() if any(entry in text for entry in entries() for text in texts)}
    assert raising_rooms() <= told


# ---------------------------------------------------------------------- the site


@pytest.mark.slow
def test_the_site_builds_without_a_warning(tmp_path: Path) -> None:
    pytest.importorskip("mkdocstrings_handlers", reason='needs the extra "docs"')
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--quiet", "--site-dir", str(tmp_path / "site")],
        cwd=ROOT, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    pages = {path.relative_to(tmp_path / "site").as_posix() for path in (tmp_path / "site").rglob("*.html")}
    assert {f"{page.stem}/index.html" for page in PAGES if page.stem != "index"} <= pages
    reference = (tmp_path / "site" / "api" / "index.html").read_text()
    assert "ChallengerCallback" in reference and "share of a ring that demonstrations are not pushed out of" in reference
