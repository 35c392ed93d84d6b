"""
A mesh for people turned into one for a software renderer: the same shape and colours with a few of its triangles.

The original is read by SAPIEN itself, so any file that can be drawn can be made light (glTF, Collada, STL, OBJ, with textures
or without), and what comes out is what SAPIEN would have drawn, only coarser. It is made once and kept in the cache folder
(:func:`sb3_cpm.machine.vulkan.cache_folder`).
"""

import contextlib
import functools
import hashlib
import zipfile
import zlib
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from sb3_cpm.files import NotWrittenError, replacing
from sb3_cpm.machine import vulkan

FORMAT = 1
"""Part of the cache's key: raise it when the result changes."""

KEEP = 600
"""Files with at most so many triangles stay as they are, textures and all."""

SHARE = 0.03
"""Share of the triangles that stays, within the next two limits; at 32 to 128 pixels nobody sees the others."""
FEWEST, MOST = 300, 1000
"""Triangles of one part."""

SMALL = 0.15
"""Metres; a part of at most this size may be drawn as its convex hull."""

SMOOTH = 0.5
"""Cosine of the angle (60 degrees) up to which neighbouring triangles look like one surface."""

SAMPLES = 40_000
"""Points of the original's surface, from which the colours of a textured mesh are taken."""


class Part(NamedTuple):
    """
    Triangles of one material. F is their number.

    :param vertices: metres, shape ``(F, 3, 3)``: three corners of each triangle
    :param normals: at the corners, shape ``(F, 3, 3)``
    :param colors: of the triangles if the original had a texture, shape ``(F, 4)``, uint8, else ``(0, 4)``
    :param material: red, green, blue, alpha; metallic, roughness, specular; emission's red, green, blue, alpha;
        shape ``(11,)``
    """

    vertices: np.ndarray
    normals: np.ndarray
    colors: np.ndarray
    material: np.ndarray


@functools.lru_cache(maxsize=512)
def light_parts(filename: str) -> tuple[Part, ...]:
    """
    :param filename: a mesh that SAPIEN can draw
    :return: its light version, empty where the original should stay
    :raises ImportError: if a light version has to be made and a package for that is missing
    """
    file = Path(filename)
    status = file.stat()
    limits = (FORMAT, KEEP, SHARE, FEWEST, MOST, SMALL, SMOOTH, SAMPLES)
    key = hashlib.sha256(f"{limits} {file.resolve()} {status.st_size} {status.st_mtime_ns}".encode()).hexdigest()
    cached = vulkan.cache_folder() / "meshes" / f"{file.stem}-{key[:16]}.npz"
    # not there yet, or damaged in whatever way: made again
    with contextlib.suppress(OSError, EOFError, ValueError, KeyError, zipfile.BadZipFile, zlib.error):
        return _load(cached)
    parts = _make(filename)
    _save(cached, parts)
    return parts


def _load(cached: Path) -> tuple[Part, ...]:
    with open(cached, "rb") as file, np.load(file) as arrays:
        return tuple(Part(*(arrays[f"{name}{i}"] for name in Part._fields)) for i in range(int(arrays["n"])))


def _save(cached: Path, parts: tuple[Part, ...]) -> None:
    """In one step: several processes may make the same mesh at once. Where the disk is full it is made again next time."""
    arrays = {f"{name}{i}": value for i, part in enumerate(parts) for name, value in part._asdict().items()}
    with contextlib.suppress(NotWrittenError), replacing(cached) as temporary:
        np.savez_compressed(temporary, n=np.array(len(parts)), **arrays)


# ---------------------------------------------------------------------- making
def _make(filename: str) -> tuple[Part, ...]:
    import sapien

    original = sapien.render.RenderShapeTriangleMesh(filename, [1.0, 1.0, 1.0], None)
    if sum(len(part.triangles) for part in original.parts) <= KEEP:
        return ()
    return tuple(_light_part(part) for part in original.parts if len(part.triangles) > 0)


def _light_part(part: Any) -> Part:
    """:param part: SAPIEN's triangles of one material"""
    import trimesh

    # merged: a vertex per corner of a triangle, as files have it, cannot be decimated
    full = trimesh.Trimesh(part.vertices, part.triangles, process=True)
    light = _decimate(full)
    light.update_faces(light.nondegenerate_faces())
    corners = light.vertices[light.faces].astype(np.float32)
    colors = np.zeros((0, 4), dtype=np.uint8)
    if part.material.base_color_texture is not None:
        colors = _face_colors(corners, part)
    of = part.material
    material = [*of.base_color, of.metallic, of.roughness, of.specular, *of.emission]
    return Part(corners, _corner_normals(light), colors, np.array(material, dtype=np.float32))


