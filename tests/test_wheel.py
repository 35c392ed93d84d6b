"""
What whoever has no checkout gets: wheel and source distribution are built, and the wheel is installed into an empty
environment outside the repository, where the commands of the README run. And the cures for missing packages, with a checkout
and without.
"""

import ast
import configparser
import importlib.util
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import tarfile
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from sb3_cpm import extras

ROOT = Path(__file__).resolve().parents[1]
#: What a checkout may hold that is of no use here, or large.
LEFT_OUT = (".*", "*.egg-info", "__pycache__", "build", "dist", "logs", "notebooks", "results", "runs", "tb")
HAS = {name: importlib.util.find_spec(name) is not None for name in ("build", "pip", "setuptools", "twine")}

needs_build = pytest.mark.skipif(
    not all(HAS[name] for name in ("build", "pip", "setuptools")),
    reason=f"build, pip or setuptools is not installed: {extras.install_command('tests')}",
)


def extras_of_setup() -> list[str]:
    config = configparser.ConfigParser()
    config.read(ROOT / "setup.cfg", encoding="utf-8")
    return config.options("options.extras_require")


def run(*command: object, cwd: Path, **variables: str) -> str:
    """In an environment that knows nothing of this checkout; what it has printed."""
    foreign = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")}
    environment = {**foreign, "PYTHONNOUSERSITE": "1", **variables}
    done = subprocess.run(
        [str(part) for part in command], cwd=cwd, env=environment, capture_output=True, text=True, timeout=1200
    )
    assert done.returncode == 0, f"{shlex.join(map(str, command))}\n{done.stdout[-3000:]}\n{done.stderr[-3000:]}"
    return done.stdout


class Environment:
    """
    A virtual environment in which nothing is installed, until :meth:`borrow` lends it what the tests' own has.

    :param folder: does not exist yet
    """

    def __init__(self, folder: Path) -> None:
        run(sys.executable, "-m", "venv", "--without-pip", folder, cwd=folder.parent)
        self.folder = folder
        self.python = folder / "bin/python"
        self.cwd = folder.parent / f"{folder.name}_work"
        self.cwd.mkdir()

    def borrow(self) -> None:
        """Other packages, so that no test needs the network; not the editable installs, whose ``.pth`` files are not read."""
        site = Path(self.call("-c", "import sysconfig; print(sysconfig.get_path('purelib'))").strip())
        folders = [path for path in sys.path if Path(path).name in ("site-packages", "dist-packages")]
        (site / "borrowed.pth").write_text("".join(f"{folder}\n" for folder in folders))

    def call(self, *arguments: object, **variables: str) -> str:
        """What Python prints."""
        return run(self.python, *arguments, cwd=self.cwd, **variables)

    def install(self, *arguments: object) -> None:
        """With the tests' own pip."""
        run(sys.executable, "-m", "pip", "--python", self.python, "install", "--no-index", *arguments, cwd=self.cwd)


@pytest.fixture(scope="module")
def copied(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the checkout, which builds may write to."""
    folder = tmp_path_factory.mktemp("checkout") / "sb3 cpm"  # a folder may have a space in its name
    shutil.copytree(ROOT, folder, ignore=shutil.ignore_patterns(*LEFT_OUT))
    (folder / "results").mkdir()
    (folder / "results/of_a_run.csv").write_text("step,return\n")
    return folder


@pytest.fixture(scope="module")
def dist(copied: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder with the source distribution, and the wheel that is built from it."""
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, copied, cwd=folder)
    return folder


@pytest.fixture(scope="module")
def wheel(dist: Path) -> Path:
    (path,) = dist.glob("*.whl")
    return path


@pytest.fixture(scope="module")
def sdist(dist: Path) -> Path:
    (path,) = dist.glob("*.tar.gz")
    return path


