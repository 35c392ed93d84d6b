"""Light meshes by themselves; for pictures and physics of whole tasks see test_maniskill.py and test_tasks.py."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import standin_assets
import trimesh

from sb3_cpm.envs.maniskill import meshes, visuals
from sb3_cpm.machine import rendering

pytestmark = pytest.mark.maniskill


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rendering.ensure_renderer()
    monkeypatch.setenv("SB3_CPM_CACHE", str(tmp_path / "cache"))
    meshes.light_parts.cache_clear()


def ball(folder: Path, subdivisions: int = 4) -> Path:
    file = folder / "ball.obj"
    file.write_text(standin_assets.obj_text([standin_assets.bumpy_ball(0.5, subdivisions)]))
    return file


def test_same_shape_with_fewer_triangles(tmp_path: Path) -> None:
    (part,) = meshes.light_parts(str(ball(tmp_path)))
    assert len(part.vertices) <= meshes.FEWEST and len(part.colors) == 0
    full = standin_assets.bumpy_ball(0.5)
    light = trimesh.Trimesh(part.vertices.reshape(-1, 3), np.arange(3 * len(part.vertices)).reshape(-1, 3))
    np.testing.assert_allclose(light.bounds, full.bounds, atol=0.05)
    assert light.volume == pytest.approx(full.volume, rel=0.1)
    # normals point outwards and are of length one; around a corner of a smooth body they agree
    np.testing.assert_allclose(np.linalg.norm(part.normals, axis=-1), 1, atol=1e-5)
    outwards = np.einsum("fcx,fcx->fc", part.normals, part.vertices / np.linalg.norm(part.vertices, axis=-1, keepdims=True))
    assert np.median(outwards) > 0.8
    assert part.material[3] == 1.0  # not transparent


def test_small_meshes_stay(tmp_path: Path) -> None:
    assert meshes.light_parts(str(ball(tmp_path, subdivisions=2))) == ()


def test_sharp_edges_stay_sharp() -> None:
    box = trimesh.creation.box((1, 1, 1))
    normals = meshes._corner_normals(box)
    np.testing.assert_allclose(normals, np.repeat(box.face_normals[:, None], 3, axis=1), atol=1e-6)


def test_textures_become_colours_of_triangles(tmp_path: Path) -> None:
    standin_assets.write_textured(tmp_path, standin_assets.bumpy_ball(0.5))  # red to the left, blue to the right
    (part,) = meshes.light_parts(str(tmp_path / "textured.obj"))
    assert part.colors.shape == (len(part.vertices), 4)
    middle = part.vertices.mean(axis=1)[:, 0]
    for side, color in ((middle < -0.1, (200, 30, 30, 255)), (middle > 0.1, (30, 30, 200, 255))):
        assert side.sum() > 50
        np.testing.assert_allclose(np.median(part.colors[side], axis=0), color, atol=2)
    picture, coordinates = meshes._palette(part.colors)
    side = len(picture)
    column, row = np.floor(coordinates * side).astype(int).T
    np.testing.assert_array_equal(picture[row, column], part.colors)


def test_made_once_and_made_again_when_the_file_or_the_cache_is_broken(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[str] = []
    make = meshes._make
    monkeypatch.setattr(meshes, "_make", lambda filename: (made.append(filename), make(filename))[1])
    file = str(ball(tmp_path))
    first = meshes.light_parts(file)
    for _ in range(2):
        meshes.light_parts.cache_clear()
        (again,) = meshes.light_parts(file)
        assert all((a == b).all() for a, b in zip(again, first[0], strict=True))
    assert len(made) == 1
    (cached,) = (tmp_path / "cache/meshes").glob("ball-*.npz")
    whole = cached.read_bytes()
    middle = len(whole) // 2
    flipped = whole[:middle] + bytes([whole[middle] ^ 255]) + whole[middle + 1 :]
    for damaged in (whole[:100], b"", flipped):
        cached.write_bytes(damaged)
        meshes.light_parts.cache_clear()
        (again,) = meshes.light_parts(file)
        assert all((a == b).all() for a, b in zip(again, first[0], strict=True))
    Path(file).write_text(Path(file).read_text() + "# changed\n")
    meshes.light_parts.cache_clear()
    meshes.light_parts(file)
    assert len(made) == 5


def test_scale_mirror_and_material_are_those_of_the_record(tmp_path: Path) -> None:
    import sapien

    file = str(ball(tmp_path))
    red = sapien.render.RenderMaterial(base_color=[1, 0, 0, 1])
    pose = sapien.Pose([1, 2, 3])
    record = SimpleNamespace(filename=file, scale=(2, 1, -1), material=red, pose=pose, name="thing")
    (shape,) = meshes.light_shapes(record)
    (part,) = meshes.light_parts(file)
    drawn = shape.parts[0]
    np.testing.assert_allclose(drawn.vertices[drawn.triangles], part.vertices * [2, 1, -1], rtol=1e-6)
    assert shape.name == "thing" and shape.front_face == "clockwise" and (shape.local_pose.p == [1, 2, 3]).all()
    np.testing.assert_allclose(shape.parts[0].material.base_color, [1, 0, 0, 1])


def test_handles_and_textured_materials_stay() -> None:
    record = SimpleNamespace(name="handle-12", material=None)
    assert not visuals._may_change(record)
    record.name = "door-3"
    assert visuals._may_change(record)
    record.material = SimpleNamespace(base_color_texture=object())
    assert not visuals._may_change(record)


def test_without_the_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(visuals, "PACKAGES", ("no_such_package",))
    with pytest.raises(RuntimeError, match=r'needs no_such_package: pip install .*\[maniskill\]"'):
        visuals.choose_visuals("light", software=True)
    with pytest.warns(UserWarning, match="Slow rendering, no_such_package is missing"):
        chosen: Any = visuals.choose_visuals("auto", software=True)
    assert chosen.light and not chosen.meshes  # the floor needs no package
    assert not visuals.choose_visuals("auto", software=False).light
    assert not visuals.choose_visuals("full", software=True).light
