"""
Light visuals: what a software renderer can draw fast.

On a CPU, ManiSkill's pictures are slow because of triangles, not pixels: the Panda's hand camera alone has 425,160 of
them, its links 135,000, the floor 20,000. Light visuals replace the robot's *visual* meshes by decimated ones with the same
colours and the floor by two triangles. Collision shapes, masses, joints and the floor's collision plane stay, so the
physics stay the same to the last bit. The pictures look alike but are not equal: train and evaluate with the same visuals.

Decimated robots are kept in the cache folder (:func:`sb3_cpm.envs.vulkan.cache_folder`); making one takes about two seconds.
"""

import contextlib
import hashlib
import importlib
import inspect
import shutil
import sys
import tempfile
import warnings
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from sb3_cpm.envs import vulkan
from sb3_cpm.envs.rendering import publish

VISUALS = ("auto", "light", "full")
FORMAT = 1
"""Part of the cache key: raise it when the generated files change."""

SHARE = 0.05
"""Share of the triangles that stays, within the two limits below; at 32 to 128 pixels nobody sees the others."""
FEWEST, MOST = 64, 1500
"""Triangles of one colour of one link."""

SMALL = 0.15
"""Metres; a part of at most this size may be drawn as its convex hull."""

FORMATS = (".glb", ".gltf", ".stl", ".obj", ".ply")
"""Mesh files that are decimated; others (Collada) stay as they are."""


class Visuals(contextlib.AbstractContextManager[None]):
    """
    Within this context ManiSkill builds scenes with light visuals; afterwards everything is as before. Enter it as often as a
    scene may be built: on ``gym.make`` and, since some tasks build a new scene for every episode, on ``reset``.

    :param urdf: the light robot, None to leave the robot as it is
    :param agent_class: ManiSkill's class of the robot
    :param light_ground: whether the floor is replaced
    """

    def __init__(self, urdf: Path | None = None, agent_class: Any = None, light_ground: bool = False):
        self.urdf = urdf
        self.agent_class = agent_class
        self.light_ground = light_ground
        self._undo = contextlib.ExitStack()

    def __enter__(self) -> None:
        if self.urdf is not None:
            # the class attribute, not a robot of our own: tasks place a robot by its name
            _swap(self._undo, self.agent_class, "urdf_path", str(self.urdf))
        if self.light_ground:
            original: Any = importlib.import_module("mani_skill.utils.building.ground").build_ground
            light = _light_ground(original)
            # modules hold the function under its name; a task of the user's own may do the same
            for module in list(sys.modules.values()):
                if getattr(module, "__dict__", {}).get("build_ground") is original:
                    _swap(self._undo, module, "build_ground", light)

    def __exit__(self, *exception: object) -> None:
        self._undo.close()


def choose_visuals(visuals: str, software: bool, robot: str | None) -> Visuals:
    """
    :param visuals: ``"light"``, ``"full"`` or ``"auto"``: light on a software renderer
    :param software: whether the renderer is one
    :param robot: ManiSkill's name of the robot, None if unknown (then only the floor is made light)
    :raises ValueError: for an unknown choice
    """
    if visuals not in VISUALS:
        raise ValueError(f"visuals must be one of {', '.join(VISUALS)}, got {visuals!r}.")
    if visuals == "full" or (visuals == "auto" and not software):
        return Visuals()
    from mani_skill import format_path
    from mani_skill.agents.registration import REGISTERED_AGENTS

    agent_class = REGISTERED_AGENTS[robot].agent_cls if robot in REGISTERED_AGENTS else None
    if agent_class is None or not agent_class.urdf_path:
        return Visuals(light_ground=True)  # robots described in MJCF are few and simple
    try:
        return Visuals(light_robot(Path(format_path(str(agent_class.urdf_path)))), agent_class, light_ground=True)
    except ImportError as error:
        if visuals == "light":
            raise RuntimeError(f"visuals='light' needs {error.name}: pip install trimesh fast-simplification") from error
        warnings.warn(f"Slow rendering, {error.name} is missing: pip install trimesh fast-simplification", stacklevel=2)
        return Visuals(light_ground=True)


# ---------------------------------------------------------------------- robot
def light_robot(urdf: Path) -> Path:
    """
    A copy of a robot description with decimated visual meshes.

    :param urdf: the robot as ManiSkill ships it
    :return: the light one, in the cache folder; made if it is not there yet
    """
    tree = ElementTree.parse(urdf)
    key = hashlib.sha256(f"{FORMAT} {SHARE} {FEWEST} {MOST} {SMALL} {urdf.resolve()}".encode() + urdf.read_bytes())
    for mesh in tree.iter("mesh"):
        path = urdf.parent / mesh.attrib["filename"]
        key.update(f"{path} {path.stat().st_size if path.exists() else None}".encode())
    target = vulkan.cache_folder() / f"robot-{urdf.stem}-{key.hexdigest()[:16]}"
    if not target.exists():
        with tempfile.TemporaryDirectory(dir=target.parent) as temporary:
            folder = Path(temporary, "robot")
            folder.mkdir()
            visual = {mesh for element in tree.iter("visual") for mesh in element.iter("mesh")}
            for mesh in list(tree.iter("mesh")):
                original = urdf.parent / mesh.attrib["filename"]
                # the folder moves to `target` when it is complete
                light = _light_mesh(original, folder) if mesh in visual else None
                mesh.set("filename", str(original.resolve() if light is None else target / light))
            tree.write(folder / urdf.name)
            # which links may touch each other is told by the file beside the robot: without it the physics change
            if urdf.with_suffix(".srdf").exists():
                shutil.copy(urdf.with_suffix(".srdf"), folder)
            publish(folder, target)
    return target / urdf.name


