"""The arithmetic of point clouds and robot states, without a simulator; two environments at once."""

import time
from collections.abc import Callable

import numpy as np
import pytest
import torch as th

from sb3_cpm.envs.maniskill import clouds, observations


def picture(ids: list[list[int]], position: list[list[list[int]]], cam2world: np.ndarray) -> clouds.Picture:
    """White pictures of one row, one per environment."""
    n, width = np.shape(ids)
    return clouds.Picture(
        rgb=np.full((n, 1, width, 3), 255, dtype=np.uint8),
        position=np.array(position, dtype=np.int16).reshape(n, 1, width, 3),
        segmentation=np.array(ids, dtype=np.int16).reshape(n, 1, width, 1),
        cam2world=np.broadcast_to(cam2world, (n, 4, 4)).astype(np.float32),
    )


def no_random_numbers(i: int) -> np.random.Generator:
    raise AssertionError("nothing was to be drawn")


def seeded(i: int) -> np.random.Generator:
    return np.random.default_rng(i)


def test_points_of_the_world_by_hand() -> None:
    # a camera one metre up that looks along the world's x: its z axis (backwards in OpenGL) is -x, its x is -y, its y is z
    cam2world = np.array([[0, 0, -1, 0], [-1, 0, 0, 0], [0, 1, 0, 1], [0, 0, 0, 1]], dtype=np.float32)
    seen = picture([[1]], [[[100, 200, -3000]]], cam2world)  # 0.1 m to its right, 0.2 m up, 3 m in front
    points, owner = clouds.scene_points([seen], np.array([[-1, 0]]), max_distance=4.0)
    np.testing.assert_allclose(points, [[3.0, -0.1, 1.2, 1, 1, 1, 0]], rtol=1e-6)
    assert owner.tolist() == [0]


def test_background_sky_and_far_points_are_dropped() -> None:
    position = [[[0, 0, -500], [0, 0, -1000], [0, 0, -1000], [0, 0, -4000]]] * 2
    labels = np.array([[-1, -1, 0, 1], [-1, 0, -1, 1]])  # background is 1 in the first environment, 2 in the second
    points, owner = clouds.scene_points([picture([[0, 1, 2, 3]] * 2, position, np.eye(4))] * 2, labels, max_distance=3.0)
    # 0 is sky, 3 is 4 m away; two cameras saw the same; points of one environment stay together
    assert owner.tolist() == [0, 0, 1, 1]
    np.testing.assert_allclose(points, [[0, 0, -1, 1, 1, 1, 0]] * 4)


def test_clouds_are_chosen_repeated_or_replaced() -> None:
    rows = np.arange(90, dtype=np.float32).reshape(15, 6)
    owner = np.array([0] * 10 + [2] * 5)  # the second environment sees nothing
    hands = np.array([[0, 0, 0], [1.0, 2.0, 3.0], [0, 0, 0]])
    for sampling in clouds.SAMPLINGS:
        result = clouds.resize_clouds(rows, owner, 7, sampling, hands, seeded)
        assert result.shape == (3, 7, 6) and result.dtype == np.float32
        chosen = {row.tobytes() for row in result[0]}
        assert len(chosen) == 7 and chosen <= {row.tobytes() for row in rows[:10]}
        np.testing.assert_array_equal(result[1], [[1, 2, 3, 0, 0, 0]] * 7)
        np.testing.assert_array_equal(result[2], np.concatenate([rows[10:], rows[10:12]]))
    # nothing is drawn where nothing needs to be chosen
    clouds.resize_clouds(rows, owner, 10, "random", hands, no_random_numbers)


def farthest_points_slowly(points: np.ndarray, n: int) -> list[int]:
    chosen = [int(np.linalg.norm(points - points.mean(0), axis=1).argmax())]
    while len(chosen) < n:
        distance = np.linalg.norm(points[:, None] - points[chosen], axis=2).min(axis=1)
        distance[chosen] = -1
        chosen.append(int(distance.argmax()))
    return chosen


def test_farthest_points_against_the_definition() -> None:
    points = np.random.default_rng(0).normal(size=(200, 3))
    assert clouds.farthest_points(points, 40).tolist() == farthest_points_slowly(points, 40)
    # points that coincide are still different points
    assert sorted(clouds.farthest_points(np.ones((5, 3)), 5).tolist()) == [0, 1, 2, 3, 4]
    # far better spread than a random choice
    spread = [_coverage(points, points[i]) for i in (clouds.farthest_points(points, 40), np.arange(40))]
    assert spread[0] < 0.8 * spread[1]


def _coverage(points: np.ndarray, chosen: np.ndarray) -> float:
    return float(np.linalg.norm(points[:, None] - chosen, axis=2).min(axis=1).max())


def test_points_around_the_goal_lie_on_a_sphere() -> None:
    goal = np.array([[0.1, -0.2, 0.3], [0, 0, 0]])
    cloud = clouds.goal_clouds(goal, 50, radius=0.025)
    np.testing.assert_allclose(np.linalg.norm(cloud[:, :, :3] - goal[:, None], axis=2), 0.025, rtol=1e-4)
    np.testing.assert_allclose(cloud[:, :, :3].mean(1), goal, atol=2e-3)
    np.testing.assert_array_equal(cloud[0, :, 3:], [[*clouds.GOAL_COLOR, clouds.GOAL]] * 50)


def test_frames_of_reference() -> None:
    # a hand at (1, 2, 3), turned by 90 degrees around z: its x is the world's y
    pose = np.array([[1, 2, 3, np.sqrt(0.5), 0, 0, np.sqrt(0.5)], [0, 0, 0, 1, 0, 0, 0]])
    cloud = np.array([[[1, 2.5, 3, 9]], [[1, 2, 3, 9]]], dtype=np.float32)
    clouds.to_frame(cloud, pose)
    np.testing.assert_allclose(cloud, [[[0.5, 0, 0, 9]], [[1, 2, 3, 9]]], atol=1e-6)


