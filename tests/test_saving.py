"""What is saved of a run comes back with every attribute, and nothing that is read executes."""

import json
import os
import pickle
import subprocess
import sys
import types
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
import yaml
from challenger_helpers import VECTOR, random_batch, small
from file_helpers import Touch, files_of_at_most
from gymnasium import spaces
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.envs import BitFlippingEnv
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecNormalize
from stable_baselines3.her.her_replay_buffer import HerReplayBuffer

import sb3_cpm.envs.toy  # noqa: F401  (registers CPMToy-v0)
from sb3_cpm import checkpoint as checkpoints
from sb3_cpm import files
from sb3_cpm.__main__ import main
from sb3_cpm.buffers import CPMBuffer, Demonstration
from sb3_cpm.challenger import Challenger
from sb3_cpm.challenges import ChallengeCurator
from sb3_cpm.challenges.state import restored, state_of
from sb3_cpm.checkpoint import save_model
from sb3_cpm.files import NotFiniteError
from sb3_cpm.run import train
from sb3_cpm.run.watch import watch
from sb3_cpm.type_aliases import Evaluation

ROOT = Path(__file__).parents[1]
SPACE = spaces.Dict(
    {
        "cloud": spaces.Box(-np.inf, np.inf, (5, 6), np.float32),
        "camera": spaces.Box(0, 255, (4, 4, 3), np.uint8),
        "state/%": spaces.Box(np.float64(-1), np.float64(2), (3,), np.float64),
        "number": spaces.Discrete(7, start=2),
        "several": spaces.MultiDiscrete([3, 4]),
        "bits": spaces.MultiBinary(3),
    }
)
ACTIONS = spaces.Box(np.array([-1, -2], np.float32), np.array([1, 2], np.float32))
COMPACT = {"cloud": ["float16"] * 3 + [("uint8", -1.0, 1.0)] * 3, "state/%": ("uint16", -1.0, 2.0)}
LENIENT = dict(novelty_tolerance=1e5, relevance_tolerance=1e5, highlight_tolerance=1e-5)
#: Attributes that belong to where an object is used, not to what it holds.
OF_PLACE = {"env", "_stopwatch", "_challenger_is_running", "_allocate", "_remove", "_given"}


def differences(one: Any, other: Any, name: str = "") -> Iterator[str]:
    """Of two objects, attribute by attribute, exactly: 1 is not 1.0, and NaN is NaN."""
    if type(one) is not type(other):
        yield f"{name}: {type(one)} and {type(other)}"
    elif isinstance(one, (list, tuple, deque)) or (isinstance(one, np.ndarray) and one.dtype.hasobject):
        if len(one) != len(other) or getattr(one, "maxlen", None) != getattr(other, "maxlen", None):
            yield f"{name}: lengths {len(one)} and {len(other)}"
        for index, parts in enumerate(zip(one, other, strict=False)):
            yield from differences(*parts, f"{name}[{index}]")
    elif isinstance(one, dict):
        if list(one) != list(other):
            yield f"{name}: keys {list(one)} and {list(other)}"
        for key in set(one) & set(other) - OF_PLACE:
            yield from differences(one[key], other[key], f"{name}[{key!r}]")
    elif _is_value(one):
        if _exactly(one) != _exactly(other):
            yield f"{name}: {one!r:.60} and {other!r:.60}"
    else:
        yield from differences(dict(sorted(vars(one).items())), dict(sorted(vars(other).items())), name)


def _is_value(one: Any) -> bool:
    return isinstance(one, (np.ndarray, np.random.Generator, types.FunctionType, type)) or not hasattr(one, "__dict__")


def _exactly(one: Any) -> Any:
    if isinstance(one, np.ndarray):
        return one.shape, one.dtype, one.tobytes()
    return one.bit_generator.state if isinstance(one, np.random.Generator) else repr(one)


def observation(rng: np.random.Generator, n_envs: int) -> dict[str, np.ndarray]:
    return {
        "cloud": rng.uniform(-1, 1, (n_envs, 5, 6)).astype(np.float32),
        "camera": rng.integers(0, 256, (n_envs, 4, 4, 3), dtype=np.uint8),
        "state/%": rng.uniform(-1, 2, (n_envs, 3)),
        "number": rng.integers(2, 9, n_envs),
        "several": rng.integers(0, 3, (n_envs, 2)),
        "bits": rng.integers(0, 2, (n_envs, 3), dtype=np.int8),
    }


