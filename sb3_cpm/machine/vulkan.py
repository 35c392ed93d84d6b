"""
Using software Vulkan (Mesa's lavapipe) that lies in a private folder, from within a running Python process, and asking Vulkan
for its drivers. How it gets there is told in :mod:`sb3_cpm.machine.vulkan_install`, who uses it in
:mod:`sb3_cpm.machine.rendering`.
"""

import ctypes
import os
import stat
import struct
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

DRIVER_VARIABLES = ("VK_DRIVER_FILES", "VK_ICD_FILENAMES")
"""With these the user, or we, tell Vulkan's loader which drivers exist (new name, old name)."""


def cache_folder() -> Path:
    """
    Native libraries are loaded from there, so nobody else may have put them there: it belongs to this user or to root, and
    others cannot write to it. A new one is made with mode 0700.

    :return: where everything generated is kept: ``$SB3_CPM_CACHE``, else the user's cache folder, else (home not
        writable) a folder of this user under the system's temporary folder. Exists.
    :raises RuntimeError: if there is no such folder, or ``$SB3_CPM_CACHE`` is one that others could have filled
    """
    named = os.environ.get("SB3_CPM_CACHE")
    candidates = [
        named,
        os.path.join(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"), "sb3_cpm"),
        os.path.join(tempfile.gettempdir(), f"sb3_cpm-{os.geteuid()}"),
    ]
    problems = []
    for candidate in filter(None, candidates):
        folder = Path(candidate)
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            _tighten(folder)
            problem = distrust(folder)
        except OSError as error:
            problems.append(f"{folder}: {error.strerror}")
            continue
        if problem is not None and candidate == named:
            raise RuntimeError(f"SB3_CPM_CACHE: {problem}, and native libraries are loaded from there. {_CURE}")
        if problem is None and os.access(folder, os.W_OK):
            return folder
        problems.append(problem or f"{folder} cannot be written")
    raise RuntimeError(f"There is no folder to keep libraries in: {'; '.join(problems)}. {_CURE}")


_CURE = "Set SB3_CPM_CACHE to a folder of your own that only you can write to (chmod 700)."


def _tighten(path: Path) -> None:
    """What is ours and our group could write to, as a umask of 002 makes it, is for us alone to write from here on."""
    status = path.lstat()
    if not stat.S_ISLNK(status.st_mode) and status.st_uid == os.geteuid() and status.st_mode & 0o022 == 0o020:
        path.chmod(stat.S_IMODE(status.st_mode) & ~0o020)


def distrust(path: Path) -> str | None:
    """
    :param path: of a file or folder
    :return: who else could have put there what it holds; None if nobody but this user and root
    """
    for status in (path.lstat(), path.stat()):  # a symbolic link and what it leads to
        if status.st_uid not in (os.geteuid(), 0):
            return f"{path} belongs to another user (number {status.st_uid})"
    if status.st_mode & 0o022:
        return f"{path} can be written by others (mode {stat.S_IMODE(status.st_mode):o})"
    return None


def private_folder() -> Path:
    """:return: where a private installation lies, if there is one"""
    return cache_folder() / "vulkan"


def named_drivers() -> str:
    """:return: the variables with which the user (not we) named Vulkan drivers, as ``NAME=value``, empty if there are none"""
    ours = str(private_folder() / "icd.json")
    return " ".join(f"{name}={os.environ[name]}" for name in DRIVER_VARIABLES if (os.environ.get(name) or ours) != ours)


def private_in_use() -> bool:
    """:return: whether there is a private installation and the user named no other driver"""
    return (private_folder() / "icd.json").exists() and not named_drivers()


def activate_private() -> bool:
    """
    Let this process use the private installation, if there is one and the user named no driver.

    Vulkan's loader finds the driver by environment variable, but the driver's own libraries would need ``LD_LIBRARY_PATH``,
    which a running process cannot change. So they are loaded beforehand: the dynamic linker takes a library that is already
    there by its name. Order is found by trying, since each needs some of the others. Local symbols only: with global ones the
    process crashes.

    :return: whether a private installation is in use
    :raises RuntimeError: if somebody else could have put anything there
    """
    if not private_in_use():
        return False
    icd = private_folder() / "icd.json"
    waiting = sorted(_libraries(private_folder() / "root"))
    for path in (private_folder(), icd, *waiting):
        _tighten(path)
        problem = distrust(path)
        if problem is not None:
            raise RuntimeError(
                f"{problem}, so it is not loaded. Remove {private_folder()} and run `python -m sb3_cpm setup-rendering` again."
            )
    while waiting:
        failed = [path for path in waiting if not _loads(path)]
        if len(failed) == len(waiting):
            break  # what is left belongs to parts of Mesa that a display would need
        waiting = failed
    for name in DRIVER_VARIABLES:
        os.environ[name] = str(icd)  # inherited by worker processes, which come through here again
    return True


def forget_failed_opencv() -> None:
    """
    Stable-Baselines3 tries to import OpenCV and lives without it. Where OpenCV's system libraries are missing, the attempt
    leaves OpenCV's own folder on ``sys.path``, whose ``typing`` hides Python's, so that no worker process starts; and a
    mark that forbids another attempt, which would succeed with the private libraries.
    """
    if "cv2" not in sys.modules:
        vars(sys).pop("OpenCV_LOADER", None)
        sys.path[:] = [folder for folder in sys.path if os.path.basename(folder) != "cv2"]


def _libraries(root: Path) -> Iterator[Path]:
    for folder in ("lib", "usr/lib"):
        for path in (root / folder).glob("*-linux-gnu*/*.so*"):
            # other graphics drivers are many megabytes each
            if path.is_file() and (not path.name.startswith("libvulkan_") or "lvp" in path.name):
                yield path


def _loads(path: Path) -> bool:
    try:
        ctypes.CDLL(str(path))
    except OSError:
        return False
    return True


def driver_versions(loader: str) -> dict[str, str]:
    """
    Ask Vulkan itself, which SAPIEN does not pass on: the version tells a Mesa that is too old from one that is broken.

    The structures are those of Vulkan's header ``vulkan_core.h``, written out as bytes ("q" and "Q" also align pointers).

    :param loader: name or path of Vulkan's loader, ``libvulkan.so.1``
    :return: device name to what the driver says of itself, e.g. ``"Mesa 25.0.7 (LLVM 15.0.6)"``
    :raises OSError: if there is no such loader
    :raises AttributeError: if it is older than Vulkan 1.1
    """
    library = ctypes.CDLL(loader)
    # VkApplicationInfo (structure type 0): nothing but the version of Vulkan that is wanted, 1.2
    application = ctypes.create_string_buffer(struct.pack("qQQqQiI", 0, 0, 0, 0, 0, 0, 1 << 22 | 2 << 12))
    # VkInstanceCreateInfo (1): no layers, no extensions
    create_info = struct.pack("qQqQqQqQ", 1, 0, 0, ctypes.addressof(application), 0, 0, 0, 0)
    instance = ctypes.c_void_p()
    if library.vkCreateInstance(create_info, None, ctypes.byref(instance)) != 0:
        return {}
    count, devices = ctypes.c_uint32(16), (ctypes.c_void_p * 16)()
    library.vkEnumeratePhysicalDevices(instance, ctypes.byref(count), devices)
    found = {}
    for device in devices[: count.value]:
        # VkPhysicalDeviceDriverProperties (1000196000): id (4 bytes), driver's name (256), its information (256), ...
        driver = ctypes.create_string_buffer(struct.pack("qQ", 1000196000, 0), 1024)
        # VkPhysicalDeviceProperties2 (1000059001): five numbers of 4 bytes, device's name (256), limits ...
        properties = ctypes.create_string_buffer(struct.pack("qQ", 1000059001, ctypes.addressof(driver)), 4096)
        library.vkGetPhysicalDeviceProperties2(ctypes.c_void_p(device), properties)
        name, information = (
            raw.split(b"\0")[0].decode(errors="replace") for raw in (properties.raw[36:292], driver.raw[276:532])
        )
        found[name] = information
    library.vkDestroyInstance(instance, None)
    return found
