"""Worker processes that die, hang or grow: the training goes on."""

import json
import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import SubprocVecEnv

import sb3_cpm.envs.toy  # noqa: F401  (registers CPMToy-v0)
from sb3_cpm.buffers import CPMBuffer
from sb3_cpm.callbacks import ChallengerCallback
from sb3_cpm.envs.robust import RobustSubprocVecEnv
from sb3_cpm.run import TrainSettings, train

ROOT = Path(__file__).parents[1]


class Mortal(gym.Wrapper):
    """An environment that knows its process, and can be told to fail."""

    def __init__(self, env: gym.Env, limit: int = 50):
        super().__init__(env)
        self.pid = os.getpid()
        self.marker = "none"
        self.limit = limit
        self.steps = 0
        self.next_start: float | None = None

    def behave(self, how: str) -> None:
        self.marker = how

    def start_next_from(self, place: float) -> None:
        self.next_start = float(place)

    def look(self) -> Any:
        return self.observation

    def reset(self, **kwargs: Any) -> Any:
        self.steps = 0
        self.started_from, self.next_start = self.next_start, None
        self.observation, info = self.env.reset(**kwargs)
        return self.observation, info

    def step(self, action: Any) -> Any:
        if self.marker == "raise":
            raise RuntimeError("a mistake in the environment")
        if self.marker == "hang":
            time.sleep(600)
        self.steps += 1
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated, truncated or self.steps >= self.limit, info


def make(limit: int = 50, how: str = "none") -> gym.Env:
    env = Mortal(gym.make("CPMToy-v0", keys=("state",)), limit)
    env.behave(how)
    return Monitor(env)


robust = partial(RobustSubprocVecEnv, start_method="fork")  # starts fastest, and is the hardest: brothers hold copies of pipes


# what Python 3.12 says about fork; the workers use no threads of the parent
pytestmark = pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")

ACTIONS = np.full((2, 2), 0.5, dtype=np.float32)


def kill(env: RobustSubprocVecEnv, i: int) -> None:
    os.kill(env.get_attr("pid", i)[0], signal.SIGKILL)


def test_the_same_as_sb3_while_nothing_happens() -> None:
    frames = []
    for kind in (SubprocVecEnv, RobustSubprocVecEnv):
        env = kind([partial(make, 3)] * 2, start_method="fork")
        env.seed(5)
        steps: list[Any] = [env.reset()]
        for _ in range(7):
            observations, rewards, dones, infos = env.step(ACTIONS)
            steps.append(
                (observations, rewards.tolist(), dones.tolist(), [info.get("terminal_observation") for info in infos])
            )
        frames.append(str(steps))
        assert env.get_attr("limit") == [3, 3] and env.has_attr("pid") and env.env_is_wrapped(Mortal) == [True, True]
        env.close()
    assert frames[0] == frames[1]


@pytest.mark.parametrize("start_method", ["forkserver", "fork"])
def test_a_dead_worker_costs_one_episode(start_method: str) -> None:
    env = RobustSubprocVecEnv([make] * 2, start_method=start_method)
    env.seed(1)
    env.reset()
    env.set_attr("marker", "kept")
    before, _, _, _ = env.step(ACTIONS)
    kill(env, 1)
    with pytest.warns(UserWarning, match="Worker 1 died with exit code -9: a new one takes its place"):
        observations, rewards, dones, infos = env.step(ACTIONS)
    assert dones.tolist() == [False, True] and rewards[1] == 0 and rewards[0] != 0
    assert infos[1]["TimeLimit.truncated"] is True and "exit code -9" in infos[1]["worker_died"]
    np.testing.assert_array_equal(infos[1]["terminal_observation"]["state"], before["state"][1])  # type: ignore
    assert (observations["state"][1] != before["state"][1]).any()  # type: ignore[call-overload,index]
    assert env.restarts == [0, 1] and env.get_attr("marker") == ["kept", "kept"]
    # everything goes on, and whatever else is asked for
    assert not env.step(ACTIONS)[2].any()
    asks: list[Any] = [lambda: env.get_attr("limit"), env.reset, lambda: env.env_method("get_wrapper_attr", "limit")]
    for ask in asks if start_method == "fork" else []:
        kill(env, 0)
        with pytest.warns(UserWarning, match="Worker 0 died"):
            result = ask()
        assert len(result) == (1 if isinstance(result, dict) else 2)
        # a whole episode, else three deaths in a row would be too many; before it the step that says that one was lost
        for _ in range(50 if ask == env.reset else 51):
            _, _, dones, infos = env.step(ACTIONS)
        assert "episode" in infos[0]
    env.close()