class Player:
    """Plays random episodes into a buffer, proposes from them, and can go on with another buffer."""

    def __init__(self, n_envs: int) -> None:
        self.rng, self.n_envs = np.random.default_rng(0), n_envs
        self.observation = observation(self.rng, n_envs)

    def play(self, buffer: CPMBuffer, steps: int, propose: bool = True) -> None:
        buffer.attach_challenger()
        for _ in range(steps):
            following = observation(self.rng, self.n_envs)
            dones = self.rng.random(self.n_envs) < 0.1
            infos = [{"TimeLimit.truncated": bool(done) and i == 0, "seen": np.arange(i + 1)} for i, done in enumerate(dones)]
            actions = self.rng.uniform(-1, 1, (self.n_envs, 2)).astype(np.float32)
            buffer.add(self.observation, following, actions, self.rng.random(self.n_envs), dones, infos)
            self.observation = following
            for episode in buffer.pop_completed() if propose else ():
                n = episode.length
                evaluation = Evaluation(self.rng.random(n), self.rng.random(n), self.rng.random((n + 1, 4)))
                buffer.propose(episode, evaluation)
                for challenge in buffer.due_for_refresh()[:1]:
                    n = challenge.episode.length
                    buffer.refresh(challenge, Evaluation(self.rng.random(n), self.rng.random(n), self.rng.random((n + 1, 4))))


def demonstration(seed: int) -> Demonstration:
    rng = np.random.default_rng(seed)
    states = {key: np.concatenate([observation(rng, 1)[key] for _ in range(7)]) for key in SPACE.spaces}
    states["number"] = states["number"].reshape(7)
    return Demonstration(states, rng.uniform(-1, 1, (6, 2)), rng.random(6), terminated=seed == 0)


@pytest.mark.parametrize(
    "n_envs, kwargs",
    [
        (1, {}),
        (2, dict(storage_dtypes=COMPACT, copy_info_dict=True, refresh_every=20, mix="row", demonstration_ratio=0.2)),
        (3, dict(storage_dtypes=COMPACT, memmap=True, max_challenges=3, coefficient_kwargs=dict(initial=2.0))),
    ],
)
@pytest.mark.parametrize("steps", [0, 7, 30, 150])
def test_every_attribute_of_a_buffer_comes_back(n_envs: int, kwargs: dict[str, Any], steps: int, tmp_path: Path) -> None:
    kwargs = dict(kwargs)
    if kwargs.pop("memmap", False):
        kwargs["memmap_dir"] = str(tmp_path / "maps")
    buffer = CPMBuffer(91 * n_envs + 1, SPACE, ACTIONS, device="cpu", n_envs=n_envs, filter_kwargs=LENIENT, **kwargs)
    player = Player(n_envs)
    if steps > 7:
        buffer.add_demonstrations([demonstration(seed) for seed in range(2)])
    player.play(buffer, steps)
    player.play(buffer, min(steps, 12), propose=False)  # episodes that C has not judged yet, and one that goes on
    buffer.challenge_ratio, buffer.player_keys = 0.5, ("camera", "state/%")  # as others change them
    if steps:
        buffer.action_space.seed(3)
        buffer.observation_space["number"].seed(4)
    path = tmp_path / "buffer.npz"
    buffer.save(path)
    loaded = CPMBuffer.load(path)
    assert not list(differences(buffer, loaded)) and not list(differences(buffer._arguments(), loaded._arguments()))
    assert steps < 150 or (buffer.challenges and buffer.full and buffer.curator.filter.reward_memory is not None)
    assert (type(loaded.observations["camera"]) is np.memmap) == ("memmap_dir" in kwargs)
    if not steps:
        return
    # what is done with both is the same, from the unfinished episodes on
    again = Player(n_envs)
    again.rng.bit_generator.state = player.rng.bit_generator.state
    again.observation = player.observation
    for one, who in ((buffer, player), (loaded, again)):
        np.random.seed(0)
        who.play(one, 40)
        who.batch = [one.sample(20), one.sample_sequences(3, 9)]  # type: ignore[attr-defined]
    assert not list(differences(buffer, loaded))
    for mine, theirs in zip(player.batch, again.batch, strict=True):  # type: ignore[attr-defined]
        assert repr(mine) == repr(theirs)
    buffer.save(tmp_path / "one.npz")
    loaded.save(tmp_path / "two.npz")
    with files.Archive(tmp_path / "one.npz", "") as one, files.Archive(tmp_path / "two.npz", "") as two:
        assert one.content == two.content and all(one.array(n).tobytes() == two.array(n).tobytes() for n in one.names)


