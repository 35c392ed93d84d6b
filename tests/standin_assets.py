"""
Small stand-ins for the objects that some tasks download, laid out as ManiSkill's loaders expect them, so that the tasks
themselves run unmodified. About 130 files and 2 MB; the shapes are boxes, cylinders and bumpy balls, with more triangles for
looks than for collisions, as in the real ones.

    MS_ASSET_DIR=folder python tests/standin_assets.py folder
"""

import importlib.util
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

SHAPES = "shapes"
"""Folder of the meshes that all stand-ins of PartNet-Mobility share, beside theirs."""


def make_all(asset_dir: Path) -> None:
    """
    :param asset_dir: what ``MS_ASSET_DIR`` will be
    """
    data = asset_dir / "data"
    make_ycb(data / "assets/mani_skill2_ycb")
    make_egad(data / "mani_skill2_egad")
    make_partnet(data / "partnet_mobility/dataset")


def bumpy_ball(radius: float, subdivisions: int = 4) -> trimesh.Trimesh:
    """A ball with hills, 20 * 4^subdivisions triangles: it can be decimated, and looks different from each side."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=1.0)
    hills = 1 + 0.15 * np.sin(5 * ball.vertices).prod(axis=1)
    return trimesh.Trimesh(ball.vertices * hills[:, None] * radius, ball.faces, process=False)


# ---------------------------------------------------------------------- objects to pick up
def make_ycb(folder: Path) -> None:
    bodies = {
        "001_box": trimesh.creation.box((0.04, 0.05, 0.06)),
        "002_can": trimesh.creation.cylinder(0.02, 0.08, sections=12),
        "003_ball": trimesh.creation.icosphere(subdivisions=1, radius=0.025),
    }
    models: dict[str, Any] = {}
    for name, body in bodies.items():
        place = folder / "models" / name
        place.mkdir(parents=True, exist_ok=True)
        # text, not binary: SAPIEN 3.0.3 dies of trimesh's binary PLY
        (place / "collision.ply").write_bytes(body.export(file_type="ply", encoding="ascii"))
        write_textured(place, body.subdivide().subdivide().subdivide())
        low, high = body.bounds.tolist()
        models[name] = {"bbox": {"min": low, "max": high}, "scales": [1.0], "density": 1000}
    (folder / "info_pick_v0.json").write_text(json.dumps(models))


def write_textured(folder: Path, mesh: trimesh.Trimesh) -> None:
    """``textured.obj`` with its material and its picture: red to the left, blue to the right."""
    from PIL import Image

    picture = np.zeros((64, 64, 3), dtype=np.uint8)
    picture[:, :32], picture[:, 32:] = (200, 30, 30), (30, 30, 200)
    Image.fromarray(picture).save(folder / "texture_map.png")
    (folder / "textured.mtl").write_text("newmtl looks\nKd 1 1 1\nmap_Kd texture_map.png\n")
    low, high = mesh.bounds
    lines = ["mtllib textured.mtl", "usemtl looks"]
    lines += ["v {:.6f} {:.6f} {:.6f}".format(*vertex) for vertex in mesh.vertices]
    lines += ["vt {:.5f} {:.5f}".format(*uv) for uv in ((mesh.vertices - low) / (high - low))[:, [0, 2]]]
    lines += ["f " + " ".join(f"{i + 1}/{i + 1}" for i in face) for face in mesh.faces]
    (folder / "textured.obj").write_text("\n".join(lines) + "\n")


def make_egad(folder: Path) -> None:
    models = {}
    for name, size, off_center in (("A0_0", 0.02, 0.0), ("B1_2", 0.025, 0.03)):  # EGAD's origins lie anywhere
        ball = bumpy_ball(size)
        corners = ball.vertices
        parts = [trimesh.convex.convex_hull(corners[side * corners[:, 2] >= 0][::16]) for side in (1, -1)]
        for mesh in (ball, *parts):
            mesh.apply_translation((off_center, 0, 0))
        for kind, meshes in (("egad_train_set", [ball]), ("egad_train_set_coacd", parts)):
            (folder / kind).mkdir(parents=True, exist_ok=True)
            (folder / kind / f"{name}.obj").write_text(obj_text(meshes))
        low, high = ball.bounds.tolist()
        models[name] = {"bbox": {"min": low, "max": high}, "scales": [1.0]}
    (folder / "info_pick_train_v0.json").write_text(json.dumps(models))


def obj_text(meshes: list[trimesh.Trimesh]) -> str:
    """One group per mesh: each becomes a convex shape of its own."""
    lines, first = [], 1
    for number, mesh in enumerate(meshes):
        lines.append(f"o part{number}")
        lines += ["v {:.6f} {:.6f} {:.6f}".format(*vertex) for vertex in mesh.vertices]
        lines += ["f {} {} {}".format(*(face + first)) for face in mesh.faces]
        first += len(mesh.vertices)
    return "\n".join(lines) + "\n"


# ---------------------------------------------------------------------- faucets and cabinets
def make_partnet(folder: Path) -> None:
    shapes = folder.parent / SHAPES
    shapes.mkdir(parents=True, exist_ok=True)
    (shapes / "ball.obj").write_text(obj_text([bumpy_ball(0.5)]))
    (shapes / "handle.obj").write_text(obj_text([bumpy_ball(0.5, subdivisions=3)]))
    for model_id, model in models_of("faucet").items():
        write_urdf(folder / model_id, *faucet(model))
    for model_id in {**models_of("cabinet_drawer"), **models_of("cabinet_door")}:
        write_urdf(folder / model_id, *cabinet())


def models_of(category: str) -> dict[str, Any]:
    """ManiSkill's list of models, which comes with it; found without importing it."""
    spec = importlib.util.find_spec("mani_skill")
    assert spec is not None and spec.origin is not None
    return json.loads((Path(spec.origin).parent / f"assets/partnet_mobility/meta/info_{category}_train.json").read_text())