def _light_mesh(original: Path, folder: Path) -> str | None:
    """:return: name of the decimated file within ``folder``, None to use the original"""
    if original.suffix.lower() not in FORMATS or not original.exists():
        return None
    import fast_simplification  # noqa: F401  (trimesh needs it, and says so too late)
    import trimesh

    name = f"{hashlib.sha256(str(original).encode()).hexdigest()[:8]}-{original.name}"
    if (folder / name).exists():
        return name
    loaded = trimesh.load(original)
    try:
        if isinstance(loaded, trimesh.Scene):
            for key, part in loaded.geometry.items():
                loaded.geometry[key] = _decimate(part)
        else:
            loaded = _decimate(loaded)
        loaded.export(folder / name)
    except (ValueError, AttributeError):  # points, lines, an empty mesh
        return None
    return name


def _decimate(mesh: Any) -> Any:
    """Fewer triangles, the same material. A textured mesh stays: its texture coordinates would be lost."""
    import trimesh

    wanted = int(min(MOST, max(FEWEST, SHARE * len(mesh.faces))))
    material = getattr(mesh.visual, "material", None)
    if len(mesh.faces) <= wanted or getattr(mesh.visual, "uv", None) is not None:
        return mesh
    welded = mesh.copy()
    welded.merge_vertices(merge_tex=True, merge_norm=True)  # a vertex per face corner cannot be decimated
    light = welded.simplify_quadric_decimation(face_count=wanted)
    if len(light.faces) > 2 * wanted and max(mesh.extents) < SMALL:
        light = welded.convex_hull  # a hand camera's screws and lenses: a thousand separate parts resist decimation
    if material is not None:
        light.visual = trimesh.visual.TextureVisuals(material=material)
    return light


# ---------------------------------------------------------------------- floor
def _light_ground(original: Callable[..., Any]) -> Callable[..., Any]:
    """
    ManiSkill's floor of one-metre squares as one quad with the same texture, above the same collision plane.

    :param original: ManiSkill's function, whose signature the replacement has
    """
    signature = inspect.signature(original)

    def build_ground(*args: Any, **kwargs: Any) -> Any:
        call = signature.bind(*args, **kwargs)
        call.apply_defaults()
        options = call.arguments
        scene, width = options["scene"], options["floor_width"]
        length = options["floor_length"] or width
        actor = _plane(scene, options["name"], options["altitude"], options["add_collision"])
        if scene.can_render():
            corners = np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]]) / 2 * [width, length]
            texture = (options["texture_file"], options["mipmap_levels"])
            shape = _quad(corners, options["xy_origin"], options["altitude"], texture, options["texture_square_len"])
            _attach(actor, shape)
        return actor

    return build_ground


def _plane(scene: Any, name: str, altitude: float, add_collision: bool) -> Any:
    """The static actor of the floor, nothing to see yet."""
    import sapien

    builder = scene.create_actor_builder()
    if add_collision:
        # PhysX's planes face along x: turned to face up
        builder.add_plane_collision(sapien.Pose([0, 0, altitude], [0.7071068, 0, -0.7071068, 0]))
    builder.initial_pose = sapien.Pose()
    if scene.parallel_in_single_scene:
        builder.set_scene_idxs([0])  # all environments in one picture share one floor
    return builder.build_static(name=name)


def _quad(corners: np.ndarray, origin: tuple[float, float], altitude: float, texture: tuple[str, int], square: float) -> Any:
    """
    :param corners: metres around the origin, shape ``(4, 2)``
    :param texture: file name and number of mipmap levels
    :param square: metres that the texture covers before it repeats
    """
    import sapien

    material = sapien.render.RenderMaterial()
    material.base_color_texture = sapien.render.RenderTexture2D(filename=texture[0], mipmap_levels=texture[1])
    vertices = np.concatenate([corners + origin, np.full((4, 1), altitude)], axis=1)
    return sapien.render.RenderShapeTriangleMesh(
        vertices=vertices.astype(np.float32),
        triangles=np.array([[0, 3, 1], [0, 2, 3]], dtype=np.uint32),
        normals=np.array([[0, 0, 1]] * 4, dtype=np.float32),
        uvs=(corners / square + 0.5).astype(np.float32),
        material=material,
    )


def _attach(actor: Any, shape: Any) -> None:
    import sapien

    for entity in actor._objs:
        component = sapien.render.RenderBodyComponent()
        component.attach(shape)
        entity.add_component(component)


def _swap(undo: contextlib.ExitStack, owner: Any, name: str, value: Any) -> None:
    previous = vars(owner).get(name, _swap)  # a class may only inherit the attribute
    setattr(owner, name, value)
    undo.callback(delattr, owner, name) if previous is _swap else undo.callback(setattr, owner, name, previous)