def test_labels_count_the_things_in_the_order_of_the_scene() -> None:
    things = {
        3: clouds.Thing("ground", False),
        7: clouds.Thing("link", True),
        5: clouds.Thing("cube", False, clouds.REST),
        4: clouds.Thing("ball", False, clouds.TARGET),
        2: clouds.Thing("cone", False),
    }
    table = clouds.label_table([things, {}])
    assert table.shape == (2, 9)
    assert {i: int(table[0, i]) for i in (0, 3, 7, 5, 4, 2, 8)} == {0: -1, 3: -1, 7: 0, 5: 1, 4: 2, 2: 3, 8: 1}
    table = clouds.label_table([things, {}], by_role=True)
    assert {i: int(table[0, i]) for i in (0, 3, 7, 5, 4, 2, 8)} == {0: -1, 3: -1, 7: 0, 5: 2, 4: 1, 2: 3, 8: 3}


def test_settings_are_checked() -> None:
    with pytest.raises(ValueError, match="point_labels must be one of False, True, roles, got 'role'"):
        clouds.CloudSettings(labels="role").check()
    with pytest.raises(ValueError, match="random, farthest, got 'fps'"):
        clouds.CloudSettings(sampling="fps").check()
    with pytest.raises(ValueError, match="world, base, end_effector"):
        clouds.CloudSettings(frame="camera").check()


@pytest.mark.parametrize("sampling", clouds.SAMPLINGS)
def test_many_environments_are_affordable(sampling: str) -> None:
    """256 environments with two cameras of 32 x 32: what a simulation on the GPU gives in one step."""
    rng = np.random.default_rng(0)
    n = 256
    seen = clouds.Picture(
        rgb=rng.integers(0, 255, (n, 32, 32, 3), dtype=np.uint8),
        position=rng.integers(-1000, 1000, (n, 32, 32, 3)).astype(np.int16),
        segmentation=rng.choice(5, (n, 32, 32, 1), p=[0.45, 0.45, 0.04, 0.03, 0.03]).astype(np.int16),
        cam2world=np.broadcast_to(np.eye(4, dtype=np.float32), (n, 4, 4)),
    )
    labels = np.broadcast_to(np.array([-1, -1, 0, 1, 2]), (n, 5)).copy()
    start = time.process_time()
    settings = clouds.CloudSettings(sampling=sampling, n_points=128)
    result = clouds.make_clouds(settings, [seen] * 2, labels, np.zeros((n, 3)), np.zeros((n, 3)), None, seeded)
    seconds = time.process_time() - start
    assert result.shape == (n, 178, 6)
    assert seconds < (0.5 if sampling == "random" else 5.0)


# ---------------------------------------------------------------------- state and transfer
def test_state_takes_only_what_a_robot_may_know() -> None:
    agent = {"qvel": np.arange(2.0)[None] + 10, "controller": {"target": np.array([[7.0]])}, "qpos": np.arange(2.0)[None]}
    extra = {"obj_pose": np.full((1, 7), 99.0), "goal_pos": np.arange(3.0)[None], "is_grasped": np.array([True])}
    extra["tcp_pose"] = np.ones((1, 7))
    parts = observations.state_parts(agent, extra, privileged=False)
    state = observations.join_parts(parts, 1)
    np.testing.assert_array_equal(state, [[0, 1, 10, 11, 7, *[1] * 7, 0, 1, 2, 1]])
    assert state.dtype == np.float32
    assert observations.layout(parts)["goal_pos"] == slice(12, 15)
    everything = observations.state_parts(agent, extra, privileged=True)
    assert list(everything)[-4:] == ["obj_pose", "goal_pos", "is_grasped", "tcp_pose"]
    assert observations.join_parts({}, 3).shape == (3, 0)


@pytest.mark.parametrize("block", [False, True])
def test_to_host_copies_everything_from_a_gpu_in_one_block(monkeypatch: pytest.MonkeyPatch, block: bool) -> None:
    live = th.arange(6, dtype=th.float32).reshape(2, 3)
    tree = {
        "flag": th.tensor([True, False]),
        "deep": {"float": live, "short": th.arange(4, dtype=th.int16).reshape(2, 2), "double": th.tensor([1.5, 2.5]).double()},
        "strided": live.T[:2],
        "array": np.array([3, 4]),
    }
    if block:  # as from a GPU
        monkeypatch.setattr(observations, "_on_host", lambda leaf: False)
    transfers: list[int] = []
    to_cpu = th.Tensor.cpu
    monkeypatch.setattr(th.Tensor, "cpu", lambda tensor: (transfers.append(1), to_cpu(tensor))[1])
    host = observations.to_host(tree)
    assert len(transfers) == block and list(host) == list(tree) and list(host["deep"]) == list(tree["deep"])
    expected: dict[str, Callable] = {"flag": lambda t: t["flag"], "strided": lambda t: t["strided"]}
    for read in (*expected.values(), *(lambda t, k=k: t["deep"][k] for k in tree["deep"])):
        result = read(host)
        np.testing.assert_array_equal(result, read(tree).numpy())
        assert result.dtype == read(tree).numpy().dtype and result.flags.aligned
    live += 100
    np.testing.assert_array_equal(host["deep"]["float"], np.arange(6).reshape(2, 3))
    np.testing.assert_array_equal(observations.to_host(tree, th.tensor([1]))["deep"]["short"], [[2, 3]])
