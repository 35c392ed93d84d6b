"""People's own runs, which stop anywhere and go on: CheckpointCPMCallback and resume()."""

import json
import logging
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from file_helpers import StopsAt, files_of_at_most
from gymnasium import spaces
from sb3_contrib import TQC
from stable_baselines3 import DDPG, PPO, SAC, TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import VecEnv, VecNormalize, unwrap_vec_normalize

from sb3_cpm import ChallengerCallback, CheckpointCPMCallback, CPMBuffer, resume
from sb3_cpm import checkpoint as checkpoints
from sb3_cpm.dreamer import Dreamer, Plan2Explore
from sb3_cpm.files import DamagedRunError, locked, write_archive

SMALL: dict[str, Any] = dict(
    batch_size=2, sequence_length=8, cnn_depth=4, vector_units=8, stoch_size=4, deter_size=8, hidden_size=8, head_units=8,
    actor_units=8, critic_units=8, horizon=3, imagination_starts=4,
)  # fmt: skip
LENIENT = dict(filter_kwargs=dict(novelty_tolerance=1e5, relevance_tolerance=1e5))


def toy(n_envs: int = 1, normalized: bool = False, keys: tuple[str, ...] = ("state",)) -> VecEnv:
    env: VecEnv = make_vec_env("sb3_cpm.envs.toy:CPMToy-v0", n_envs, seed=0, env_kwargs=dict(keys=keys))
    return VecNormalize(env, norm_obs_keys=["state"]) if normalized else env


def make(env: VecEnv | None = None, kind: type[BaseAlgorithm] = SAC, **kwargs: Any) -> Any:
    arguments: dict[str, Any] = dict(seed=0, device="cpu", policy_kwargs=dict(net_arch=[8]))
    if kind is not PPO:
        arguments |= dict(learning_starts=100, batch_size=8, buffer_size=2000)
        arguments |= dict(replay_buffer_class=CPMBuffer, replay_buffer_kwargs=LENIENT)
    return kind("MultiInputPolicy", toy() if env is None else env, **{**arguments, **kwargs})  # type: ignore[arg-type]


def challenger(**kwargs: Any) -> ChallengerCallback:
    return ChallengerCallback(**{"train_freq": 10, "challenger_kwargs": SMALL, "decay_steps": 600, **kwargs})


def of_model(model: Any) -> dict[str, Any]:
    found = {f"{name}.{key}": value for name, state in model.get_parameters().items() for key, value in flat(state).items()}
    if getattr(model, "log_ent_coef", None) is not None:
        found["log_ent_coef"] = model.log_ent_coef.detach()
    found["counters"] = (model.num_timesteps, model._n_updates, model._episode_num)
    normalize = unwrap_vec_normalize(model.get_env())
    if normalize is not None:
        found["normalize"] = [(one.mean, one.var, one.count) for one in (normalize.ret_rms, normalize.obs_rms["state"])]
    return found


def flat(value: Any, name: str = "") -> dict[str, Any]:
    if isinstance(value, dict):
        return {key: part for name_, inner in value.items() for key, part in flat(inner, f"{name}.{name_}").items()}
    if isinstance(value, (list, tuple)):
        return flat(dict(enumerate(value)), name)
    return {name: value}


def assert_equal(ours: Any, theirs: Any) -> None:
    ours, theirs = flat(ours), flat(theirs)
    assert list(ours) == list(theirs)
    for name, one in ours.items():
        other = theirs[name]
        same = np.array_equal(np.asarray(one), np.asarray(other), equal_nan=np.asarray(one).dtype.kind == "f")
        assert same, f"{name}: {one} and {other}"


def assert_same_buffer(ours: Any, theirs: Any, folder: Path) -> None:
    """What is written into files is all that a buffer holds."""
    ours.save(folder / "ours.npz")
    theirs.save(folder / "theirs.npz")
    with np.load(folder / "ours.npz") as one, np.load(folder / "theirs.npz") as other:
        assert one.files == other.files
        for name in one.files:
            if name == "content.json":
                mine, yours = json.loads(one[name]), json.loads(other[name])
                del mine["spaces"], yours["spaces"]  # with generators of which a buffer draws nothing
                assert_equal(mine, yours)
            else:
                assert np.array_equal(one[name], other[name]), name


