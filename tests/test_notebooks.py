"""Notebooks: what is stored is sound and small; every one runs from a clean kernel, in its quickest version."""

import ast
import base64
import contextlib
import importlib
import os
import re
import shutil
from pathlib import Path

import pytest

nbformat = pytest.importorskip("nbformat")
nbclient = pytest.importorskip("nbclient")
run_sync = pytest.importorskip("jupyter_core.utils").run_sync
pytest.importorskip("ipykernel")
pytest.importorskip("rl_zoo3")
pytest.importorskip("rliable")

ROOT = Path(__file__).resolve().parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
IDS = [path.stem for path in NOTEBOOKS]
#: Those that show or simulate the robot.
WITH_ROBOT = ("02_baselines", "09_controllers", "10_pickcube_state_and_hard_exploration")
MOST_KB, MOST_KB_IN_ALL = 700, 3000
SECONDS = 3600
# /home/..., C:\..., but neither URLs nor fractions
ABSOLUTE_PATH = re.compile(r"(?<![\w.:/])/(home|root|tmp|usr|opt|mnt|work|var|Users)/|\b[A-Z]:\\\\")


def outputs_of(notebook):
    return [output for cell in notebook.cells for output in cell.get("outputs", [])]


def texts_of(output):
    """Everything in an output that is text, as one string."""
    parts = [output.get("text", ""), *output.get("traceback", [])]
    parts += [value for kind, value in output.get("data", {}).items() if kind.startswith("text/")]
    return "\n".join(parts)


def check_outputs(notebook):
    """Executed from top to bottom, with pictures; nothing went wrong, and nobody warned."""
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell.execution_count for cell in code] == list(range(1, len(code) + 1))
    outputs = outputs_of(notebook)
    kinds = [output.output_type for output in outputs]
    assert "error" not in kinds
    assert [output.text for output in outputs if output.output_type == "stream"] == []
    pictures = [output.data["image/png"] for output in outputs if "image/png" in output.get("data", {})]
    assert pictures, "no figure"
    assert all(base64.b64decode(picture).startswith(b"\x89PNG") for picture in pictures)


# ---------------------------------------------------------------------- as stored


def test_there_is_one_per_theme():
    assert [path.stem[:2] for path in NOTEBOOKS] == [f"{number:02}" for number in range(1, 11)]
    listed = (ROOT / "notebooks" / "README.md").read_text(encoding="utf-8")
    assert [path.name for path in NOTEBOOKS if f"({path.name})" not in listed] == []


@pytest.mark.parametrize("path", NOTEBOOKS, ids=IDS)
def test_stored_outputs(path):
    notebook = nbformat.read(path, 4)
    nbformat.validate(notebook)
    assert notebook.metadata.kernelspec.name == "python3"
    check_outputs(notebook)
    for output in outputs_of(notebook):
        assert not ABSOLUTE_PATH.search(texts_of(output)), texts_of(output)[:500]
    assert path.stat().st_size < MOST_KB * 1024


def test_all_together_are_small():
    assert sum(path.stat().st_size for path in NOTEBOOKS) < MOST_KB_IN_ALL * 1024


@pytest.mark.parametrize("path", NOTEBOOKS, ids=IDS)
def test_what_belongs_in_the_package_is_there(path):
    """Notebooks define neither functions nor classes, and touch nothing private."""
    cells = nbformat.read(path, 4).cells
    code = "\n".join(cell.source for cell in cells if cell.cell_type == "code")
    tree = ast.parse("\n".join(line for line in code.splitlines() if not line.startswith("%")))
    definitions = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)
    assert [node.name for node in ast.walk(tree) if isinstance(node, definitions)] == []
    private = [node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute) and node.attr.startswith("_")]
    assert private == []


@pytest.mark.parametrize("path", NOTEBOOKS[1:], ids=IDS[1:])
def test_figures_are_explained(path):
    """Under the figures of the report: what it claims, and what we see."""
    text = "\n".join(cell.source for cell in nbformat.read(path, 4).cells if cell.cell_type == "markdown")
    assert "**What the report claims" in text and "**What we see" in text


# ---------------------------------------------------------------------- executed


@pytest.fixture(scope="module")
def living_client(tmp_path_factory):
    """
    Finds the client of one kernel for all notebooks: a minute would be spent on importing PyTorch and ManiSkill ten times. Of
    a new one where the last has died: only the notebook that it died of fails.

    A process that the machine has no time for must not look like one that failed: alone, notebook 05 trains all five agents in
    one cell, 40 CPU seconds, and on a machine that many share that was more than the ten minutes that a cell had. So limits
    are only for what hangs. And matplotlib says so in a notebook if it takes it 5 s to look for fonts, so it does that here.
    """
    importlib.import_module("matplotlib.font_manager")
    results = tmp_path_factory.mktemp("results")  # of all notebooks: several draw the runs of one experiment
    search = os.pathsep.join(filter(None, (str(ROOT), os.environ.get("PYTHONPATH"))))
    environment = {**os.environ, "PYTHONPATH": search, "SB3_CPM_QUICK": "1", "SB3_CPM_RESULTS": str(results)}
    environment.pop("MPLBACKEND", None)  # Jupyter's own
    clients = []

    def start():
        client = nbclient.NotebookClient(
            nbformat.v4.new_notebook(),
            kernel_name="python3",
            **dict.fromkeys(("timeout", "startup_timeout", "iopub_timeout"), SECONDS),
            raise_on_iopub_timeout=True,  # else outputs that come later are lost without a word
        )
        stack.enter_context(client.setup_kernel(env=environment))
        return client

    def find():
        if not clients or not run_sync(clients[-1].kc.is_alive)():
            clients.append(start())
        return clients[-1]

    with contextlib.ExitStack() as stack:
        yield find


@pytest.mark.slow
@pytest.mark.parametrize(
    "path",
    [  # backwards: the last one's results are drawn by others, too
        pytest.param(path, id=path.stem, marks=[pytest.mark.maniskill] if path.stem in WITH_ROBOT else [])
        for path in NOTEBOOKS[::-1]
    ],
)
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::ResourceWarning", "ignore::RuntimeWarning:zmq.*")
def test_runs_from_a_clean_kernel(path, tmp_path, living_client):
    copy = tmp_path / "notebooks" / path.name
    copy.parent.mkdir()
    shutil.copy(path, copy)
    notebook = nbformat.read(copy, 4)
    for cell in notebook.cells:  # a clean one: nothing is left of what is stored
        if cell.cell_type == "code":
            cell.outputs, cell.execution_count = [], None
    client = living_client()
    # nor of the notebook before, but for what it imported
    clean = f"import os; os.chdir({str(copy.parent)!r}); get_ipython().reset()"
    reply = client.wait_for_reply(client.kc.execute(clean, silent=True))
    assert reply["content"]["status"] == "ok", reply["content"]
    client.nb = notebook
    client.execute(cleanup_kc=False)  # raises where a cell does
    check_outputs(notebook)
    assert list(copy.parent.iterdir()) == [copy], "left something beside itself"
