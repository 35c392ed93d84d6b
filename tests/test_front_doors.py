"""One agent whichever way it is run: `train`, `reproduce`, rl_zoo3's own commands; and runs that were cut off go on."""

import argparse
import csv
import functools
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

pytest.importorskip("rl_zoo3")

from rl_zoo3 import exp_manager
from stable_baselines3.common.callbacks import BaseCallback

from sb3_cpm import ChallengerCallback
from sb3_cpm.agents import Agent, load_agent
from sb3_cpm.agents.algorithms import algorithm_of
from sb3_cpm.agents.configs import read_entries
from sb3_cpm.experiments.catalog import EXPERIMENTS
from sb3_cpm.extras import config_folder
from sb3_cpm.run import TrainSettings, train
from sb3_cpm.run.training import specification
from sb3_cpm.zoo.__main__ import complete

ROOT = Path(__file__).resolve().parents[1]
AGENTS = sorted(path.stem for path in config_folder().glob("*.yml"))


def entries(agent: str) -> list[str]:
    """Tasks that a file names, and one that it does not."""
    names = [name for name in read_entries(config_folder() / f"{agent}.yml") if not name.startswith(".")]
    return ["Pendulum-v1" if name == "default" else name for name in names]


def plain(value: Any) -> Any:
    """Arguments as they can be compared: functions and objects by what they do."""
    if isinstance(value, dict):
        return {key: plain(one) for key, one in value.items()}
    if isinstance(value, ChallengerCallback):
        return {name: plain(one) for name, one in value.arguments.items()}
    if isinstance(value, BaseCallback):
        return plain(vars(value))
    if isinstance(value, (list, tuple)):
        return [plain(one) for one in value]
    if isinstance(value, functools.partial):
        return [plain(value.func), plain(value.args), plain(value.keywords)]
    if type(value).__module__.startswith("stable_baselines3") or hasattr(value, "__closure__"):
        cells = [plain(cell.cell_contents) for cell in getattr(value, "__closure__", None) or ()]
        progress = [value(one) for one in (1.0, 0.5)] if "chedule" in type(value).__name__ else None
        return [getattr(value, "__qualname__", type(value).__qualname__), cells, progress]
    return value


def of_manager(manager: Any, hyperparameters: dict[str, Any]) -> dict[str, Any]:
    return {
        "arguments": plain(hyperparameters),
        "callbacks": [[type(one).__name__, plain(one)] for one in manager.callbacks],
        "env_wrapper": plain(manager.env_wrapper),
        "env_kwargs": plain(manager.env_kwargs),
        "n_envs": manager.n_envs,
        "n_timesteps": manager.n_timesteps,
        "normalize": [manager.normalize, plain(manager.normalize_kwargs)],
    }


def of_agent(agent: Agent) -> dict[str, Any]:
    manager, hyperparameters = agent._manager(0, "cpu", "dummy")
    return of_manager(manager, hyperparameters)


def of_rl_zoo3(arguments: list[str]) -> dict[str, Any]:
    """As ``python -m rl_zoo3.train`` reads its command line."""
    algo, env_id, config = (arguments[arguments.index(name) + 1] for name in ("--algo", "--env", "--conf-file"))
    manager = exp_manager.ExperimentManager(argparse.Namespace(), algo, env_id, "", config=config, verbose=0)
    hyperparameters, _ = manager.read_hyperparameters()
    hyperparameters, manager.env_wrapper, manager.callbacks, manager.vec_env_wrapper = manager._preprocess_hyperparams(
        hyperparameters
    )
    return of_manager(manager, hyperparameters)


@pytest.mark.parametrize(("agent", "env_id"), [(agent, env_id) for agent in AGENTS for env_id in entries(agent)])
def test_every_front_door_gives_the_same_model(agent: str, env_id: str, capsys: pytest.CaptureFixture[str]) -> None:
    of_train = of_agent(specification(TrainSettings(agent=agent, env=env_id))[1])
    assert of_train == of_agent(load_agent(agent, env_id)), "reproduce"
    path = str(config_folder() / f"{agent}.yml")
    assert of_train == of_rl_zoo3(["--algo", algorithm_of(agent), "--env", env_id, "--conf-file", path]), "rl_zoo3.train"
    assert of_train == of_rl_zoo3(complete("train", ["--agent", agent, "--env", env_id])), "sb3_cpm.zoo"


def test_short_names_of_tasks_are_the_same_tasks() -> None:
    assert specification(TrainSettings(env="PickCube-v1")) == specification(TrainSettings(env="CPM/PickCube-v1"))
    tasks = {spec.env_id for one in EXPERIMENTS.values() for version in one.plans for spec in one.runs(version, seeds=1)}
    assert all(env_id.startswith("CPM") or "/" not in env_id for env_id in tasks)


# ---------------------------------------------------------------------- going on

SMALL: dict[str, Any] = {
    **{"env": "CPMToy-v0", "env_kwargs": {"keys": ["state"]}, "steps": 400, "learning_starts": 100, "batch_size": 8},
    **{"evaluations": 2, "eval_episodes": 1, "checkpoint_freq": 100, "video": False, "device": "cpu", "train_freq": 10},
    "model_kwargs": {"policy_kwargs": {"net_arch": [4]}},
    "callback_kwargs": {"challenger_kwargs": {"batch_size": 2, "sequence_length": 8, "imagination_starts": 4, "horizon": 3}},
}
TRAIN = "import sys\nfrom sb3_cpm.run import train\nif __name__ == '__main__': train(**eval(sys.argv[1]))\n"