def _decimate(full: Any) -> Any:
    import fast_simplification  # noqa: F401  (trimesh needs it, and says so too late)
    import trimesh

    wanted = int(min(MOST, max(FEWEST, SHARE * len(full.faces))))
    if len(full.faces) <= wanted:
        return full
    light = full.simplify_quadric_decimation(face_count=wanted)
    if len(light.faces) > 2 * wanted and max(full.extents) < SMALL:
        # a hand camera's screws and lenses: a thousand separate parts resist decimation; so do the round edges of its hull
        grid = max(full.extents) / 32
        light = trimesh.convex.convex_hull(np.unique(np.round(full.convex_hull.vertices / grid), axis=0) * grid)
    return light if len(light.faces) > 0 else full


def _corner_normals(mesh: Any) -> np.ndarray:
    """Round where the surface is round, sharp at edges: the mean of the triangles around a corner that lie about alike."""
    around = mesh.vertex_faces[mesh.faces]  # (F, 3, most), -1 for none
    normals, areas = mesh.face_normals[around], mesh.area_faces[around]
    alike = np.einsum("fcnx,fx->fcn", normals, mesh.face_normals) > SMOOTH
    weights = np.where((around >= 0) & alike, areas, 0.0)
    total = np.einsum("fcnx,fcn->fcx", normals, weights) + 1e-12 * mesh.face_normals[:, None]
    length = np.linalg.norm(total, axis=-1, keepdims=True)
    return (total / np.maximum(length, 1e-30)).astype(np.float32)


def _face_colors(corners: np.ndarray, part: Any) -> np.ndarray:
    """
    One colour for each light triangle: the texture's mean over the nearest places of the original. (Texture coordinates
    could not be kept: a triangle that reaches over a seam of the texture would show all of it.)
    """
    import trimesh
    from scipy.spatial import cKDTree

    full = trimesh.Trimesh(part.vertices, part.triangles, process=False)
    points, faces = trimesh.sample.sample_surface(full, SAMPLES, seed=0)
    weights = trimesh.triangles.points_to_barycentric(full.triangles[faces], points)
    coordinates = np.einsum("sc,scx->sx", weights, part.get_vertex_uv()[full.faces[faces]])
    picture = part.material.base_color_texture.download()
    height, width = picture.shape[:2]
    column = (coordinates[:, 0] % 1.0 * width).astype(int).clip(0, width - 1)
    row = (coordinates[:, 1] % 1.0 * height).astype(int).clip(0, height - 1)
    # places within a triangle: its middle, and points towards its corners
    places = np.array([[1, 1, 1], [3, 1, 1], [1, 3, 1], [1, 1, 3], [2, 2, 1], [2, 1, 2], [1, 2, 2]], dtype=np.float32)
    places = places / places.sum(axis=1, keepdims=True)
    _, nearest = cKDTree(points).query(np.einsum("pc,fcx->fpx", places, corners))
    return picture[row, column][nearest].mean(axis=1).round().astype(np.uint8)


# ---------------------------------------------------------------------- drawing
def light_shapes(record: Any) -> list[Any]:
    """
    :param record: SAPIEN's note of a mesh that is to be drawn: file, scale, place, material, name
    :return: SAPIEN's shapes of the light version, empty where the original should stay
    """
    shapes = []
    scale = np.asarray(record.scale, dtype=np.float32)
    for part in light_parts(record.filename):
        shapes.append(shape := _shape(part, scale, record.material))
        shape.local_pose = record.pose
        shape.name = record.name
        if scale.prod() < 0:
            shape.set_front_face("clockwise")
    return shapes


def _shape(part: Part, scale: np.ndarray, material: Any) -> Any:
    import sapien

    n = len(part.vertices)
    coordinates = np.zeros((n, 2), dtype=np.float32)
    if material is None:
        red_to_alpha, (metallic, roughness, specular), emission = np.split(part.material, [4, 7])
        material = sapien.render.RenderMaterial(
            emission=emission, base_color=red_to_alpha, specular=specular, roughness=roughness, metallic=metallic
        )
        if len(part.colors):
            picture, coordinates = _palette(part.colors)
            material.base_color_texture = sapien.render.RenderTexture2D(
                picture, "R8G8B8A8Unorm", filter_mode="nearest", srgb=True
            )
    normals = part.normals / scale
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-30)
    corners = np.concatenate(
        [(part.vertices * scale).reshape(-1, 3), normals.reshape(-1, 3), coordinates.repeat(3, axis=0)], axis=1
    )
    # corners that are alike are one vertex: what a renderer computes for each is the larger part of its work
    vertices, index = np.unique(corners, axis=0, return_inverse=True)
    return sapien.render.RenderShapeTriangleMesh(
        vertices=vertices[:, :3],
        triangles=index.astype(np.uint32).reshape(n, 3),
        normals=vertices[:, 3:6],
        uvs=vertices[:, 6:],
        material=material,
    )


def _palette(colors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """
    :return: a square picture with one pixel per triangle, and where each triangle finds its own, shape ``(F, 2)``
    """
    side = int(np.ceil(np.sqrt(len(colors))))
    picture = np.zeros((side * side, 4), dtype=np.uint8)
    picture[: len(colors)] = colors
    row, column = np.divmod(np.arange(len(colors)), side)
    return picture.reshape(side, side, 4), np.stack([(column + 0.5) / side, (row + 0.5) / side], axis=1).astype(np.float32)
