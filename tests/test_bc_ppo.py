"""The agents bc_ppo and dapg as `train` and `two-stage` run them: from a clone, and on where they were cut off."""

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rl_zoo3")

from stable_baselines3.common.callbacks import BaseCallback

from sb3_cpm.__main__ import main
from sb3_cpm.agents import load_agent
from sb3_cpm.run import TrainSettings, train

SMALL: dict[str, Any] = {
    **{"env": "CPMToy-v0", "env_kwargs": {"keys": ["state"]}, "steps": 1000, "evaluations": 3, "eval_episodes": 10},
    **{"checkpoint_freq": 200, "video": False, "device": "cpu"},
}


def tables(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.glob("*.csv"))}


def success_by_step(folder: Path) -> dict[int, float]:
    with (folder / "evaluations.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    steps = sorted({int(row["step"]) for row in rows})
    return {step: np.mean([float(row["success_at_end"]) for row in rows if int(row["step"]) == step]) for step in steps}


class Stop(Exception):
    pass


class StopAt(BaseCallback):
    def __init__(self, step: int) -> None:
        super().__init__()
        self.step = step

    def _on_step(self) -> bool:
        if self.num_timesteps == self.step:
            raise Stop
        return True


@pytest.mark.parametrize("agent", ["bc_ppo", pytest.param("dapg", marks=pytest.mark.slow)])
def test_the_first_evaluation_shows_the_clone_and_a_run_that_was_cut_off_goes_on(agent: str, tmp_path: Path) -> None:
    train(agent=agent, run_folder=str(tmp_path / "unbroken"), **SMALL)
    success = success_by_step(tmp_path / "unbroken")
    assert success[0] >= 0.8 and min(success.values()) >= success[0] - 0.15
    folder = tmp_path / "broken"
    with pytest.raises(Stop):  # after the checkpoint at step 0, which holds the clone, and in the warm-up
        train(agent=agent, run_folder=str(folder), **SMALL, callback=StopAt(100))
    with pytest.raises(Stop):
        train(TrainSettings(resume=str(folder)), callback=StopAt(500))
    assert train(resume=str(folder)).outcome == "finished"
    assert tables(folder) == tables(tmp_path / "unbroken")


@pytest.mark.slow
def test_two_stages_from_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = [
        *("two-stage", "bc_ppo", "--env", "CPMToy-v0", "--steps", "800", "--folder", str(tmp_path / "run")),
        *("--eval-every", "200", "--eval-episodes", "5", "--test-episodes", "5", "--device", "cpu"),
        *("--overrides", "env_kwargs={keys: [state]}"),
    ]
    assert main(arguments) == 0
    told = capsys.readouterr().out
    assert "Stage 1, step 0: success" in told and "n_steps 175, batch_size 45" in told
    assert "Stage 2, step" in told and str(tmp_path / "run" / "best" / "checkpoint" / "model.zip") in told
    assert main([*arguments, "--seed", "1"]) == 1
    assert "holds a training with other settings (seed: there 0, here 1)" in capsys.readouterr().err
    assert main(["two-stage", "bc_pp", "--env", "CPMToy-v0"]) == 1
    assert "Did you mean 'bc_ppo'" in capsys.readouterr().err


def test_misspelt_and_wrong_arguments_of_the_clone_are_found_before_anything_is_built() -> None:
    clone = "sb3_cpm.imitation.CloneCallback"
    with pytest.raises(ValueError, match="unknown key 'critic_warm_up'.*Did you mean 'critic_warmup'"):
        load_agent("bc_ppo", "CPMToy-v0", {"callback": {clone: {"critic_warm_up": 3}}})
    with pytest.raises(ValueError, match=r"CPMToy-v0, callback .*CloneCallback: validation must be a number from 0"):
        load_agent("bc_ppo", "CPMToy-v0", {"callback": {clone: {"validation": 2}}})
    with pytest.raises(ValueError, match="unknown key 'demo_coeff'.*Did you mean 'demo_coef'"):
        load_agent("dapg", "CPMToy-v0", {"demo_coeff": 3})
