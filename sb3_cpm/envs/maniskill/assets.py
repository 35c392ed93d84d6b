"""
The files that some tasks download: what each needs, whether it is there and complete, and how to get it.

ManiSkill looks for the folder only, which a failed download leaves behind, and asks on stdin where it is not there: a prompt
at which a batch job waits for ever. Here a missing or damaged file is an error at once, and
``python -m sb3_cpm assets --download TASK`` fetches what is wanting.
"""

import contextlib
import functools
import json
import re
import shutil
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from sb3_cpm.envs.maniskill.tasks import REPORT_TASKS, register_report_tasks

GROUPS = {"OpenCabinetDoor-v1": ("partnet_mobility_cabinet",)}
"""What ManiSkill forgot to note that a task needs."""

URDF_NAMES = ("mobility_cvx.urdf", "mobility_fixed.urdf")
"""Of which ManiSkill takes the first that it finds."""

TAIL = 4096
"""Bytes at the end of a mesh in which its last line is looked for."""


class Asset(NamedTuple):
    """
    One download.

    :param source_id: ManiSkill's name of it
    :param folder: where it belongs
    :param problems: what is missing or damaged, empty if nothing is
    """

    source_id: str
    folder: Path
    problems: tuple[str, ...]


def assets_of(env_id: str) -> list[Asset]:
    """
    :param env_id: a task that ManiSkill knows
    :return: all that the task downloads, looked at just now
    """
    return [Asset(source_id, _folder(source_id), tuple(_examine(source_id))) for source_id in _source_ids(env_id)]


@functools.cache
def require_assets(env_id: str) -> None:
    """
    Look at the files of a task, once in a process where they are all right.

    :raises RuntimeError: if something is missing or damaged, with the command that fetches it
    """
    bad = [asset for asset in assets_of(env_id) if asset.problems]
    if bad:
        raise missing_assets(env_id, _summary(bad))


def missing_assets(env_id: str, what: str) -> RuntimeError:
    """
    :param env_id: the task
    :param what: what is wrong
    :return: the error that says so, with the cure
    """
    from mani_skill import ASSET_DIR

    return RuntimeError(
        f"{env_id} needs files that are not here or not complete: {what}. They belong into {ASSET_DIR} (the environment "
        f"variable MS_ASSET_DIR moves that). Get them with:\n    {_command(env_id)}"
    )


def report(env_ids: Sequence[str] = ()) -> Iterator[tuple[bool, str]]:
    """
    :param env_ids: tasks, by default those of the report
    :return: for each task whether it can be built, and lines for people
    :raises ValueError: for a task that does not exist
    """
    for env_id in _known(env_ids):
        assets = assets_of(env_id)
        bad = [asset for asset in assets if asset.problems]
        if bad:
            lines = [f"MISSING  {env_id:<22}{_summary(bad)}", f"where: {_place(bad)}", f"get it: {_command(env_id)}"]
            yield False, f"\n{'':<9}{'':<22}".join(lines)
        else:
            yield True, f"ready    {env_id:<22}{_place(assets) if assets else 'needs no files'}"


def download(env_ids: Sequence[str] = ()) -> Iterator[str]:
    """
    Fetch what is missing or damaged, and nothing else. Asks nothing.

    :param env_ids: tasks, by default those of the report
    :return: what is being done, for people
    :raises ValueError: for a task that does not exist
    :raises RuntimeError: if a download fails; nothing half-done stays, and what was there before is there again
    """
    from mani_skill.utils import download_asset
    from mani_skill.utils.assets import DATA_SOURCES

    for env_id in _known(env_ids):
        for asset in assets_of(env_id):
            if not asset.problems:
                continue
            source = DATA_SOURCES[asset.source_id]
            yield f"{env_id}: {asset.source_id} from {source.url or source.hf_repo_id} ({_how_checked(source)}) ..."
            try:
                with _replacing(asset.folder):
                    download_asset.download(source, verbose=False, non_interactive=True)
                    if problems := _examine(asset.source_id):
                        raise ValueError(f"what came is not complete: {problems[0]}")
            except Exception as error:  # network, disk, checksum, a damaged archive: all the same to the user
                raise RuntimeError(
                    f"{asset.source_id} could not be downloaded: {error}. On a machine without network, unpack "
                    f"{source.url or source.hf_repo_id} into {asset.folder} by hand."
                ) from error


def _how_checked(source: Any) -> str:
    """What is known of a download beside that all its files are there; ManiSkill compares the digest where it has one."""
    return "its SHA-256 is checked" if source.checksum else "UNCHECKED: ManiSkill knows no digest of it"


@contextlib.contextmanager
def _replacing(folder: Path) -> Iterator[None]:
    """
    The folder is out of the way meanwhile (ManiSkill would delete it first), gone afterwards, and back if anything fails: one
    file of thousands may be wanting. Of the failed attempt nothing stays, ManiSkill would take an empty folder for a success.
    """
    aside = folder.with_name(f"{folder.name}.before")
    if aside.exists():  # an attempt was killed, and `folder` is what it had of the new one
        _remove(folder)
    elif folder.exists():
        folder.rename(aside)
    try:
        yield
    except BaseException:  # Ctrl-C, too
        _remove(folder)
        if aside.exists():
            aside.rename(folder)
        raise
    _remove(aside)


def _remove(path: Path) -> None:
    if path.is_symlink() or path.is_file():
        path.unlink()
    else:
        shutil.rmtree(path, ignore_errors=True)