def tables(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.glob("*.csv"))}


def start(folder: Path, tmp_path: Path, **changes: Any) -> "subprocess.Popen[str]":
    script = tmp_path / "train.py"  # a file, as worker processes import it
    script.write_text(TRAIN)
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    settings = repr({**SMALL, "run_folder": str(folder), **changes})
    command = [sys.executable, str(script), settings]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment)


def wait_for_episodes(folder: Path, n: int) -> None:
    path, until = folder / "training.csv", time.monotonic() + 120
    while not path.exists() or len(path.read_text().splitlines()) <= n:
        assert time.monotonic() < until, "the run does not get on"
        time.sleep(0.02)


@pytest.mark.parametrize(
    ("number", "n_envs"),
    [
        (signal.SIGTERM, 1),
        *(pytest.param(*case, marks=pytest.mark.slow) for case in ((signal.SIGKILL, 1), (signal.SIGTERM, 2))),
    ],
)
def test_a_run_that_was_cut_off_goes_on(number: signal.Signals, n_envs: int, tmp_path: Path) -> None:
    train(run_folder=str(tmp_path / "unbroken"), n_envs=n_envs, **SMALL)
    folder = tmp_path / "broken"
    process = start(folder, tmp_path, n_envs=n_envs)
    wait_for_episodes(folder, 4 if n_envs == 2 else 3)
    process.send_signal(number)
    output, _ = process.communicate()
    if number is signal.SIGTERM:
        assert process.returncode == 143 and "Traceback" not in output, output
        assert f"goes on from its newest checkpoint with: python -m sb3_cpm train --resume {folder}" in output
        assert (folder / "model.zip").exists() and (folder / "summary.txt").exists()
    assert not (folder / "finished.yml").exists() and (folder / "checkpoint" / "model.zip").exists()
    summary = train(resume=str(folder))
    assert summary.outcome == "finished" and summary.steps == 400
    assert tables(folder) == tables(tmp_path / "unbroken")
    assert not (folder / "checkpoint").exists()


@pytest.mark.slow
def test_a_run_that_was_killed_before_its_first_episode_ended_goes_on(tmp_path: Path) -> None:
    process = start(tmp_path / "run", tmp_path, evaluations=0)
    while not (tmp_path / "run" / "config.yml").exists():
        time.sleep(0.01)
    process.kill()
    process.communicate()
    assert train(resume=str(tmp_path / "run")).episodes == 8
    train(run_folder=str(tmp_path / "unbroken"), **{**SMALL, "evaluations": 0})
    assert tables(tmp_path / "run") == tables(tmp_path / "unbroken")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("finished") / "run"
    train(run_folder=str(folder), **{**SMALL, "evaluations": 0, "steps": 150})
    return folder


def test_what_cannot_be_gone_on_with(finished: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="this run has come to its end"):
        train(resume=str(finished))
    with pytest.raises(ValueError, match="there is no such folder"):
        train(resume=str(tmp_path / "nothing"))
    with pytest.raises(ValueError, match=r"it has no config\.yml"):
        train(resume=str(tmp_path))
    with pytest.raises(ValueError, match="goes on with that run as it is, but gamma came with it"):
        train(resume=str(finished), gamma=0.5)
    (tmp_path / "config.yml").write_text("env: PickCube-v1\n")
    with pytest.raises(ValueError, match="of an earlier sb3_cpm, whose `train` wrote no checkpoints"):
        train(resume=str(tmp_path))


@pytest.fixture
def cut_off(tmp_path: Path) -> Path:
    folder = tmp_path / "run"

    class Stop(Exception):
        pass

    class StopAt(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps == 150:
                raise Stop
            return True

    with pytest.raises(Stop):
        train(TrainSettings(run_folder=str(folder), **{**SMALL, "evaluations": 0}), callback=StopAt())
    return folder


def test_checkpoints_that_are_not_what_was_written_are_refused(cut_off: Path) -> None:
    config = yaml.safe_load((cut_off / "config.yml").read_text())
    before = tables(cut_off)
    for change, told in (
        ({**config, "sb3_cpm": "0.0.1"}, "made by sb3_cpm 0.0.1"),
        (
            {**config, "fingerprint": "x", "protocol": {**config["protocol"], "steps": 7}},
            "other settings .steps: there 7, here",
        ),
        ({**config, "run": {**config["run"], "config": "td3_of_mine"}}, "Unknown agent 'td3_of_mine'"),
    ):
        (cut_off / "config.yml").write_text(yaml.safe_dump(change))
        with pytest.raises(ValueError, match=told):
            train(resume=str(cut_off))
    (cut_off / "config.yml").write_text(yaml.safe_dump(config))
    state = cut_off / "checkpoint" / "replay_buffer.npz"
    content = state.read_bytes()
    state.write_bytes(content[: len(content) // 2])
    with pytest.raises(ValueError, match="replay_buffer.npz"):
        train(resume=str(cut_off))
    assert tables(cut_off) == before, "nothing was changed"
    state.write_bytes(content)
    assert train(resume=str(cut_off)).outcome == "finished"
    with (cut_off / "training.csv").open(newline="") as file:
        assert [int(row["step"]) for row in csv.DictReader(file)] == list(range(50, 401, 50))


def test_settings_of_the_machine_do_not_change_a_run(finished: Path) -> None:
    spec, _ = specification(TrainSettings(**{**SMALL, "evaluations": 0, "steps": 150}))
    assert replace(spec, experiment="train").as_dict() == yaml.safe_load((finished / "config.yml").read_text())["run"]
