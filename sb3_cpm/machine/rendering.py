"""
A renderer on any machine: finding out whether SAPIEN can really render here, curing it if not, and choosing the renderer
when an environment is made.

SAPIEN draws with Vulkan. Whether that works cannot be asked politely: without a driver SAPIEN raises, with an odd driver the
process dies. So :func:`probe_renderer` tries it in a child process, :func:`setup_rendering` installs software Vulkan where the
probe fails (:mod:`sb3_cpm.machine.vulkan_install`), and :func:`ensure_renderer` is the fast part, which every environment goes
through.
"""

import contextlib
import functools
import importlib
import importlib.util
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from sb3_cpm.extras import check_installed, install_command
from sb3_cpm.machine import vulkan, vulkan_install
from sb3_cpm.machine.thread_affinity import renderer_threads

SOFTWARE = ("llvmpipe", "swiftshader")
"""Parts of the device names of renderers that run on the CPU."""

BRDF_DECLARATION = re.compile(r"^.*uniform sampler2D samplerBRDFLUT;\s*$", re.MULTILINE)
BRDF_LOOKUP = "texture(samplerBRDFLUT, vec2(roughness, dotNV)).xy"


class Renderer(NamedTuple):
    """
    A renderer that works.

    :param backend: what ManiSkill calls it: ``"gpu"`` or ``"cpu"``, ``"none"`` for :func:`without_renderer`
    :param name: name of the Vulkan device
    :param software: whether the CPU draws, which makes triangles dear
    """

    backend: str
    name: str
    software: bool


class Probe(NamedTuple):
    """
    What came of a trial in a child process.

    :param renderer: None if it failed
    :param driver: the Vulkan driver's version, empty if it failed or Vulkan would not tell
    :param problem: why it failed, in one paragraph; empty if it did not
    :param seconds: how long it took
    """

    renderer: Renderer | None
    driver: str
    problem: str
    seconds: float


_renderer: Renderer | None = None


def ensure_renderer() -> Renderer:
    """
    Choose this process's renderer: a real GPU if it is usable, else the CPU's. Cheap after the first call, and the first
    costs little more than the import of SAPIEN.

    :raises ValueError: if ManiSkill is not installed
    :raises RuntimeError: if this machine cannot render, with the cure
    """
    global _renderer
    if _renderer is None:
        check_installed("ManiSkill's tasks", ("sapien", "mani_skill"), "maniskill")
        vulkan.activate_private()
        # A worker thread pool for pictures of 32x32 costs more than it brings, all the more with several environments.
        os.environ.setdefault("LP_NUM_THREADS", "0")
        try:
            _renderer, _ = _open_renderer()
        except RuntimeError as error:
            raise RuntimeError(f"{error}. {cure()}") from error
        if _renderer.software:
            use_fast_shaders()
    return _renderer


@contextlib.contextmanager
def opened(renderer: Renderer) -> Iterator[None]:
    """
    Build scenes within this context: their renderer's thread is known then, and stays near
    (:mod:`sb3_cpm.machine.thread_affinity`).

    :param renderer: this process's
    """
    # a renderer that was told to share its work among several threads needs several cores
    if not renderer.software or os.environ.get("LP_NUM_THREADS") != "0":
        yield
        return
    import sapien

    with renderer_threads():
        system = sapien.render.RenderSystem(sapien.Device("cpu"))
    yield  # all of a process's scenes share one Vulkan device, which lives as long as one of them does
    del system


class _NoMaterial:
    """Stands in for SAPIEN's material of something that nobody will draw: takes any argument and any attribute."""

    def __init__(self, *args: Any, **attributes: Any) -> None:
        vars(self).update(attributes)


def without_renderer() -> Renderer:
    """
    Let this process build scenes without a Vulkan device, for observations without pictures.

    Even then ManiSkill describes materials, and SAPIEN's material needs a device. From here on, in this process, materials are
    of a class of ours that needs none; the physics never look at them. Only call this where :func:`ensure_renderer` failed.

    :return: a renderer that draws nothing
    """
    import sapien

    importlib.import_module("mani_skill.envs")  # whose modules hold these classes by name
    _say_that_nothing_is_drawn()
    for name in ("RenderMaterial", "RenderTexture2D"):
        original = getattr(sapien.render, name)
        for module in list(sys.modules.values()):
            if getattr(module, "__dict__", {}).get(name) is original:
                setattr(module, name, _NoMaterial)
    return Renderer("none", "", software=False)


@functools.cache
def _say_that_nothing_is_drawn() -> None:
    warnings.warn(f"No renderer: states are simulated as ever, env.render() gives None. {cure()}.", stacklevel=5)


def cure() -> str:
    """:return: what to do where SAPIEN does not render"""
    if named := vulkan.named_drivers():
        return f"The environment names a Vulkan driver that does not work: unset {named}"
    return "Run `python -m sb3_cpm setup-rendering` once: it installs software Vulkan, with or without root"


