"""Scripted experts of ManiSkill's tasks (those of objects that are downloaded: tasks_on_assets.py)."""

import pytest

pytest.importorskip("mani_skill")

from stable_baselines3.common.env_util import make_vec_env

from sb3_cpm.envs import make_maniskill_env, make_maniskill_vec_env
from sb3_cpm.envs.maniskill.experts import CONTROLLERS, EXPERTS
from sb3_cpm.imitation import record_demonstrations

pytestmark = pytest.mark.maniskill

TASKS = [task for task in EXPERTS if "Single" not in task]


@pytest.mark.parametrize("task", TASKS)
def test_they_succeed_and_hold_what_they_have_reached(task: str) -> None:
    env = make_vec_env(make_maniskill_env, 1, env_kwargs={"env_id": task, "obs_mode": "state", "ignore_terminations": True})
    outcomes: list[bool] = []
    found = record_demonstrations(env, 3, seed=0, hold=True, outcomes=outcomes)
    assert outcomes.count(True) == 3 and len(outcomes) <= 4
    assert all(len(one.rewards) == 50 and not one.terminated and one.instance == task for one in found)
    env.close()


def test_without_rotations() -> None:
    """The cube is stacked as the hand stands; the peg cannot be."""
    env = make_vec_env(
        make_maniskill_env, 1, env_kwargs=dict(env_id="StackCube-v1", obs_mode="state", control_mode="pd_ee_delta_pos")
    )
    assert record_demonstrations(env, 2, seed=0)[0].actions.shape[1] == 4
    env.close()


@pytest.mark.parametrize(
    ("task", "kwargs", "message"),
    [
        ("LiftPegUpright-v1", {"control_mode": "pd_ee_delta_pos"}, "gives actions of pd_ee_delta_pose, this environment has"),
        ("PickCube-v1", {"control_mode": "pd_joint_delta_pos"}, "Make it with control_mode='pd_ee_delta_pose'"),
        ("PickCube-v1", {"robot_uids": "fetch"}, "not fetch: leave robot_uids away"),
        ("PokeCube-v1", {}, "no scripted expert; these tasks have one: PickCube-v1"),
    ],
)
def test_why_there_is_none(task: str, kwargs: dict[str, str], message: str) -> None:
    env = make_maniskill_vec_env(task, obs_mode="state", **kwargs)
    with pytest.raises(ValueError, match=message):
        record_demonstrations(env, 1)
    with pytest.raises(ValueError, match=message):
        env.env_method("expert_action")
    env.close()


def test_every_task_has_a_way_to_be_asked_for() -> None:
    assert set(CONTROLLERS) == {mode for expert in EXPERTS.values() for mode in expert.controllers}
