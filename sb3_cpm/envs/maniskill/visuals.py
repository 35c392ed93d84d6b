"""
Light visuals: what a software renderer can draw fast.

On a CPU, ManiSkill's pictures are slow because of triangles, not pixels: the Panda's hand camera alone has 425,160 of
them, its links 135,000, the floor 20,000. Light visuals draw coarser meshes of the same colours
(:mod:`sb3_cpm.envs.maniskill.meshes`), of the robot as of everything else that comes from a file, and a floor of two
triangles. Collision shapes, masses, joints and the floor's collision plane are untouched, so the physics stay the same to the
last bit. The pictures look alike but are not equal: train and evaluate with the same visuals.
"""

import contextlib
import importlib
import importlib.util
import inspect
import sys
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from sb3_cpm.envs.maniskill.meshes import light_shapes
from sb3_cpm.extras import install_command

VISUALS = ("auto", "light", "full")

PACKAGES = ("trimesh", "fast_simplification")
"""What making light meshes takes."""

MEASURED = "handle"
"""Part of the names of shapes that stay: the cabinet tasks measure where a handle is by what it looks like."""


class Visuals(contextlib.AbstractContextManager[None]):
    """
    Within this context ManiSkill builds scenes with light visuals; afterwards everything is as before. Enter it as often as a
    scene may be built: on ``gym.make`` and, since some tasks build a new scene for every episode, on ``reset``.

    :param light: False for a context that does nothing
    :param meshes: False to make only the floor light
    """

    def __init__(self, light: bool = False, meshes: bool = True):
        self.light = light
        self.meshes = meshes
        self._undo = contextlib.ExitStack()

    def __enter__(self) -> None:
        if not self.light:
            return
        if self.meshes:
            builder: Any = importlib.import_module("sapien.wrapper.actor_builder").ActorBuilder
            _swap(self._undo, builder, "build_render_component", _light_component(builder.build_render_component))
        original: Any = importlib.import_module("mani_skill.utils.building.ground").build_ground
        light = _light_ground(original)
        # modules hold the function under its name; a task of the user's own may do the same
        for module in list(sys.modules.values()):
            if getattr(module, "__dict__", {}).get("build_ground") is original:
                _swap(self._undo, module, "build_ground", light)

    def __exit__(self, *exception: object) -> None:
        self._undo.close()


def choose_visuals(visuals: str, software: bool) -> Visuals:
    """
    :param visuals: ``"light"``, ``"full"`` or ``"auto"``: light on a software renderer
    :param software: whether the renderer is one
    :raises ValueError: for an unknown choice
    :raises RuntimeError: for ``"light"`` without the packages that it takes
    """
    if visuals not in VISUALS:
        raise ValueError(f"visuals must be one of {', '.join(VISUALS)}, got {visuals!r}.")
    if visuals == "full" or (visuals == "auto" and not software):
        return Visuals()
    missing = [package for package in PACKAGES if importlib.util.find_spec(package) is None]
    if missing and visuals == "light":
        raise RuntimeError(f"visuals='light' needs {missing[0]}: {install_command('maniskill')}")
    if missing:
        warnings.warn(f"Slow rendering, {missing[0]} is missing: {install_command('maniskill')}", stacklevel=2)
    return Visuals(light=True, meshes=not missing)


# ---------------------------------------------------------------------- meshes
def _light_component(original: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """
    :param original: SAPIEN's method that makes what is drawn of a body, from the builder's list of shapes
    """

    def build_render_component(builder: Any) -> Any:
        shapes: list[Any] = []
        rest = []
        for record in builder.visual_records:
            light = light_shapes(record) if record.type == "file" and _may_change(record) else []
            shapes += light
            rest += [] if light else [record]
        records, builder.visual_records = builder.visual_records, rest
        try:
            component = original(builder)
        finally:
            builder.visual_records = records
        for shape in shapes:
            component.attach(shape)
        return component

    return build_render_component


def _may_change(record: Any) -> bool:
    # a material with a texture of its own needs the original's texture coordinates
    textured = record.material is not None and record.material.base_color_texture is not None
    return MEASURED not in record.name and not textured


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