def _open_renderer() -> tuple[Renderer, Any]:
    """:return: the renderer and SAPIEN's render system, which fixes the process's Vulkan device"""
    try:
        with warnings.catch_warnings():
            # it means the system's loader, which a private installation does without
            warnings.filterwarnings("ignore", "Failed to find system libvulkan", UserWarning)
            import sapien
    except ImportError as error:  # a shared library is missing
        raise RuntimeError(f"SAPIEN cannot be imported: {error}") from error
    try:
        devices = device_names(sapien.render.get_device_summary())
    except RuntimeError as error:
        raise RuntimeError(f"No usable Vulkan driver on this machine (SAPIEN says: {error})") from error
    problem: Exception | None = None
    for backend, device in (("gpu", "cuda"), ("cpu", "cpu")):
        names = [name for name, is_cuda in devices if is_cuda == (backend == "gpu")]
        if not names:
            continue
        try:
            system = sapien.render.RenderSystem(sapien.Device(device))
        except RuntimeError as error:
            problem = error
            continue
        software = backend == "cpu" and any(word in name.lower() for name in names for word in SOFTWARE)
        return Renderer(backend, names[0], software), system
    raise RuntimeError(f"SAPIEN can use none of {[name for name, _ in devices]} (it says: {problem})")


def device_names(summary: str) -> list[tuple[str, bool]]:
    """
    :param summary: SAPIEN's list of Vulkan devices
    :return: name and whether it is a CUDA device, of all devices that SAPIEN supports
    """
    devices = []
    for block in re.split(r"^GPU: ", summary, flags=re.MULTILINE)[1:]:
        if re.search(r"Supported:\s*1", block):
            cuda = re.search(r"cudaId:\s*(-?\d+)", block)
            devices.append((block.splitlines()[0].strip(), cuda is not None and int(cuda[1]) >= 0))
    return devices


# ---------------------------------------------------------------------- shaders
def use_fast_shaders() -> bool:
    """
    Make SAPIEN use a copy of its shaders that never reads the lookup table for reflections of an environment map.

    SAPIEN computes that table before the first picture in every process, which takes a software renderer 15 CPU seconds.
    With the lookup replaced by zero the pictures are the same to the last bit, since no scene of ManiSkill's robot tasks has
    an environment map (ReplicaCAD's rooms do). The function that sets the folder is private to SAPIEN: where anything is
    not as expected, SAPIEN's own shaders stay, and the first picture takes its time.

    :return: whether the copy is in use
    """
    try:
        import sapien

        folder = _shader_copy(Path(sapien.__file__).parent / "vulkan_shader", sapien.__version__)
        if folder is not None:
            sapien.pysapien.render._internal_set_shader_search_path(str(folder))
        return folder is not None
    except (AttributeError, OSError, TypeError):
        return False


def _shader_copy(original: Path, version: str) -> Path | None:
    target = vulkan.cache_folder() / f"shaders-{version}"
    if target.exists():
        return target
    with tempfile.TemporaryDirectory(dir=target.parent) as temporary:
        copy = Path(temporary, "shaders")
        shutil.copytree(original, copy)
        for path in [p for pack in ("minimal", "default") for p in (copy / pack).iterdir()]:
            text = path.read_text()
            text = BRDF_DECLARATION.sub("", text).replace(BRDF_LOOKUP, "vec2(0)")
            if "samplerBRDFLUT" in text:
                return None  # this version uses the table in a way that we do not know
            path.write_text(text)
        publish(copy, target)
    return target


def publish(folder: Path, target: Path) -> None:
    """Move a finished folder to its place in one step; if another process was faster, its equal result stays."""
    try:
        os.rename(folder, target)
    except OSError:
        if not target.exists():
            raise


# ---------------------------------------------------------------------- trying it
def probe_renderer(use_private: bool = True, timeout: float = 180.0) -> Probe:
    """
    Draw one picture in a child process and look at it.

    :param use_private: whether a private software driver may be used
    :param timeout: seconds until a hanging child is given up
    """
    start = time.perf_counter()
    code = f"from sb3_cpm.machine.rendering import _probe; _probe({use_private!r})"
    # not the whole sys.path: a library that failed to import may have left its own folder there
    package = str(Path(__file__).parents[2])
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, [package, os.environ.get("PYTHONPATH")]))}
    if not use_private:
        # an activated private driver is in our own environment, from where the child would inherit it
        environment = {k: v for k, v in environment.items() if v != str(vulkan.private_folder() / "icd.json")}
    try:
        child = subprocess.run(
            [sys.executable, "-c", code],
            env=environment,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=timeout,
        )
    except subprocess.TimeoutExpired as error:
        stage = _stage(error.stdout.decode(errors="replace") if isinstance(error.stdout, bytes) else error.stdout or "")
        return Probe(None, "", f"The trial hung for {timeout:g} s while it tried to {stage}.", timeout)
    seconds = time.perf_counter() - start
    if child.returncode < 0:
        name = signal.Signals(-child.returncode).name
        return Probe(None, "", f"The trial process died of {name} while it tried to {_stage(child.stdout)}.", seconds)
    result = [line for line in child.stdout.splitlines() if line.startswith("{")]
    if child.returncode != 0 or not result:
        last = (child.stderr.strip().splitlines() or ["no message"])[-1]
        return Probe(None, "", f"{last} (while it tried to {_stage(child.stdout)})", seconds)
    fields = json.loads(result[-1])
    return Probe(Renderer(**fields["renderer"]), fields["driver"], "", seconds)