# ---------------------------------------------------------------------- which
def _known(env_ids: Sequence[str]) -> Sequence[str]:
    register_report_tasks()
    from mani_skill.utils.registration import REGISTERED_ENVS

    for env_id in env_ids:
        if env_id not in REGISTERED_ENVS:
            raise ValueError(f"Unknown task {env_id!r}. Those of the report: {', '.join(REPORT_TASKS)}.")
    return env_ids or REPORT_TASKS


def _source_ids(env_id: str) -> list[str]:
    from mani_skill.utils import assets
    from mani_skill.utils.registration import REGISTERED_ENVS

    found: list[str] = []
    for name in GROUPS.get(env_id) or REGISTERED_ENVS[env_id].asset_download_ids or ():
        group = name in assets.DATA_GROUPS
        found += sorted(assets.expand_data_group_into_individual_data_source_ids(name)) if group else [name]
    return found


def _folder(source_id: str) -> Path:
    from mani_skill.utils.assets import DATA_SOURCES

    source = DATA_SOURCES[source_id]
    return Path(source.output_dir) / source.target_path


def _command(env_id: str) -> str:
    return f"python -m sb3_cpm assets --download {env_id}"


def _summary(bad: list[Asset]) -> str:
    problems = [problem for asset in bad for problem in asset.problems]
    more = f" and {len(problems) - 2} more" if len(problems) > 2 else ""
    return "; ".join(problems[:2]) + more


def _place(assets: list[Asset]) -> str:
    folders = {asset.folder for asset in assets}
    return str(folders.pop()) if len(folders) == 1 else f"{len(folders)} folders in {assets[0].folder.parent}"


# ---------------------------------------------------------------------- whether
def _examine(source_id: str) -> list[str]:
    """:return: what is missing or damaged"""
    folder = _folder(source_id)
    if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
        return [f"{folder.name} is not there"]
    examine: dict[str, Callable[[Path], list[str]]] = {"ycb": _examine_ycb, "egad": _examine_egad}
    if source_id.startswith("partnet_mobility/"):
        return _examine_partnet(folder)
    return examine.get(source_id, lambda _: [])(folder)


def _examine_ycb(folder: Path) -> list[str]:
    def files(model_id: str) -> list[Path]:
        return [folder / "models" / model_id / name for name in ("collision.ply", "textured.obj")]

    return _examine_models(folder / "info_pick_v0.json", files)


def _examine_egad(folder: Path) -> list[str]:
    from sb3_cpm.envs.maniskill.tasks.pick_single_egad import MODELS, model_files

    return _examine_models(folder / MODELS, lambda model_id: list(model_files(folder, model_id)))


def _examine_models(index: Path, files: Callable[[str], list[Path]]) -> list[str]:
    try:
        models: Any = json.loads(index.read_text())
        wanted = [file for model_id in models for file in files(model_id)]
    except (OSError, ValueError, TypeError) as error:
        return [f"{index.name} in {index.parent.name} is missing or damaged ({type(error).__name__})"]
    return _absent(wanted) if models else [f"{index.name} lists no objects"]


def _examine_partnet(folder: Path) -> list[str]:
    urdf = next((folder / name for name in URDF_NAMES if (folder / name).exists()), None)
    if urdf is None:
        return [f"{folder.name}/{URDF_NAMES[0]} is missing"]
    try:
        tree = ElementTree.parse(urdf)
    except ElementTree.ParseError as error:
        return [f"{folder.name}/{urdf.name} is damaged ({error})"]
    return _absent([folder / mesh.attrib["filename"] for mesh in tree.iter("mesh") if "filename" in mesh.attrib])


def _absent(files: list[Path]) -> list[str]:
    absent = []
    for file in files:
        if not file.is_file():
            absent.append(f"{file.parent.name}/{file.name} is missing")
        elif file.stat().st_size == 0:
            absent.append(f"{file.parent.name}/{file.name} is empty")
        elif file.suffix == ".ply" and not _starts_with(file, b"ply"):
            absent.append(f"{file.parent.name}/{file.name} is damaged (no PLY)")  # SAPIEN would go on without the shape
        elif (file.suffix == ".ply" and not _is_whole_ply(file)) or (file.suffix == ".obj" and not _is_whole_obj(file)):
            absent.append(f"{file.parent.name}/{file.name} is damaged (it ends early)")
    return absent


def _starts_with(file: Path, start: bytes) -> bool:
    with open(file, "rb") as opened:
        return opened.read(len(start)) == start


def _is_whole_ply(file: Path) -> bool:
    """Whether it has as many lines as its header promises. A binary one is believed."""
    header, end, body = file.read_bytes().partition(b"end_header")
    if b"format ascii" not in header:
        return bool(end)
    promised = sum(int(number) for number in re.findall(rb"^element \S+ (\d+)", header, re.MULTILINE))
    return bool(end) and len(body.splitlines()) > promised  # the first is the rest of "end_header"


def _is_whole_obj(file: Path) -> bool:
    """
    Whether it ends like one: the last statement is no vertex, which would have no face, and no face with half a corner. Only
    the end is read. A missing line break says nothing, many programs write none; a cut within the last number is not seen.
    """
    with open(file, "rb") as opened:
        opened.seek(max(0, file.stat().st_size - TAIL))
        statements = [line.split(b"#")[0].split() for line in opened.read().splitlines()]
    keyword, *corners = next((words for words in reversed(statements) if words), [b""])
    if keyword == b"f":
        return len(corners) >= 3 and len({re.sub(rb"\d+", b"0", corner) for corner in corners}) == 1
    return keyword not in (b"v", b"vt", b"vn")