def numbers(value: Any, change: Any) -> Any:
    """The state of a curator with every number changed."""
    if isinstance(value, dict):
        return {name: numbers(part, change) for name, part in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(numbers(part, change) for part in value)
    return change(value) if isinstance(value, (bool, int, float)) or value is None else value


def test_every_number_of_the_curator_is_stored() -> None:
    """Those that a newer version adds, too: nothing here or there names them."""
    count = iter(range(1, 1000))
    curator = ChallengeCurator()
    state = numbers(state_of(curator), lambda value: not value if isinstance(value, bool) else next(count) / 7)
    restored(curator, state)
    assert not list(differences(state_of(curator), state)) and next(count) > 30
    other = restored(ChallengeCurator(), json.loads(json.dumps(state_of(curator))))
    assert not list(differences(curator, other))
    buffer = CPMBuffer(10, SPACE, ACTIONS, device="cpu")
    buffer.curator = curator
    content, _ = buffer._state()
    assert json.loads(json.dumps(content["curator"])) == state
    newer = {**state, "filter": {**state["filter"], "w4": 1.0}}
    with pytest.raises(ValueError, match=r"The saved filter has w4, unknown to this version"):
        restored(ChallengeCurator(), newer)
    del newer["filter"]["w4"], newer["filter"]["reward_memory"]
    assert restored(ChallengeCurator(), newer).filter.reward_memory is None, "what an older version did not have"


def test_what_no_file_without_pickles_can_hold_is_told(tmp_path: Path) -> None:
    class Own(spaces.Text):
        pass

    buffer = CPMBuffer(20, SPACE, ACTIONS, device="cpu", challenge_ratio=0, copy_info_dict=True)
    Player(1).play(buffer, 3)
    buffer.infos[1, 0]["who"] = object()
    with pytest.raises(ValueError, match=r"infos\[1\]\[0\]\['who'\] is a object .*without pickles cannot hold"):
        buffer.save(tmp_path / "buffer.npz")
    buffer.infos[1, 0]["who"] = "me"
    buffer.observation_space = spaces.Dict({**SPACE.spaces, "text": Own(3)})
    with pytest.raises(ValueError, match=r"observation_space\['text'\] is .*model.save_replay_buffer\(\) pickles it"):
        buffer.save(tmp_path / "buffer.npz")
    assert not list(tmp_path.iterdir())


def test_a_subclass_keeps_a_state_of_its_own(tmp_path: Path) -> None:
    class Counting(CPMBuffer):
        count = 0

        def _state(self, prefix: str = "") -> Any:
            content, arrays = super()._state(prefix)
            return {**content, "count": self.count}, arrays

        def _restore(self, content: dict[str, Any], archive: Any, prefix: str) -> None:
            super()._restore(content, archive, prefix)
            self.count = content["count"]

    buffer = Counting(10, SPACE, ACTIONS, device="cpu")
    buffer.count = 3
    buffer.save(tmp_path / "a.npz")
    assert Counting.load(tmp_path / "a.npz").count == 3
    with pytest.raises(ValueError, match="holds a Counting, not a CPMBuffer"):
        CPMBuffer.load(tmp_path / "a.npz")


def test_buffers_that_were_pickled_can_be_saved_without_pickles(tmp_path: Path) -> None:
    """Those of earlier versions do not know what they were made with; their coefficients do."""
    buffer = CPMBuffer(91, SPACE, ACTIONS, device="cpu", filter_kwargs=LENIENT, kl_ratio=0.2, max_challenges=3)
    Player(1).play(buffer, 120)
    state = buffer.__getstate__()
    del state["_given"]
    old = CPMBuffer.__new__(CPMBuffer)
    old.__setstate__(pickle.loads(pickle.dumps(state)))
    old.save(tmp_path / "a.npz")
    loaded = CPMBuffer.load(tmp_path / "a.npz")
    assert not list(differences(buffer, loaded))


# ---------------------------------------------------------------------- SB3's own, in checkpoints


def pendulum() -> gym.Env:
    return gym.make("Pendulum-v1", max_episode_steps=15)


ENVS: dict[type, Callable[[], gym.Env]] = {
    ReplayBuffer: pendulum,
    DictReplayBuffer: lambda: gym.make("CPMToy-v0", keys=["state"]),
    HerReplayBuffer: lambda: BitFlippingEnv(n_bits=3, continuous=True),
}


@pytest.mark.parametrize("kind", ENVS)
@pytest.mark.parametrize("normalized", [False, True])
def test_a_checkpoint_holds_sb3s_buffers_and_normalization(kind: type, normalized: bool, tmp_path: Path) -> None:
    policy = "MlpPolicy" if kind is ReplayBuffer else "MultiInputPolicy"
    kwargs = dict(copy_info_dict=True) if kind is HerReplayBuffer else {}

    def make() -> TD3:
        venv: VecEnv = DummyVecEnv([ENVS[kind]] * 2)
        if normalized:
            keys = ["state"] if kind is DictReplayBuffer else None
            venv = VecNormalize(venv, norm_obs=kind is not HerReplayBuffer, norm_obs_keys=keys)
        return TD3(policy, venv, replay_buffer_class=kind, replay_buffer_kwargs=kwargs, buffer_size=60, learning_starts=99)

    for steps in (20, 90):
        model = make().learn(steps)
        checkpoints.save_checkpoint(tmp_path, model, [], {"a": (1, 2)})
        other = make()
        found = checkpoints.find_checkpoint(tmp_path)
        assert found is not None
        checkpoints.restore_buffer(found, other)
        assert checkpoints.load_extra(found) == {"a": (1, 2)}
        skipped = {name: None for name in ("observation_space", "action_space")}
        mine, theirs = ({**vars(one.replay_buffer), **skipped} for one in (model, other))  # type: ignore[arg-type]
        assert not list(differences(mine, theirs))
        if normalized:
            for name in ("obs_rms", "ret_rms"):
                assert not list(differences(vars(model.env).get(name), vars(other.env).get(name), name))


# ---------------------------------------------------------------------- nothing executes


def test_nothing_that_watch_and_resume_read_can_execute(tmp_path: Path) -> None:
    done = tmp_path / "executed"
    bomb = pickle.dumps(Touch(done))
    folder = tmp_path / "run"
    folder.mkdir()
    small().save(folder / "challenger.pt")
    (folder / "replay_buffer.npz").write_bytes(bomb)
    with pytest.raises(ValueError, match="is a pickle"):
        watch(folder)
    th.save(Touch(done), folder / "challenger.pt")
    with pytest.raises(ValueError, match="is damaged or no saved challenger"):
        watch(folder)
    with pytest.raises(ValueError, match="is damaged or no saved challenger"):
        small().load_state(folder / "challenger.pt")
    for name in ("state.npz", "replay_buffer.npz", "challenger0.pt"):
        checkpoint = tmp_path / name / "checkpoint"
        checkpoint.mkdir(parents=True)
        files.write_archive(checkpoint / "state.npz", {}, {})
        (checkpoint / name).write_bytes(bomb)
        with pytest.raises(ValueError, match="is damaged or no saved"):
            checkpoints.find_checkpoint(tmp_path / name)
    assert not done.exists()
    pickle.loads(bomb)
    assert done.exists(), "that is how dangerous it is"


# ---------------------------------------------------------------------- damaged and not finite


def flip_a_bit(path: Path, rng: np.random.Generator) -> None:
    content = bytearray(path.read_bytes())
    content[rng.integers(len(content))] ^= 1 << rng.integers(8)
    path.write_bytes(content)


def test_flipped_bits_are_refused(tmp_path: Path) -> None:
    """With 50 copies of each: benchmarks/flipped_bits.py."""
    model = TD3("MlpPolicy", pendulum(), buffer_size=50, learning_starts=100, policy_kwargs={"net_arch": [4]})
    buffer = CPMBuffer(50, SPACE, ACTIONS, device="cpu")
    Player(1).play(buffer, 40)
    small().save(tmp_path / "challenger.pt")
    buffer.save(tmp_path / "buffer.npz")
    checkpoints.save_checkpoint(tmp_path, model, [], {})
    readers = {
        "challenger.pt": Challenger.load,
        "buffer.npz": CPMBuffer.load,
        "checkpoint/model.zip": lambda path: checkpoints.find_checkpoint(path.parents[1]),
        "checkpoint/state.npz": lambda path: checkpoints.find_checkpoint(path.parents[1]),
    }
    rng = np.random.default_rng(0)
    for name, read in readers.items():
        whole = (tmp_path / name).read_bytes()
        read(tmp_path / name)
        for _ in range(8):
            flip_a_bit(tmp_path / name, rng)
            with pytest.raises(ValueError, match="is damaged"):
                read(tmp_path / name)
            (tmp_path / name).write_bytes(whole)


@pytest.mark.parametrize("where", ["weight", "optimizer"])
def test_a_challenger_that_is_not_finite_is_refused_at_load(where: str, tmp_path: Path, monkeypatch: Any) -> None:
    challenger, path = small(), tmp_path / "challenger.pt"
    challenger.train(random_batch(VECTOR, 2))
    with th.no_grad():
        if where == "weight":
            challenger.world_model.reward_head[0].weight[0, 1] = th.nan
        else:
            adam = challenger.optimizers["world_model"].adam
            next(iter(adam.state.values()))["exp_avg"].view(-1)[0] = th.inf
    with pytest.raises(NotFiniteError, match="The challenger is not saved"):
        challenger.save(path)
    monkeypatch.setattr("sb3_cpm.challenger.challenger.check_finite", lambda *_: None)  # as somebody else may have written it
    challenger.save(path)
    told = r"whose weight (world_model\.reward_head\.0\.weight|optimizers\.world_model\S*exp_avg) is not finite"
    for read in (lambda: Challenger.load(path, "cpu"), lambda: small().load_state(path)):
        with pytest.raises(ValueError, match=told):
            read()


def test_a_player_that_is_not_finite_never_replaces_a_good_one(tmp_path: Path) -> None:
    path = tmp_path / "model.zip"
    for kind, spoil in (
        (SAC, lambda model: model.actor.latent_pi[0].weight[0].fill_(th.nan)),
        (SAC, lambda model: model.log_ent_coef.fill_(th.inf)),
        (TD3, lambda model: model.critic_target.qf0[0].bias.fill_(-th.inf)),
    ):
        model = kind("MlpPolicy", pendulum(), buffer_size=50, policy_kwargs={"net_arch": [4]})
        save_model(path, model)
        before = path.read_bytes()
        with th.no_grad():
            spoil(model)
        with pytest.raises(NotFiniteError, match=r"The model is not saved: its weight \S+ is not finite. If .*zip exists"):
            save_model(path, model)
        assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]
        kind.load(path)  # SB3 reads it as any other