def faucet(model: dict[str, Any]) -> tuple[list[str], list[str]]:
    """A block with as many levers as the model has switches; links have the names that the task looks for."""
    links, joints, switches = [link("base")], [], 0
    for name, _, meaning in model["semantics"]:
        if meaning == "switch":
            links.append(link(name, part("0 0 0.1", "0.08 0.5 0.08", "switch", mesh="ball")))
            joints.append(joint(name, "revolute", "base", f"{0.3 * switches - 0.3:g} 0.3 0.35", "0 0 1", (0, 1.57)))
            switches += 1
        else:
            links.append(link(name, part("0 0 0", "0.8 0.8 0.3", meaning, mesh="ball")))
            joints.append(joint(name, "fixed", "base"))
    return links, joints


def cabinet() -> tuple[list[str], list[str]]:
    """A frame with a drawer (link_1) and a door (link_2), both with handles, closed at the joints' lower limits."""
    frame = [
        part("0 0 -0.9", "1 1 0.1", "frame"),
        part("0 0 0.9", "1 1 0.1", "frame"),
        part("0.45 0 0", "0.1 1 1.7", "frame"),
    ]
    drawer = [part("-0.45 0 0.4", "0.9 0.9 0.6", "drawer", mesh="ball")]
    drawer.append(part("-0.95 0 0.4", "0.05 0.4 0.05", "handle", mesh="handle"))
    door = [part("0 0.45 -0.4", "0.05 0.9 0.7", "door")]
    door.append(part("-0.06 0.8 -0.4", "0.05 0.05 0.4", "handle", mesh="handle"))
    links = [link("base"), link("link_0", *frame), link("link_1", *drawer), link("link_2", *door)]
    joints = [
        joint("link_0", "fixed", "base"),
        joint("link_1", "prismatic", "link_0", "0.4 0 0", "-1 0 0", (0, 0.7)),
        joint("link_2", "revolute", "link_0", "-0.5 -0.45 0", "0 0 1", (0, 1.5)),
    ]
    return links, joints


def part(place: str, size: str, name: str, mesh: str = "") -> str:
    """A box that collides, and what it looks like: itself, or a mesh of the unit size."""
    origin = f'<origin xyz="{place}"/>'
    box = f'<geometry><box size="{size}"/></geometry>'
    looks = f'<geometry><mesh filename="../../{SHAPES}/{mesh}.obj" scale="{size}"/></geometry>' if mesh else box
    return f'<visual name="{name}-0">{origin}{looks}</visual><collision>{origin}{box}</collision>'


def link(name: str, *parts: str) -> str:
    return f'<link name="{name}">{"".join(parts)}</link>'


def joint(
    child: str, kind: str, parent: str, place: str = "0 0 0", axis: str = "0 0 1", limits: tuple[float, float] | None = None
) -> str:
    limit = f'<limit lower="{limits[0]}" upper="{limits[1]}"/>' if limits else ""
    return (
        f'<joint name="joint_{child}" type="{kind}"><origin xyz="{place}"/><axis xyz="{axis}"/>'
        f'<parent link="{parent}"/><child link="{child}"/>{limit}</joint>'
    )


def write_urdf(folder: Path, links: list[str], joints: list[str]) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "mobility_cvx.urdf").write_text(f'<robot name="{folder.name}">{"".join(links + joints)}</robot>\n')


if __name__ == "__main__":
    make_all(Path(sys.argv[1]))