def test_a_death_between_two_steps_ends_the_episode() -> None:
    """The agent must never see the last observation of one episode and the second one of another as one transition."""
    env = robust([partial(make, 50)] * 2)
    env.seed(3)
    env.reset()
    before, _, _, _ = env.step(ACTIONS)
    for _ in range(2):  # also where the new one dies before the agent was told
        kill(env, 0)
        with pytest.warns(UserWarning, match="Worker 0 died with exit code -9"):
            assert env.get_attr("steps") == [0, 1]
    first = env.env_method("look", indices=[0])[0]
    observations, rewards, dones, infos = env.step(ACTIONS)
    assert dones.tolist() == [True, False] and rewards[0] == 0 and env.get_attr("steps") == [0, 2]
    assert infos[0]["TimeLimit.truncated"] is True and "exit code -9" in infos[0]["worker_died"]
    np.testing.assert_array_equal(infos[0]["terminal_observation"]["state"], before["state"][0])  # type: ignore
    np.testing.assert_array_equal(observations["state"][0], first["state"])  # type: ignore[call-overload,index]
    assert not env.step(ACTIONS)[2].any() and env.get_attr("steps") == [1, 3]
    # a reset begins a new episode anyway
    kill(env, 1)
    with pytest.warns(UserWarning, match="Worker 1 died"):
        env.get_attr("steps")
    env.reset()
    assert not env.step(ACTIONS)[2].any() and env.get_attr("steps") == [1, 1]
    env.close()


def test_a_start_that_was_asked_for_survives_its_worker() -> None:
    env = robust([partial(make, 3)] * 2, episodes_per_worker=2)
    env.seed(3)
    env.reset()
    starts = []
    for number in range(5):  # workers are replaced after the second and the fourth episode
        env.env_method("start_next_from", float(number), indices=[0])
        for _ in range(3):
            _, _, dones, _ = env.step(ACTIONS)
        assert dones.all()
        starts.append(env.get_attr("started_from"))
    assert starts == [[float(number), None] for number in range(5)]

    def lost(ask: Callable[[], Any]) -> list[Any]:
        kill(env, 0)
        with pytest.warns(UserWarning, match="Worker 0 died"):
            ask()
        return env.get_attr("started_from", 0)

    # it is for one episode only, whoever dies when
    assert lost(lambda: env.step(ACTIONS)) == [None]
    env.env_method("start_next_from", 7.0, indices=[0])
    assert lost(lambda: env.step(ACTIONS)) == [7.0]
    for _ in range(3):
        env.step(ACTIONS)
    assert env.get_attr("started_from", 0) == [None]
    lost(lambda: env.env_method("start_next_from", 8.0, indices=[0]))  # noticed by the question
    env.step(ACTIONS)
    assert env.get_attr("started_from", 0) == [8.0]
    for _ in range(3):
        env.step(ACTIONS)
    assert env.get_attr("started_from", 0) == [None]
    lost(lambda: env.get_attr("limit"))
    env.env_method("start_next_from", 9.0, indices=[0])  # the episode that was lost is still "the one that is running"
    env.step(ACTIONS)
    assert env.get_attr("started_from", 0) == [9.0]
    env.env_method("start_next_from", 10.0, indices=[0])
    assert lost(env.reset) == [10.0]
    for _ in range(3):
        env.step(ACTIONS)
    # the agent may also begin anew instead of being told
    lost(lambda: env.env_method("start_next_from", 11.0, indices=[0]))
    env.reset()
    assert env.get_attr("started_from", 0) == [11.0]
    env.env_method("start_next_from", 12.0, indices=[0])
    lost(lambda: env.get_attr("limit"))
    env.reset()
    assert env.get_attr("started_from", 0) == [12.0]
    env.close()


