"""``python -m sb3_cpm demonstrate``: an expert's episodes in a file that training reads as they were."""

import json
from pathlib import Path

import numpy as np
import pytest

from sb3_cpm import CPMBuffer
from sb3_cpm.__main__ import main
from sb3_cpm.agents import load_agent
from sb3_cpm.buffers.demonstrations import read_demonstrations
from sb3_cpm.envs import make_maniskill_vec_env
from sb3_cpm.imitation import load_demonstrations, record_demonstrations


@pytest.mark.parametrize("n_envs", [1, 2])
def test_the_file_holds_what_training_sees(n_envs: int, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "toy.h5"
    command = ["demonstrate", "--env", "CPMToy-v0", "--episodes", "4", "--n-envs", str(n_envs), "--output", str(file)]
    assert main(command) == 0
    assert "4 demonstrations of CPMToy-v0" in capsys.readouterr().out
    built = load_agent("bc_ppo", "CPMToy-v0").build(seed=0, n_envs=n_envs, device="cpu")
    space = built.env.observation_space
    found = read_demonstrations(file, space, built.env.action_space)
    for one, other in zip(found, record_demonstrations(built.env, 4, seed=0), strict=True):
        assert all((one.observations[key] == other.observations[key]).all() for key in space.spaces)
        assert (one.actions == other.actions).all() and (one.rewards == other.rewards).all()
        assert one.terminated == other.terminated and one.observations["camera"].dtype == np.uint8
    buffer = CPMBuffer(1000, space, built.env.action_space, device="cpu", challenge_ratio=0)
    assert buffer.add_demonstrations(file) == 4
    assert main(command) == 1 and "is there already" in capsys.readouterr().err
    assert main([*command, "--overwrite"]) == 0


@pytest.mark.maniskill
def test_the_robot_with_the_object_that_it_is_about(tmp_path: Path) -> None:
    file = tmp_path / "push.h5"
    command = ["demonstrate", "--env", "PushCube-v1", "--episodes", "2", "--env-kwargs", "obs_mode=state"]
    assert main([*command, "--output", str(file)]) == 0
    entries = json.loads(file.with_suffix(".json").read_text())["episodes"]
    assert [(entry["instance"], entry["control_mode"]) for entry in entries] == [("PushCube-v1", "pd_ee_delta_pose")] * 2
    env = make_maniskill_vec_env("PushCube-v1", obs_mode="state", control_mode="pd_ee_target_delta_pose")  # as many numbers
    told = r"controller pd_ee_delta_pose\).*controller pd_ee_target_delta_pose\).*pd_joint_pos.*Record them anew"
    with pytest.raises(ValueError, match=told):
        load_demonstrations(file, env)
    env.close()


@pytest.mark.parametrize(
    "arguments, message",
    [
        (["--env", "Pendulum-v1"], "has no expert"),
        (["--env", "PickCub-v1"], "PickCube-v1"),
        (["--env", "CPMToy-v0", "--episodes", "0"], "episodes must be"),
        (["--env", "CPMToy-v0", "--output", "toy.npz"], "ends with .h5"),
        (["--env", "CPMToy-v0", "--agent", "bc_pp"], "bc_ppo"),
    ],
)
def test_bad_input(arguments: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demonstrate", *arguments]) == 1
    assert message in capsys.readouterr().err