# ---------------------------------------------------------------------- runs


@pytest.fixture
def without_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """They take longer than the run, and test_run.py looks at them."""
    for name in ("plots.learning_curve", "plots.coefficients", "gallery.challenge_gallery"):
        monkeypatch.setattr(f"sb3_cpm.run.{name}", lambda *_: None)


SMALL_RUN: dict[str, Any] = {
    "env": "CPMToy-v0",
    "env_kwargs": {"keys": ["state"]},
    "steps": 120,
    "learning_starts": 60,
    "batch_size": 8,
    "evaluations": 3,
    "eval_episodes": 1,
    "video": False,
    "progress_bar": False,
    "device": "cpu",
    "checkpoint_freq": 50,
    "model_kwargs": {"policy_kwargs": {"net_arch": [4]}},
    "callback_kwargs": {
        "train_freq": 60,
        "challenger_kwargs": {"batch_size": 2, "sequence_length": 8, "imagination_starts": 4},
    },
}


@pytest.mark.usefixtures("without_pictures")
def test_a_full_disk_does_not_end_a_run(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Models are too large for it, tables and logs are not."""
    folder = tmp_path / "run"
    with files_of_at_most(30_000):
        summary = train(run_folder=str(folder), **SMALL_RUN)
    told = capsys.readouterr()
    assert summary.outcome == "finished" and summary.steps == 120
    assert told.out.count("the run goes on.") == 3 and "checkpoint.new" in told.out, told.out
    assert "Could not write the model: " in told.err and "Traceback" not in told.err + told.out
    assert not (folder / "model.zip").exists() and not list(folder.glob(".*"))
    unbroken = tmp_path / "unbroken"
    train(run_folder=str(unbroken), **SMALL_RUN)
    for table in ("training.csv", "evaluations.csv", "coefficients.csv"):
        assert (folder / table).read_text() == (unbroken / table).read_text(), table
    assert (unbroken / "model.zip").exists()


def test_a_disk_that_is_full_before_the_run_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "run"
    with files_of_at_most(0):
        assert main(["train", "--env", "CPMToy-v0", "--run-folder", str(folder), "--steps", "300"]) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and error.startswith(f"error: {folder / 'config.yml'} cannot be written: File too large")
    assert not folder.exists()
    (tmp_path / "file").touch()
    assert main(["train", "--env", "CPMToy-v0", "--run-folder", str(tmp_path / "file" / "run"), "--steps", "300"]) == 1
    assert "run cannot be written: Not a directory" in capsys.readouterr().err


@pytest.mark.usefixtures("without_pictures")
def test_a_broken_player_does_not_replace_the_last_good_one_of_a_run(tmp_path: Path, capsys: Any) -> None:
    class Spoil(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps == 100:
                (tmp_path / "good").write_bytes((tmp_path / "run/checkpoint/model.zip").read_bytes())
                with th.no_grad():
                    self.model.critic_target.qf0[0].weight[0, 0] = th.nan  # type: ignore[union-attr]
            return True

    settings = {**SMALL_RUN, "agent": "cpm_td3", "gradient_steps": 0}
    train(run_folder=str(tmp_path / "run"), callback=Spoil(), **settings)
    assert (tmp_path / "run/checkpoint/model.zip").read_bytes() == (tmp_path / "good").read_bytes()
    assert not (tmp_path / "run/model.zip").exists()
    assert "Could not write the model: The model is not saved: its weight policy.critic_target" in capsys.readouterr().err


RUN = """
import sys
from sb3_cpm.run import gallery, plots, train
plots.learning_curve = plots.coefficients = gallery.challenge_gallery = lambda *_: None
from stable_baselines3.common.callbacks import BaseCallback
class Wait(BaseCallback):
    def _on_training_start(self):
        print("training", flush=True)
        sys.stdin.readline()
    def _on_step(self):
        return True
train(run_folder=sys.argv[1], callback=Wait(), **eval(sys.argv[2]))
"""


def test_a_second_process_in_the_folder_is_refused_and_changes_nothing(tmp_path: Path, capsys: Any) -> None:
    folder = tmp_path / "run"
    folder.mkdir()  # somebody has made it beforehand
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", RUN, str(folder), repr({**SMALL_RUN, "evaluations": 0})]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment) as first:
        assert first.stdout is not None and any(line == "training\n" for line in first.stdout)
        before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
        assert main(["train", "--env", "CPMToy-v0", "--run-folder", str(folder), "--steps", "300"]) == 1
        assert capsys.readouterr().err.startswith(f"error: {folder} is being written by another process.")
        assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
        first.communicate("\n")
    assert first.returncode == 0 and yaml.safe_load((folder / "config.yml").read_text())["run"]["steps"] == 120


@pytest.mark.usefixtures("without_pictures")
def test_only_what_a_run_made_is_taken_away(tmp_path: Path) -> None:
    theirs, ours = tmp_path / "theirs", tmp_path / "ours"
    theirs.mkdir()
    for folder in (theirs, ours):
        with pytest.raises(ValueError, match="net_arc"):
            train(run_folder=str(folder), **{**SMALL_RUN, "model_kwargs": {"policy_kwargs": {"net_arc": [4]}}})
    assert theirs.is_dir() and not list(theirs.iterdir()) and not ours.exists()

    class Note(BaseCallback):
        def _on_training_start(self) -> None:
            (ours / "note.txt").write_text("by the user")
            raise KeyboardInterrupt

        def _on_step(self) -> bool:
            return True

    with pytest.raises(KeyboardInterrupt):
        train(run_folder=str(ours), callback=Note(), **SMALL_RUN)
    assert [path.name for path in ours.iterdir()] == ["note.txt"]


def test_an_experiment_goes_on_without_the_checkpoint_that_the_disk_refused(tmp_path: Path) -> None:
    pytest.importorskip("rl_zoo3")
    from sb3_cpm.experiments.single_run import perform
    from sb3_cpm.experiments.specification import RunSpec

    overrides = {
        **{"policy_kwargs": {"net_arch": [4]}, "learning_starts": 60, "batch_size": 8, "buffer_size": 500, "train_freq": 10},
        **{"gradient_steps": 1, "env_kwargs": {"keys": ["state"]}},
    }
    spec = RunSpec("test", "sac", "toy", 0, "sac", "CPMToy-v0", overrides, steps=120, eval_every=60, eval_episodes=1)
    lines: list[str] = []
    with files_of_at_most(15_000):
        result = perform(spec, tmp_path / "full", lines.append)
    told = [line for line in lines if "no checkpoint at step" in line]
    assert result.outcome == "finished" and len(told) == 2 and "cannot be written: File too large" in told[0]
    unbroken = perform(spec, tmp_path / "unbroken")
    for name in ("evaluations.csv", "training.csv", "diagnostics.csv"):
        assert (result.folder / name).read_bytes() == (unbroken.folder / name).read_bytes()
    assert sorted(path.name for path in result.folder.iterdir()) == sorted(path.name for path in unbroken.folder.iterdir())