def _stage(output: str) -> str:
    stages = [line[1:] for line in output.splitlines() if line.startswith(">")]
    return stages[-1] if stages else "start"


def _probe(use_private: bool) -> None:
    """In the child: say what comes next before each step, since any of them may be the last."""

    def stage(text: str) -> None:
        print(f">{text}", flush=True)

    if use_private:
        stage("load the private Vulkan driver")
        vulkan.activate_private()
    os.environ.setdefault("LP_NUM_THREADS", "0")
    stage("import SAPIEN and open a Vulkan device")
    renderer, system = _open_renderer()
    if renderer.software:
        use_fast_shaders()
    stage("draw a picture")
    import sapien

    sapien.render.set_camera_shader_dir("default")
    scene = sapien.Scene([sapien.physx.PhysxCpuSystem(), system])
    scene.set_ambient_light([1, 1, 1])
    builder = scene.create_actor_builder()
    builder.add_box_visual(half_size=[0.1, 0.1, 0.1], material=[1.0, 0.0, 0.0])
    builder.initial_pose = sapien.Pose([1, 0, 0])
    builder.build_static()
    camera = scene.add_camera("probe", width=17, height=17, fovy=1.0, near=0.01, far=10)
    scene.update_render()
    camera.take_picture()
    red, green, blue = (float(value) for value in camera.get_picture("Color")[8, 8, :3])
    if not (red > 0.1 and green < red / 2 and blue < red / 2):
        raise RuntimeError(f"The picture is wrong: a red box came out as RGB ({red:.2f}, {green:.2f}, {blue:.2f})")
    stage("ask for the driver's version")
    print(json.dumps({"renderer": renderer._asdict(), "driver": _driver_version(renderer.name)}), flush=True)


def _driver_version(device: str) -> str:
    import sapien

    for loader in ("libvulkan.so.1", *map(str, Path(sapien.__file__).parent.glob("vulkan_library/libvulkan.so*"))):
        with contextlib.suppress(OSError, AttributeError):
            return vulkan.driver_versions(loader).get(device, "")
    return ""


# ---------------------------------------------------------------------- curing it
def setup_rendering(private: bool = False, system: bool = False) -> int:
    """
    Make this machine able to render and say what is being done. Does nothing if it is able already. Asks nothing.

    What is missing is installed into the user's cache folder, also for root: the system stays as it is.

    :param private: do so even where the machine's own driver works
    :param system: install it for the whole machine instead, which needs root: packages with apt, and on Debian 12 a new file
        in ``/etc/apt/sources.list.d`` with Debian's backports suite
    :return: exit status, 0 if SAPIEN renders in the end
    :raises ValueError: if both are asked for, or the second without being root
    """
    if private and system:
        raise ValueError("Install privately or for the system: leave one of --private and --system out.")
    if system and os.geteuid() != 0:
        raise ValueError("Installing for the whole machine needs root: run it as root, or leave --system out.")
    print("Rendering: trying this machine's own Vulkan driver ...", flush=True)
    probe = probe_renderer(use_private=False)
    if probe.renderer is not None and not private:
        return _report(probe)
    print(f"  {probe.problem or 'it works, but a private one is wanted'}")
    if vulkan.private_folder().exists():
        print(f"Rendering: trying the software Vulkan in {vulkan.private_folder()} ...", flush=True)
        probe = probe_renderer()
        if probe.renderer is not None:
            return _report(probe)
        print(f"  {probe.problem}")
    if importlib.util.find_spec("sapien") is None:
        print(f"Rendering: FAILED. SAPIEN is not installed. Cure: {install_command('maniskill')}")
        return 1
    if vulkan.named_drivers():
        print(f"Rendering: FAILED. Cure: {cure()}.")
        return 1
    if not sys.platform.startswith("linux"):
        print("Rendering: FAILED. Software Vulkan can be installed automatically on Linux only; install a graphics driver.")
        return 1
    try:
        if system:
            print("Rendering: installing Mesa's software Vulkan (lavapipe) for the whole machine ...", flush=True)
            vulkan_install.install_system(print)
        else:
            print(f"Rendering: installing Mesa's software Vulkan (lavapipe) into {vulkan.private_folder()} ...", flush=True)
            vulkan_install.install_private(print)
    except (RuntimeError, OSError) as error:
        print(f"Rendering: FAILED. {error}")
        print("Cure: see to the above (network? package sources? free space: 400 MB), then run this again.")
        return 1
    print("Rendering: trying again ...", flush=True)
    return _report(probe_renderer())


def _report(probe: Probe) -> int:
    if probe.renderer is None:
        print(f"Rendering: FAILED. {probe.problem}")
        print("Cure: run `python -m sb3_cpm doctor` and send its output with your bug report.")
        return 1
    kind = "in software" if probe.renderer.software else "with the graphics card"
    print(f"Rendering: SAPIEN renders {kind}: {probe.renderer.name}, driver {probe.driver} ({probe.seconds:.1f} s).")
    return 0
