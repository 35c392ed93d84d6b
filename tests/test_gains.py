"""Gains of the arm's PD controller."""

from typing import Any

import numpy as np
import pytest

from sb3_cpm.envs import make_maniskill_env

pytestmark = pytest.mark.maniskill


def make(**kwargs: Any) -> Any:
    return make_maniskill_env("PickCube-v1", obs_mode="state", render_mode=None, **kwargs)


def height_after(env: Any, steps: int) -> float:
    env.reset(seed=0)
    before = env.batch.env.agent.tcp.pose.p[0, 2].item()
    for _ in range(steps):
        env.step(np.array([0, 0, 1, 0, 0, 0, 1], np.float32))
    return env.batch.env.agent.tcp.pose.p[0, 2].item() - before


def test_a_weak_arm_lags_behind_and_its_gripper_does_not() -> None:
    risen = {}
    for name, gains in {"own": {}, "same": {"stiffness": 1000.0, "damping": 100.0}, "weak": {"stiffness": 100.0}}.items():
        env = make(**gains)
        risen[name] = height_after(env, 5)
        controllers = env.batch.env.agent.controller.controllers
        assert controllers["arm"].config.stiffness == gains.get("stiffness", 1000.0)
        assert controllers["gripper"].config.stiffness == 1000.0
        assert controllers["arm"].joints[0]._objs[0].stiffness == gains.get("stiffness", 1000.0)
        assert controllers["gripper"].joints[0]._objs[0].stiffness == 1000.0
        env.close()
    assert risen["own"] == risen["same"] > 0.05 and risen["weak"] < 0.8 * risen["own"]


def test_a_scene_that_is_built_anew_has_them_too() -> None:
    env = make(damping=300.0)
    env.reset(seed=0, options={"reconfigure": True})
    assert env.batch.env.agent.controller.controllers["arm"].joints[0]._objs[0].damping == 300.0
    env.close()


@pytest.mark.parametrize(
    "wrong, message",
    [
        ({"stiffness": 0}, "stiffness must be a number above 0"),
        ({"damping": "high"}, "damping must be a number above 0"),
        (
            {"stiffness": 10.0, "control_mode": "pd_joint_vel"},
            "the controller 'pd_joint_vel' of 'panda.*no such gain",
        ),
    ],
)
def test_bad_input(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(**wrong)