@pytest.mark.filterwarnings("ignore:Worker 0 died")
def test_a_wrong_start_is_forgotten() -> None:
    """Its worker dies of it; the next one must not."""
    env = robust([make])
    env.seed(3)
    env.reset()
    with pytest.raises(RuntimeError, match="died, too, when it was asked for 'env_method'"):
        env.env_method("start_next_from", "nowhere")
    assert env.step(ACTIONS[:1])[2].all()
    env.env_method("start_next_from", 2.0)
    env.reset()
    assert env.get_attr("started_from") == [2.0]
    env.close()


def test_what_cannot_be_sent_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_cpm.envs.robust.CLOSING", 60.0)
    env = robust([make])
    env.reset()
    with pytest.raises((AttributeError, pickle.PicklingError), match="pickle"):
        env.set_attr("limit", lambda: 3)
    begin = time.monotonic()
    env.close()
    assert time.monotonic() - begin < 30


def test_a_worker_that_hangs() -> None:
    env = robust([make] * 2, timeout=4)
    env.reset()
    env.env_method("behave", "hang", indices=[0])
    with pytest.warns(UserWarning, match="Worker 0 gave no answer for 4 s"):
        _, _, dones, _ = env.step(ACTIONS)
    assert dones.tolist() == [True, False]
    env.close()


@pytest.mark.filterwarnings("ignore:Worker 0 died")
def test_a_mistake_is_not_repeated_for_ever() -> None:
    env = robust([partial(make, how="raise")])
    env.reset()
    env.step(ACTIONS[:1]), env.step(ACTIONS[:1])
    with pytest.raises(RuntimeError, match="3 deaths without a finished episode"):
        env.step(ACTIONS[:1])
    env.close()


@pytest.mark.filterwarnings("ignore:Worker 1 died")
def test_closing_after_the_last_death(monkeypatch: pytest.MonkeyPatch) -> None:
    """One has answered, one is dead, one has an answer that nobody took, one will never answer: none of them is waited for."""
    monkeypatch.setattr("sb3_cpm.envs.robust.CLOSING", 2.0)
    env = robust([make, partial(make, how="raise"), make, make])
    env.reset()
    actions = np.full((4, 2), 0.5, dtype=np.float32)
    env.step(actions), env.step(actions)
    env.env_method("behave", "hang", indices=[3])
    with pytest.raises(RuntimeError, match="Worker 1 died"):
        env.step(actions)
    processes = [worker.process for worker in env.workers]
    start = time.monotonic()
    env.close()
    assert time.monotonic() - start < 20 and not any(process.is_alive() for process in processes)


def broken() -> gym.Env:
    raise RuntimeError("no such task")


def test_an_environment_that_cannot_be_made() -> None:
    with pytest.raises(RuntimeError, match="died while it made its environment"):
        robust([broken])


def test_workers_are_replaced_after_some_episodes() -> None:
    env = robust([partial(make, 2), partial(make, 5)], episodes_per_worker=2)
    env.seed(0)
    env.reset()
    pids, starts = [env.get_attr("pid")], set()
    for step in range(1, 9):
        observations, _, dones, infos = env.step(ACTIONS)
        assert dones.tolist() == [step % 2 == 0, step % 5 == 0]  # no episode is cut
        assert ["episode" in info for info in infos] == dones.tolist()
        if dones[0]:
            starts.add(observations["state"][0].tobytes())  # type: ignore[call-overload,index]
            pids.append(env.get_attr("pid"))
    first = [pid for pid, _ in pids]
    assert first[0] == first[1] != first[2] == first[3] != first[4] and len(starts) == 4
    assert len({pid for _, pid in pids}) == 1 and env.restarts == [0, 0]
    env.close()


@pytest.mark.parametrize("kwargs", [{"episodes_per_worker": 0}, {"timeout": 0.0}])
def test_numbers_of_no_use(kwargs: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=f"{next(iter(kwargs))} must be"):
        robust([make], **kwargs)


class Killer(BaseCallback):
    """Kills a worker in the middle of an episode, twice."""

    def _on_step(self) -> bool:
        if self.num_timesteps in (120, 260):
            kill(self.training_env.unwrapped, 1)  # type: ignore[arg-type]
        return True