def assert_same_challenger(ours: ChallengerCallback, theirs: ChallengerCallback) -> None:
    assert ours.challenger is not None and ours.challenger.trained_updates > 10
    assert_equal(ours.state_dict(), theirs.state_dict())


def random_states() -> tuple[Any, ...]:
    return np.random.get_state()[1].tolist(), th.get_rng_state().tolist()  # type: ignore[index]


# ---------------------------------------------------------------------- as an unbroken run


@pytest.mark.parametrize("stop", [180, 470])
@pytest.mark.parametrize("n_envs, normalized", [(1, False), (2, True)])
def test_a_killed_run_that_goes_on_is_the_unbroken_one(n_envs: int, normalized: bool, stop: int, tmp_path: Path) -> None:
    """180: learn() came to its end there; 470: killed, and all is lost back to the checkpoint at 360, amid an episode."""

    def callbacks(folder: str, callback: ChallengerCallback) -> list[BaseCallback]:
        return [callback, CheckpointCPMCallback(180 // n_envs, tmp_path / folder, exact=True)]

    kwargs = dict(train_freq=4, learning_starts=100 * n_envs)
    unbroken, callback = make(toy(n_envs, normalized), **kwargs), challenger()
    unbroken.learn(600, callback=callbacks("unbroken", callback))

    broken, first = make(toy(n_envs, normalized), **kwargs), challenger()
    if stop == 180:
        broken.learn(180, callback=callbacks("broken", first))
    else:
        with pytest.raises(InterruptedError):
            broken.learn(600, callback=[*callbacks("broken", first), StopsAt(stop)])
    np.random.seed(7)  # another process begins otherwise
    th.manual_seed(7)
    model, again = resume(tmp_path / "broken", toy(n_envs, normalized))
    assert (
        type(model) is SAC
        and model.num_timesteps == {(1, 180): 180, (2, 180): 184, (1, 470): 360, (2, 470): 360}[n_envs, stop]
    )
    model.learn(600 - model.num_timesteps, callback=callbacks("broken", again), reset_num_timesteps=False)

    assert_equal(of_model(unbroken), of_model(model))
    assert_same_buffer(unbroken.replay_buffer, model.replay_buffer, tmp_path)  # type: ignore[attr-defined]
    assert unbroken.replay_buffer.challenges, "else this shows little"
    assert_same_challenger(callback, again)


@pytest.mark.parametrize("kind", [Dreamer, Plan2Explore])
def test_world_models_go_on_as_unbroken_ones(kind: Any, tmp_path: Path) -> None:
    def make_one() -> Any:
        return kind(
            "MultiInputPolicy", toy(), seed=0, device="cpu", preset=SMALL, train_freq=20, learning_starts=60,
            pretrain_steps=0, buffer_size=1000,
        )  # fmt: skip

    def saver(folder: str) -> CheckpointCPMCallback:
        return CheckpointCPMCallback(100, tmp_path / folder, exact=True)

    unbroken = make_one().learn(200, callback=saver("unbroken"))
    with pytest.raises(InterruptedError):
        make_one().learn(200, callback=[saver("broken"), StopsAt(170)])
    model, nothing = resume(tmp_path / "broken", toy())
    assert nothing is None and type(model) is kind
    model.learn(100, callback=saver("broken"), reset_num_timesteps=False)
    assert_equal(of_model(unbroken), of_model(model))
    assert_same_buffer(unbroken.replay_buffer, model.replay_buffer, tmp_path)


@pytest.mark.parametrize("kind", [TD3, DDPG, TQC, PPO])
def test_all_of_it_comes_back(kind: Any, tmp_path: Path) -> None:
    """Without `exact`, checkpoints change nothing of a run, and what comes back is all that there was at the last one."""
    kwargs: dict[str, Any] = dict(n_steps=50, batch_size=10) if kind is PPO else dict(train_freq=7)
    if kind in (TD3, DDPG):
        kwargs["action_noise"] = NormalActionNoise(np.zeros(2), np.ones(2))
    end = 300 if kind is PPO else 301
    callback = None if kind is PPO else challenger()
    model = make(kind=kind, **kwargs)
    model.learn(end, callback=[one for one in (callback, CheckpointCPMCallback(150, tmp_path)) if one is not None])
    states = random_states()
    plain = make(kind=kind, **kwargs).learn(end, callback=None if callback is None else challenger())
    assert_equal(of_model(plain), of_model(model))

    np.random.seed(7)
    again, other = resume(tmp_path, toy())
    assert random_states() == states
    assert_equal(of_model(model), of_model(again))
    if callback is None:
        assert other is None
    else:
        assert_same_challenger(callback, other)
        assert other.arguments == {**callback.arguments, "load_path": None}
        assert again.replay_buffer.coefficients == model.replay_buffer.coefficients
        assert len(again.replay_buffer.challenges) == len(model.replay_buffer.challenges) > 0
    again.learn(50, callback=other, reset_num_timesteps=False)


def test_buffers_of_sb3s_own(tmp_path: Path) -> None:
    model = make(replay_buffer_class=None, replay_buffer_kwargs=None, train_freq=4)
    model.learn(240, callback=CheckpointCPMCallback(100, tmp_path))
    again, nothing = resume(tmp_path, toy())
    assert nothing is None
    assert_equal(vars(model.replay_buffer)["observations"], vars(again.replay_buffer)["observations"])
    again.learn(20, reset_num_timesteps=False)


def test_resumed_environments_do_not_begin_with_the_same_start_states(tmp_path: Path) -> None:
    model = make().learn(120, callback=[challenger(), CheckpointCPMCallback(100, tmp_path)])
    first = model.replay_buffer.observations["state"][0, 0].copy()
    again, callback = resume(tmp_path, toy())
    again.learn(10, callback=callback, reset_num_timesteps=False)
    assert not np.array_equal(again.replay_buffer.observations["state"][120, 0], first)
    assert again.replay_buffer.episodes[-1].length == 20, "the running episode ended where it was"


def test_killed_before_the_first_episode_ended(tmp_path: Path) -> None:
    with pytest.raises(InterruptedError):
        make(learning_starts=60).learn(100, callback=[challenger(), CheckpointCPMCallback(20, tmp_path), StopsAt(45)])
    model, callback = resume(tmp_path, toy())
    model.learn(60, callback=callback, reset_num_timesteps=False)
    assert model.num_timesteps == 100


def test_the_example_of_the_documentation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Killed at 250, run once more, and run once more when it is finished."""
    text = (Path(__file__).parents[1] / "docs/files.md").read_text(encoding="utf-8")
    example = text.split("## A run of your own")[1].split("```python\n")[1].split("```")[0]
    monkeypatch.chdir(tmp_path)
    killed = example.replace("[challenger, saver]", "[challenger, saver, StopsAt(250)]")
    assert killed != example
    with pytest.raises(InterruptedError):
        exec(killed, {"StopsAt": StopsAt})
    for before in (200, 400):
        assert resume("runs/mine", toy())[0].num_timesteps == before
        exec(example, {})


# ---------------------------------------------------------------------- the disk, and what is not worth saving


def test_when_it_saves(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    """Every 100 calls of env.step() of two environments, at the beginning of the next rollout, and at the end."""
    model = make(toy(2), train_freq=60, learning_starts=1000)
    model.learn(700, callback=[challenger(), CheckpointCPMCallback(100, tmp_path, verbose=2)])
    told = [int(line.split(" step ")[1].split()[0]) for line in capsys.readouterr().out.splitlines()]
    assert told == [240, 480, 600, 720]
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint"]


def test_a_full_disk_is_told_and_tried_again(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    class Frees(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps == 70:
                disk.__exit__(None, None, None)
            return True

    model, disk = make(), files_of_at_most(5_000)
    with caplog.at_level(logging.WARNING):
        disk.__enter__()
        model.learn(120, callback=[challenger(), CheckpointCPMCallback(50, tmp_path), Frees()])
    assert len(caplog.messages) == 1 and "\n" not in caplog.messages[0]
    assert caplog.messages[0].startswith("No checkpoint at step 50, the run goes on: ")
    assert "model.zip cannot be written: File too large" in caplog.messages[0]
    assert resume(tmp_path, toy())[0].num_timesteps == 120


@pytest.mark.parametrize("what", ["player", "challenger"])
def test_weights_that_are_not_finite_do_not_replace_good_ones(
    what: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    model, callback = make(), challenger()
    saver = CheckpointCPMCallback(1000, tmp_path)
    model.learn(110, callback=[callback, saver])
    assert callback.challenger is not None
    broken = model.critic_target if what == "player" else callback.challenger.world_model.decoder
    with th.no_grad():  # where nothing that acts looks
        next(broken.parameters()).view(-1)[0] = th.nan
    model.learning_starts = 10_000
    model.learn(10, callback=[callback, saver], reset_num_timesteps=False)
    assert "No checkpoint at step 120" in caplog.text and "is not finite" in caplog.text
    assert resume(tmp_path, toy())[0].num_timesteps == 110


def test_two_processes_do_not_write_one_folder(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with locked(tmp_path):
        make().learn(20, callback=[challenger(), CheckpointCPMCallback(10, tmp_path)])
    assert "is being written by another process" in caplog.text and not list(tmp_path.iterdir())


def test_killed_while_one_checkpoint_took_the_place_of_the_other(tmp_path: Path) -> None:
    model, callback = make(), challenger()
    saver = CheckpointCPMCallback(50, tmp_path)
    model.learn(60, callback=[callback, saver])
    (tmp_path / "checkpoint").rename(tmp_path / "checkpoint.old")
    again, callback = resume(tmp_path, toy())
    assert again.num_timesteps == 60
    again.learn(50, callback=[callback, saver], reset_num_timesteps=False)
    assert [path.name for path in tmp_path.iterdir()] == ["checkpoint"]


# ---------------------------------------------------------------------- bad input


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("run")
    make(toy(2)).learn(120, callback=[challenger(), CheckpointCPMCallback(50, folder)])
    return folder


def test_arguments(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="save_freq must be an integer of at least 1, got 0"):
        CheckpointCPMCallback(0, tmp_path)
    with pytest.raises(ValueError, match="on_sigterm"):
        CheckpointCPMCallback(10, tmp_path, on_sigtrm=True)  # type: ignore[call-arg]
    with pytest.raises(ValueError, match=r"exact=True\) begins afresh from the model's seed, but it has none: SAC\("):
        make(seed=None).learn(10, callback=[challenger(), CheckpointCPMCallback(10, tmp_path, exact=True)])
    (tmp_path / "file").touch()
    with pytest.raises(ValueError, match="is a file: expected the name of a folder"):
        make().learn(10, callback=[challenger(), CheckpointCPMCallback(10, tmp_path / "file")])


def test_folders_without_a_checkpoint(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="There is no checkpoint in .*nowhere: there is no such folder"):
        resume(tmp_path / "nowhere", toy())
    with pytest.raises(ValueError, match="it holds nothing"):
        resume(tmp_path, toy())
    make().learn(20, callback=[challenger(), CheckpointCallback(10, str(tmp_path))])
    with pytest.raises(ValueError, match=r"it holds rl_model_10_steps.zip, rl_model_20_steps.zip. .*SAC.load\(path"):
        resume(tmp_path, toy())
    (tmp_path / "checkpoint.new").mkdir()
    with pytest.raises(ValueError, match=r"only half a one, checkpoint.new, without state.npz"):
        resume(tmp_path, toy())


def copied(saved: Path, tmp_path: Path) -> Path:
    for path in (saved / "checkpoint").iterdir():
        target = tmp_path / "checkpoint" / path.name
        target.parent.mkdir(exist_ok=True)
        target.write_bytes(path.read_bytes())
    return tmp_path / "checkpoint"


def test_checkpoints_that_are_not_whole(saved: Path, tmp_path: Path) -> None:
    checkpoint = copied(saved, tmp_path)
    with pytest.raises(ValueError, match=r"is the checkpoint itself, .*: resume\('.*', env\)"):
        resume(checkpoint, toy(2))
    assert resume(tmp_path, toy(2))[0].num_timesteps == 120
    for name in ("model.zip", "challenger0.pt", "replay_buffer.npz"):
        content = (checkpoint / name).read_bytes()
        (checkpoint / name).write_bytes(content[:500] + b"x" + content[501:])
        with pytest.raises(DamagedRunError, match=f"{name} is damaged.* Remove .*checkpoint to begin the run anew"):
            resume(tmp_path, toy(2))
        (checkpoint / name).unlink()
        with pytest.raises(DamagedRunError, match=f"is half a checkpoint: {name} is gone. Remove"):
            resume(tmp_path, toy(2))
        (checkpoint / name).write_bytes(content)
    (checkpoint / "state.npz").unlink()
    with pytest.raises(ValueError, match="only half a one, checkpoint, without state.npz"):
        resume(tmp_path, toy(2))
    write_archive(checkpoint / "state.npz", {"extra": {}}, {})
    with pytest.raises(DamagedRunError, match="was written by an earlier sb3_cpm"):
        resume(tmp_path, toy(2))


def test_other_environments(saved: Path) -> None:
    with pytest.raises(ValueError, match=r"observation space is Dict\('state'.*, that of `env` is Dict\('camera'"):
        resume(saved, toy(2, keys=("camera", "state")))
    with pytest.raises(ValueError, match=r"action space is Box\(.*\(2,\).*, that of `env` is Box\(.*\(3,\)"):
        resume(saved, make_vec_env(ThreeActions, 2))
    with pytest.raises(ValueError, match=r"was made in 2 environments, `env` has 1: .*make_vec_env\(..., n_envs=2\)"):
        resume(saved, toy(1))
    with pytest.raises(ValueError, match="was made without a VecNormalize: give it the environment without"):
        resume(saved, toy(2, normalized=True))


class ThreeActions(gym.Wrapper):
    def __init__(self) -> None:
        super().__init__(gym.make("CPMToy-v0", keys=("state",)))
        self.action_space = spaces.Box(-1, 1, (3,), np.float32)


def test_a_normalized_run_in_an_environment_that_is_not(tmp_path: Path) -> None:
    make(toy(normalized=True)).learn(20, callback=[challenger(), CheckpointCPMCallback(10, tmp_path)])
    with pytest.raises(ValueError, match=r"was made with a VecNormalize: give it VecNormalize\(env, ...\)"):
        resume(tmp_path, toy())


OWN_POLICY = """
from stable_baselines3 import SAC
from stable_baselines3.sac.policies import MultiInputPolicy
class MyPolicy(MultiInputPolicy):
    pass
class MySAC(SAC):
    pass
"""


def test_classes_that_cannot_be_imported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "my_classes.py").write_text(OWN_POLICY)
    monkeypatch.syspath_prepend(tmp_path)
    import my_classes  # type: ignore[import-not-found]

    mine, policy = my_classes.MySAC, my_classes.MyPolicy
    model = mine(policy, toy(), replay_buffer_class=CPMBuffer, buffer_size=500, device="cpu")
    model.learn(20, callback=[challenger(), CheckpointCPMCallback(10, tmp_path / "run")])
    assert type(resume(tmp_path / "run", toy())[0]) is mine
    monkeypatch.undo()
    del sys.modules["my_classes"]
    with pytest.raises(ValueError, match=r"of the class MySAC of my_classes, which cannot .* model_class=MySAC\)"):
        resume(tmp_path / "run", toy())
    with pytest.raises(ValueError, match=r"a part in the module 'my_classes', .*custom_objects=\{\"policy_class\": MyPolicy"):
        resume(tmp_path / "run", toy(), model_class=mine)
    again, _ = resume(tmp_path / "run", toy(), model_class=mine, custom_objects={"policy_class": policy})
    assert type(again.policy) is policy and again.num_timesteps == 20


def test_a_callback_that_no_file_can_hold(tmp_path: Path) -> None:
    def decay(remaining: float) -> float:
        return 0.5 * remaining

    make().learn(20, callback=[challenger(decay=decay), CheckpointCPMCallback(10, tmp_path)])
    with pytest.raises(ValueError, match=r"a function or class as decay, .*callback=ChallengerCallback\(...\)\)"):
        resume(tmp_path, toy())
    given = challenger(decay=decay)
    assert resume(tmp_path, toy(), given)[1] is given
    with pytest.raises(ValueError, match="world_model"):
        resume(tmp_path, toy(), challenger(challenger_kwargs={**SMALL, "hidden_size": 9}))


def test_a_challenger_where_there_was_none(tmp_path: Path) -> None:
    make(replay_buffer_kwargs=dict(challenge_ratio=0)).learn(20, callback=CheckpointCPMCallback(10, tmp_path))
    with pytest.raises(ValueError, match="was made without a challenger: leave out `callback`"):
        resume(tmp_path, toy(), challenger())


def test_a_run_that_begins_does_not_replace_another_ones_checkpoint(saved: Path, tmp_path: Path) -> None:
    copied(saved, tmp_path)
    with pytest.raises(ValueError, match=r"of a run at step 120, and this model is at step 0: resume\('.*', env\) goes on"):
        make(toy(2)).learn(20, callback=[challenger(), CheckpointCPMCallback(10, tmp_path)])
    assert resume(tmp_path, toy(2))[0].num_timesteps == 120


def test_checkpoints_of_other_runners(tmp_path: Path) -> None:
    checkpoints.save_checkpoint(tmp_path, make(), [], {"tables": {}})
    with pytest.raises(ValueError, match="was not made by CheckpointCPMCallback"):
        resume(tmp_path, toy())


# ---------------------------------------------------------------------- SIGTERM


SCRIPT = """
import os, signal, sys
sys.path.insert(0, {tests!r})
from test_checkpoint import *

class Terminates(BaseCallback):
    def _on_step(self):
        if self.num_timesteps == 170:
            os.kill(os.getpid(), signal.SIGTERM)
        return True

def handler(*_):
    print("the user's own", flush=True)

signal.signal(signal.SIGTERM, handler)
try:
    make(train_freq=20).learn(400, callback=[
        challenger(), CheckpointCPMCallback(100, sys.argv[1], exact=sys.argv[2] == "exact", on_sigterm=True), Terminates()
    ])
finally:
    assert signal.getsignal(signal.SIGTERM) is handler
print("not reached")
"""


@pytest.mark.parametrize("how, step", [("as it is", 180), ("exact", 100)])
def test_sigterm_leaves_a_whole_checkpoint(how: str, step: int, tmp_path: Path) -> None:
    """At the end of the rollout; where a fresh start there would be another run, that of before."""
    script = SCRIPT.format(tests=str(Path(__file__).parent))
    child = subprocess.run([sys.executable, "-c", script, tmp_path, how], capture_output=True, text=True, timeout=600)
    assert child.returncode == 143 and not child.stdout and not child.stderr, child
    model, callback = resume(tmp_path, toy())
    assert model.num_timesteps == step
    model.learn(20, callback=callback, reset_num_timesteps=False)


def test_sigterm_after_a_learn_that_failed_is_for_who_was_there_before(tmp_path: Path) -> None:
    heard: list[int] = []
    before = signal.signal(signal.SIGTERM, lambda signum, frame: heard.append(signum))
    try:
        ours = signal.getsignal(signal.SIGTERM)
        for _ in range(2):
            with pytest.raises(InterruptedError):
                saver = CheckpointCPMCallback(10, tmp_path, on_sigterm=True)
                make().learn(40, callback=[challenger(), saver, StopsAt(5)])
        os.kill(os.getpid(), signal.SIGTERM)
        assert heard == [signal.SIGTERM] and signal.getsignal(signal.SIGTERM) is ours
        make().learn(5, callback=[challenger(), CheckpointCPMCallback(10, tmp_path, on_sigterm=True)])
        assert signal.getsignal(signal.SIGTERM) is ours
    finally:
        signal.signal(signal.SIGTERM, before)


def test_sigterm_is_for_the_main_thread(tmp_path: Path) -> None:
    caught: list[BaseException] = []

    def learn() -> None:
        try:
            with pytest.warns(UserWarning, match="SIGTERM is not listened to"):
                make().learn(20, callback=[challenger(), CheckpointCPMCallback(10, tmp_path, on_sigterm=True)])
        except BaseException as error:
            caught.append(error)

    thread = threading.Thread(target=learn)
    thread.start()
    thread.join()
    assert not caught and (tmp_path / "checkpoint").exists()
