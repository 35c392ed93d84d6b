"""Work that is saved changes no number: states, rewards and pictures with and without it, episodes with grasps among them."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import pytest

pytest.importorskip("mani_skill")

from sb3_cpm.envs import make_maniskill_env
from sb3_cpm.envs.maniskill import batch, cpu_speedups, experts, meshes

pytestmark = pytest.mark.maniskill


@contextmanager
def env_of(make: Callable[[], Any]) -> Iterator[Any]:
    env = make()
    try:
        yield env
    finally:
        env.close()


def episodes(env: Any, n_steps: int = 18) -> list[Any]:
    """One episode that grasps (where the controller is the expert's) and one at random; everything that can be seen."""
    seen = []
    for seed, scripted in ((3, env.action_space.shape == (7,)), (4, False)):
        rng = np.random.default_rng(seed)
        env.reset(seed=seed)
        expert = experts.PickCube(env.unwrapped, 0) if scripted else None
        for _ in range(n_steps):
            action = expert.act() if expert else rng.uniform(-1, 1, env.action_space.shape)
            observation, reward, terminated, _, info = env.step(action)
            state = env.get_state()["simulation"]
            seen.append((observation, reward, terminated, info, state))
    return seen


def assert_equal(one: Any, other: Any) -> None:
    assert type(one) is type(other)
    if isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            assert_equal(one[key], other[key])
    elif isinstance(one, (list, tuple)):
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            assert_equal(a, b)
    else:
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("control_mode", ["pd_ee_delta_pose", "pd_ee_target_delta_pose", "pd_joint_delta_pos"])
def test_episodes_are_equal_to_the_last_bit(monkeypatch: pytest.MonkeyPatch, control_mode: str) -> None:
    with env_of(lambda: make_maniskill_env("PickCube-v1", obs_mode="state", control_mode=control_mode)) as env:
        saved = episodes(env)
        assert (type(env.unwrapped.agent.controller.controllers["arm"]).__mro__[1].__name__ == "PDEEPoseController") is (
            "ee" in control_mode
        )
        for thing in (env.unwrapped.cube, env.unwrapped.agent.tcp):
            assert thing._poses_at_once
            thing.pose = thing.pose  # can still be set
    monkeypatch.setattr(batch, "speed_up", lambda env: None)
    with env_of(lambda: make_maniskill_env("PickCube-v1", obs_mode="state", control_mode=control_mode)) as env:
        plain = episodes(env)
    assert_equal(saved, plain)
    if control_mode == "pd_ee_delta_pose":
        assert any(info["is_grasped"] for _, _, _, info, _ in saved)


def test_pictures_are_equal_to_the_last_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the cameras, without the hidden goal, and for people, with it."""

    def pictures() -> list[Any]:
        with env_of(lambda: make_maniskill_env("PickCube-v1", render_size=64)) as env:
            env.reset(seed=0)
            shown = [env.step(np.ones(7))[0], env.render(), env.step(-np.ones(7))[0]]
            env.reset(seed=1)  # the goal moves while it is hidden
            return [*shown, env.render(), env.step(np.ones(7))[0]]

    saved = pictures()
    monkeypatch.setattr(batch, "speed_up", lambda env: None)
    assert_equal(saved, pictures())
    assert not np.array_equal(saved[1], saved[3])


def test_what_is_hidden_is_not_given_to_the_renderer() -> None:
    with env_of(lambda: make_maniskill_env("PickCube-v1")) as env:
        system = env.unwrapped.scene.sub_scenes[0].render_system

        def drawn() -> set[str]:
            return {body.entity.name for body in system.render_bodies}

        env.reset(seed=0)
        assert "scene-0_goal_site" not in drawn()
        env.render()
        assert "scene-0_goal_site" in drawn()
        env.step(np.zeros(7))
        assert "scene-0_goal_site" not in drawn()


def test_corners_that_are_alike_are_one_vertex() -> None:
    """A light triangle has three corners of its own in the cache; the renderer gets each distinct one once."""
    import sapien

    corners = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[1, 0, 0], [1, 1, 0], [0, 1, 0]]], dtype=np.float32)
    normals = np.tile(np.array([0, 0, 1], dtype=np.float32), (2, 3, 1))
    part = meshes.Part(corners, normals, np.zeros((0, 4), np.uint8), np.full(11, 0.5, np.float32))
    with env_of(lambda: make_maniskill_env("PickCube-v1")):  # opens the renderer
        (drawn,) = meshes._shape(part, np.array([2.0, 1.0, 1.0], np.float32), sapien.render.RenderMaterial()).parts
        assert len(drawn.vertices) == 4
        np.testing.assert_array_equal(drawn.vertices[drawn.triangles], corners * [2, 1, 1])
        np.testing.assert_array_equal(drawn.get_vertex_normal()[drawn.triangles], normals)


def test_a_simulation_on_the_gpu_stays_as_it_is() -> None:
    class Scene:
        gpu_sim_enabled = True

    class Env:
        scene = Scene()  # nothing else is looked at

    cpu_speedups.speed_up(Env())