@pytest.mark.filterwarnings("ignore:Worker 1 died")
def test_the_whole_method_survives_the_death_of_a_worker() -> None:
    env = robust([make] * 2)
    model = SAC(
        "MultiInputPolicy",
        env,
        replay_buffer_class=CPMBuffer,
        buffer_size=2000,
        learning_starts=110,
        train_freq=8,
        batch_size=16,
        policy_kwargs={"net_arch": [16]},
        device="cpu",
        seed=0,
    )
    preset = {"batch_size": 2, "sequence_length": 5}
    challenger = ChallengerCallback(preset=preset, train_freq=50)
    model.learn(400, callback=[challenger, Killer()])
    assert model.num_timesteps == 400 and env.restarts == [0, 2]
    buffer: Any = model.replay_buffer
    # worker 0: four whole episodes; worker 1: cut where it was killed, after 60 and 130 steps
    lengths = [(episode.env_idx, episode.length) for episode in buffer.episodes]
    assert [length for i, length in lengths if i == 0] == [50, 50, 50, 50]
    assert [length for i, length in lengths if i == 1] == [50, 11, 50, 20, 50]
    assert np.isfinite(buffer.sample(64, env=None).rewards.numpy()).all()
    env.close()


def test_make_vec_env_of_sb3_makes_it() -> None:
    kwargs = {"start_method": "fork", "episodes_per_worker": 5}
    env = make_vec_env("CPMToy-v0", 2, seed=1, vec_env_cls=RobustSubprocVecEnv, vec_env_kwargs=kwargs)
    assert env.env_is_wrapped(Monitor) == [True, True] and env.reset()["state"].shape == (2, 4)  # type: ignore
    env.close()
    env.close()  # once more does no harm


# ---------------------------------------------------------------------- in a training run
SMALL: dict[str, Any] = {
    "env": "CPMToy-v0",
    "n_envs": 2,
    "learning_starts": 100,
    "batch_size": 16,
    "train_freq": 10,
    "evaluations": 0,
    "video": False,
    "progress_bar": False,
    "callback_kwargs": {"challenger_kwargs": {"batch_size": 4, "sequence_length": 16, "imagination_starts": 8, "horizon": 5}},
}


class KillsAt(BaseCallback):
    def __init__(self, step: int) -> None:
        super().__init__()
        self.step = step
        self.restarts: list[int] = []

    def _on_step(self) -> bool:
        env: Any = self.training_env.unwrapped
        if self.num_timesteps == self.step:
            env.workers[1].process.kill()
        self.restarts = env.restarts
        return True


@pytest.mark.slow
def test_a_training_run_goes_on_without_a_worker_that_died(tmp_path: Path) -> None:
    killer = KillsAt(130)
    with pytest.warns(UserWarning, match=r"Worker 1 died with exit code -9"):
        summary = train(TrainSettings(steps=300, run_folder=str(tmp_path / "run"), **SMALL), callback=killer)
    assert killer.restarts == [0, 1]
    assert summary.steps == 300 and summary.outcome == "finished"


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="groups of processes")
def test_ctrl_c_in_a_training_run_with_workers(tmp_path: Path) -> None:
    """A terminal sends it to all processes at once: the workers wait for the end, nobody takes their silence for a death."""
    code = (
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from sb3_cpm.run import TrainSettings, train\n"
        "if __name__ == '__main__': train(TrainSettings(steps=100_000, run_folder=sys.argv[1], **eval(sys.argv[2])))\n"
    )
    (tmp_path / "run.py").write_text(code)
    folder = tmp_path / "run"
    child = subprocess.Popen(
        [sys.executable, str(tmp_path / "run.py"), str(folder), repr(SMALL)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])},
    )
    deadline = time.monotonic() + 600
    episodes = folder / "training.csv"
    while not (episodes.exists() and len(episodes.read_text().splitlines()) > 3):
        assert child.poll() is None and time.monotonic() < deadline
        time.sleep(0.2)
    os.killpg(child.pid, signal.SIGINT)
    _, errors = child.communicate(timeout=600)
    assert "KeyboardInterrupt" in errors and "died" not in errors and "Process ForkServer" not in errors, errors
    assert json.loads((folder / "summary.json").read_text())["outcome"] == "stopped by Ctrl-C"
    for _ in range(600):
        try:
            os.killpg(child.pid, 0)
        except ProcessLookupError:
            return
        time.sleep(0.1)
    pytest.fail("some of its processes are still there")