@pytest.fixture(scope="module")
def bare(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Environment:
    """The wheel, and nothing else."""
    environment = Environment(tmp_path_factory.mktemp("bare") / "venv")
    environment.install("--no-deps", wheel)
    return environment


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Environment:
    """The wheel, with all packages that the tests have."""
    environment = Environment(tmp_path_factory.mktemp("installed") / "venv")
    environment.install("--no-deps", wheel)
    environment.borrow()
    place = environment.call("-c", "import sb3_cpm; print(sb3_cpm.__file__)").strip()
    assert Path(place).is_relative_to(environment.folder), f"{place} is not that of the wheel"
    return environment


# ---------------------------------------------------------------------- what is in them


@pytest.mark.slow
@needs_build
def test_a_wheel_has_the_package_with_its_agents_and_nothing_else(wheel: Path, copied: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        names = {name for name in archive.namelist() if ".dist-info/" not in name}
    package = {path.relative_to(copied).as_posix() for path in (copied / "sb3_cpm").rglob("*") if path.is_file()}
    agents = {f"sb3_cpm/zoo_configs/{path.name}" for path in (ROOT / "zoo_configs").glob("*.yml")}
    assert names == package | agents | {"sb3_cpm/zoo_configs/__init__.py"}
    assert {"sb3_cpm/py.typed", "sb3_cpm/version.txt"} <= names and len(agents) >= 10


@pytest.mark.slow
@needs_build
def test_a_source_distribution_has_what_it_takes_to_build_it(sdist: Path) -> None:
    with tarfile.open(sdist) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    agents = {f"zoo_configs/{path.name}" for path in (ROOT / "zoo_configs").glob("*.yml")}
    assert agents | {"setup.py", "setup.cfg", "pyproject.toml", "constraints.txt", "README.md", "LICENSE"} <= names
    assert not {name for name in names if name.startswith(("tests", "results", "runs"))}


@pytest.mark.slow
@needs_build
@pytest.mark.skipif(not HAS["twine"], reason=f"twine is not installed: {extras.install_command('tests')}")
def test_an_index_would_take_them(wheel: Path, sdist: Path) -> None:
    run(sys.executable, "-m", "twine", "check", "--strict", wheel, sdist, cwd=wheel.parent)


@pytest.mark.slow
@needs_build
def test_the_readme_of_an_index_has_no_link_that_leads_nowhere(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        text = archive.read(name).decode()
    assert "](https://" in text and not re.findall(r"\]\((?!https://)[^)]*\)", text)


@pytest.mark.parametrize(
    "page",
    ["README.md", "CONTRIBUTING.md", "notebooks/README.md", *(f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md"))],
)
def test_links_lead_somewhere(page: str) -> None:
    text = (ROOT / page).read_text(encoding="utf-8")
    for target in re.findall(r"\]\((?!https?://)([^)\s]+)\)", text):
        name, _, anchor = target.partition("#")
        file = (ROOT / page).parent / name if name else ROOT / page
        assert file.exists(), target
        if anchor:
            titles = re.findall(r"^#+ (.*)$", file.read_text(encoding="utf-8"), re.MULTILINE)
            assert anchor in {re.sub(r"[^\w\- ]", "", title).strip().lower().replace(" ", "-") for title in titles}, target


def test_the_readme_of_an_index_has_absolute_links() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    readme = runpy.run_path(str(ROOT / "setup.py"), run_name="setup")["readme"]
    assert not re.findall(r"\]\((?!https://)", readme(text, "https://example.org/sb3_cpm"))
    picture = readme("![a picture](docs/a.png) of [that](docs/a.md), [see](#below), [SB3](https://sb3.org)", "https://e.org/c")
    assert picture == (
        "![a picture](https://e.org/c/raw/main/docs/a.png) of [that](https://e.org/c/blob/main/docs/a.md), see, "
        "[SB3](https://sb3.org)"
    )
    assert readme("![a picture](docs/a.png)of [that](docs/a.md)", "") == "of that"


# ---------------------------------------------------------------------- what runs


@pytest.mark.slow
@needs_build
def test_the_quickstart_of_the_readme_runs(installed: Environment) -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"two lines are all it takes:\n\n```python\n(.*?)```", text, re.DOTALL)
    for long, short in (("learning_starts=1000", "learning_starts=250"), ("100_000", "300")):
        assert long in code
        code = code.replace(long, short)
    before = "import gymnasium; from sb3_cpm.envs import DictObservation\n"
    make = "env = DictObservation(gymnasium.make('Pendulum-v1'))\n"
    after = "print(model.num_timesteps, model.replay_buffer.counters)"
    assert installed.call("-c", before + make + code + after).startswith("300 ")


@pytest.mark.slow
@needs_build
def test_train_runs(installed: Environment) -> None:
    installed.call("-m", "sb3_cpm", "train", "--env", "CPMToy-v0", "--steps", "400")
    (folder,) = (installed.cwd / "runs").iterdir()
    assert (folder / "model.zip").is_file()


@pytest.mark.slow
@needs_build
def test_an_experiment_runs(installed: Environment) -> None:
    shortened = ["--quick", "--steps", "300", "--seeds", "1", "--agents", "CPM-SAC"]
    told = installed.call("-m", "sb3_cpm", "reproduce", "--figure", "mountaincar", *shortened)
    assert "CPM-SAC" in told and list((installed.cwd / "results").rglob("evaluations.csv")), told


@pytest.mark.slow
@needs_build
def test_an_agent_runs_in_rl_zoo3(installed: Environment) -> None:
    shortened = ["--env", "CPMToy-v0", "-n", "150", "--eval-freq", "-1", "-f", "logs"]
    installed.call("-m", "sb3_cpm.zoo", "train", "--agent", "cpm_sac", *shortened)
    (folder,) = (installed.cwd / "logs/sac").iterdir()
    assert (folder / "CPMToy-v0.zip").is_file() and (folder / "challenger.pt").is_file()


@pytest.mark.slow
@needs_build
def test_a_file_that_is_not_there_says_where_there_are_some(installed: Environment) -> None:
    program = (
        "from sb3_cpm.agents import load_agent\n"
        "try:\n    load_agent('zoo_configs/sac.yml', 'CPMToy-v0')\nexcept ValueError as error:\n    print(error)"
    )
    told = installed.call("-c", program)
    assert told.startswith("There is no file zoo_configs/sac.yml. The files of our agents are in ")
    place = Path(told.strip().rpartition(" in ")[2].removesuffix("."))
    assert (place / "sac.yml").is_file() and place.is_relative_to(installed.folder)


# ---------------------------------------------------------------------- cures for what is missing


def calls_of_ours(*names: str) -> Iterator[tuple[Path, ast.Call]]:
    for path in sorted((ROOT / "sb3_cpm").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in names:
                yield path, node


def test_one_place_says_how_to_install_something() -> None:
    places = [path for path in (ROOT / "sb3_cpm").rglob("*.py") if "pip install" in path.read_text(encoding="utf-8")]
    assert [path.name for path in places] == ["extras.py"]


def test_every_hint_names_an_extra_that_there_is() -> None:
    known = extras_of_setup()
    wrong, found = [], 0
    for path, call in calls_of_ours("needed", "check_installed", "missing", "install_command"):
        assert isinstance(call.func, ast.Name)
        named = call.args if call.func.id == "install_command" else call.args[-1:]
        for extra in named:
            if isinstance(extra, ast.Constant):
                found += 1
                wrong += [f"{path.name}:{call.lineno}: {extra.value}"] if extra.value not in known else []
            else:
                assert path.name == "extras.py", f"{path}:{call.lineno}: write the extra out"
    assert not wrong and found >= 15


@pytest.mark.slow
@needs_build
def test_without_a_checkout_hints_name_what_registries_know(bare: Environment) -> None:
    packaging = pytest.importorskip("packaging.requirements")
    from packaging.utils import canonicalize_name

    pinned = {line.partition("==")[0] for line in (ROOT / "constraints.txt").read_text().splitlines() if "==" in line}
    for extra in ["", *extras_of_setup()]:
        program = f"from sb3_cpm.extras import install_command; print(install_command(*filter(None, [{extra!r}])))"
        pip, install, *wanted = shlex.split(bare.call("-c", program))
        assert (pip, install) == ("pip", "install")
        names = {canonicalize_name(packaging.Requirement(one).name) for one in wanted}
        assert "stable-baselines3" in names and names <= pinned, f"{extra}: {names - pinned}"
        if extra:
            assert len(names) > 4  # more than the package itself needs


@pytest.mark.slow
@needs_build
def test_the_doctor_looks_at_an_empty_environment(bare: Environment) -> None:
    program = "import sys; from sb3_cpm.__main__ import main; sys.exit(main(['doctor']) - 1)"  # it finds fault
    told = bare.call("-c", program)
    assert "FAIL  stable-baselines3" in told and "FAIL  tensorboard" in told
    cures = [line.partition("cure: ")[2] for line in told.splitlines() if "cure: pip install " in line]
    assert cures and all("sb3_cpm" not in cure and '"stable-baselines3<' in cure for cure in cures)


@pytest.mark.slow
@needs_build
def test_hints_of_a_wheel_can_be_typed(installed: Environment) -> None:
    """Everything is there already: pip has nothing to do, but reads all of it."""
    program = "from sb3_cpm.extras import install_command; print(install_command('run', 'zoo'))"
    pip, install, *wanted = shlex.split(installed.call("-c", program))
    assert (pip, install) == ("pip", "install") and any(one.startswith("imageio[ffmpeg]") for one in wanted)
    installed.install(*wanted)


@pytest.mark.slow
@needs_build
def test_hints_of_a_checkout_install_the_checkout(sdist: Path, tmp_path: Path) -> None:
    """An unpacked source distribution is one, too; its agents are found where they lie, also as a package."""
    with tarfile.open(sdist) as archive:
        archive.extractall(tmp_path / "my sources", filter="data")
    (checkout,) = (tmp_path / "my sources").iterdir()
    environment = Environment(tmp_path / "venv")
    environment.borrow()
    program = "from sb3_cpm.extras import install_command; print(install_command('run', 'zoo'))"
    pip, install, *wanted = shlex.split(environment.call("-c", program, PYTHONPATH=str(checkout)))
    assert (pip, install) == ("pip", "install") and wanted[-1] == f"{checkout}[run,zoo]"
    environment.install("--no-build-isolation", "--no-deps", *wanted)
    program = (
        "import importlib.resources, sb3_cpm.extras as extras; print(extras.config_folder())\n"
        "print(importlib.resources.files('sb3_cpm.zoo_configs') / 'cpm_sac.yml')"
    )
    folder, file = environment.call("-c", program).splitlines()
    assert Path(folder) == checkout / "zoo_configs" and Path(file) == checkout / "zoo_configs/cpm_sac.yml"
