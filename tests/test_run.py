"""Training runs: everything that a run folder must hold, whatever ended the run."""

import json
from pathlib import Path
from typing import Any

import gymnasium as gym
import imageio.v2 as imageio
import numpy as np
import pytest
import yaml
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_cpm.agents.tasks import task_id
from sb3_cpm.buffers import CPMBuffer
from sb3_cpm.challenger import Challenger
from sb3_cpm.dreamer import Dreamer
from sb3_cpm.run import TrainSettings, train
from sb3_cpm.run.evaluation import evaluate
from sb3_cpm.run.folder import NewFolder
from sb3_cpm.run.plots import running_mean
from sb3_cpm.run.specification import RunSpec
from sb3_cpm.run.summary import Summary, complete_times
from sb3_cpm.run.tables import GrownTable, read_csv, read_diagnostics
from sb3_cpm.run.training import specification
from sb3_cpm.seeds import FIRST_SEED

SMALL: dict[str, Any] = {
    "env": "CPMToy-v0",
    "steps": 500,
    "learning_starts": 100,
    "train_freq": 10,
    "batch_size": 16,
    "evaluations": 2,
    "eval_episodes": 2,
    "progress_bar": False,
    "callback_kwargs": {"challenger_kwargs": {"batch_size": 4, "sequence_length": 16, "imagination_starts": 8, "horizon": 5}},
}
PICTURES = {"learning_curve.png": (715, 990), "coefficients.png": (990, 1210), "challenge_gallery.png": (600, 1430)}


class StopAt(BaseCallback):
    """Something happens at a step."""

    def __init__(self, step: int, error: BaseException) -> None:
        super().__init__()
        self.step = step
        self.error = error

    def _on_step(self) -> bool:
        if self.num_timesteps == self.step:
            raise self.error
        return True


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Summary]:
    folder = tmp_path_factory.mktemp("runs") / "finished"
    return folder, train(run_folder=str(folder), **SMALL)


def check_pictures(folder: Path) -> None:
    """Drawn in the size meant, and neither blank nor of one colour."""
    for name, (height, width) in PICTURES.items():
        image = imageio.imread(folder / name)[..., :3]
        assert image.shape[1] == width, name
        assert image.shape[0] >= height, name
        assert image.std() > 10, name
        colours = image[::2, ::2].astype(int) @ [1, 256, 65536]
        assert len(np.unique(colours)) > 50, name


def load_model(folder: Path) -> SAC:
    model = SAC.load(folder / "model.zip", env=gym.make("CPMToy-v0"), device="cpu")
    model.replay_buffer = CPMBuffer.load(folder / "replay_buffer.npz", env=model.get_env())
    return model


def read_video(path: Path) -> list[np.ndarray]:
    with imageio.get_reader(path) as reader:
        return [np.asarray(frame) for frame in reader]


def check_loadable(folder: Path) -> None:
    model = load_model(folder)
    assert isinstance(model.replay_buffer, CPMBuffer)
    assert model.replay_buffer.episodes_ended
    challenger = Challenger.load(folder / "challenger.pt", device="cpu")
    assert challenger.trained_updates > 0
    observation, _ = gym.make("CPMToy-v0").reset(seed=0)
    action, _ = model.predict(observation, deterministic=True)
    assert action.shape == (2,)


def test_folder_of_a_finished_run(finished: tuple[Path, Summary]) -> None:
    folder, _ = finished
    check_pictures(folder)
    check_loadable(folder)
    config = yaml.safe_load((folder / "config.yml").read_text())
    assert config["run"]["env_id"] == "CPMToy-v0" and config["versions"]["stable_baselines3"]
    assert "challenger/world_model_loss" in read_diagnostics(folder)
    assert (folder / "finished.yml").exists() and not (folder / "checkpoint").exists()
    assert not list(folder.glob(".*")), "no temporary file stays behind"


def test_config_repeats_the_run(finished: tuple[Path, Summary]) -> None:
    folder, _ = finished
    config = yaml.safe_load((folder / "config.yml").read_text())
    spec, agent = specification(TrainSettings(**SMALL))
    assert RunSpec(**config["run"]) == spec
    assert config["protocol"]["hyperparameters"] == agent.hyperparameters
    assert agent.hyperparameters["gamma"] == 0.9 and agent.hyperparameters["batch_size"] == 16


def test_tables_of_a_finished_run(finished: tuple[Path, Summary]) -> None:
    folder, summary = finished
    episodes = read_csv(folder / "training.csv")
    assert list(episodes["step"]) == list(range(50, 501, 50))
    evaluations = read_csv(folder / "evaluations.csv")
    assert list(evaluations["step"]) == [0, 0, 500, 500]
    assert evaluations["return"][2:].mean() == pytest.approx(summary.mean_return)
    proposals = read_csv(folder / "proposals.csv")
    assert len(proposals["step"]) == summary.proposed > 0
    assert proposals["accepted"].sum() == summary.kept
    accepted = proposals["accepted"] == 1
    assert np.array_equal(np.isfinite(proposals["artificial_total"]), accepted), "only what was kept has new rewards"
    coefficients = read_csv(folder / "coefficients.csv")
    assert coefficients["proposed"][-1] == summary.proposed
    shares = coefficients["explored_share"]
    assert np.all((shares >= 0) & (shares <= 1)) and shares.mean() == pytest.approx(summary.explored_share)
    assert np.all(np.diff(coefficients["epsilon"]) <= 0)
    curve = (folder / "learning_curve.csv").read_text().splitlines()
    assert curve[0] == "step,kind,return,success"
    assert sum(",eval," in line for line in curve) == 2
    assert sum(",train," in line for line in curve) == 10


def test_summary(finished: tuple[Path, Summary], capsys: pytest.CaptureFixture[str]) -> None:
    folder, summary = finished
    assert summary.outcome == "finished"
    assert (summary.steps, summary.episodes) == (500, 10)
    assert sum(summary.time.values()) == pytest.approx(summary.seconds, rel=0.02)
    assert {"simulate+render", "C acts", "C evaluates", "C trains", "P trains", "evaluation", "other"} <= set(summary.time)
    assert json.loads((folder / "summary.json").read_text())["kept"] == summary.kept
    text = (folder / "summary.txt").read_text()
    assert "C trains" in text and str(folder) in text
    summary.show()
    assert "challenges" in capsys.readouterr().out


def test_tensorboard_and_video(finished: tuple[Path, Summary]) -> None:
    folder, _ = finished
    events = EventAccumulator(str(folder / "tensorboard"))
    events.Reload()
    tags = set(events.Tags()["scalars"])
    assert {"rollout/exploration_rate", "eval/mean_reward", "challenge/c", "challenger/world_model_loss"} <= tags
    frames = read_video(folder / "evaluation.mp4")
    assert len(frames) == 51, "one per state"
    assert frames[0].shape == (256, 256, 3)
    assert frames[0].std() > 5


def test_never_overwrites(finished: tuple[Path, Summary], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    folder, _ = finished
    with pytest.raises(ValueError, match="not empty"):
        train(run_folder=str(folder), **SMALL)
    monkeypatch.chdir(tmp_path)
    assert [NewFolder(None, "toy").path.name for _ in range(3)] == ["toy", "toy-2", "toy-3"]


@pytest.mark.slow
def test_same_seed_same_run_whether_it_is_evaluated_or_not(tmp_path: Path) -> None:
    for name, evaluations in (("one", 0), ("other", 3)):
        train(run_folder=str(tmp_path / name), **{**SMALL, "steps": 300, "evaluations": evaluations, "video": False})
    for table in ("training.csv", "proposals.csv", "coefficients.csv"):
        assert (tmp_path / "one" / table).read_text() == (tmp_path / "other" / table).read_text()


@pytest.mark.parametrize(
    ("error", "outcome"), [(KeyboardInterrupt(), "stopped by Ctrl-C"), (RuntimeError("the sky fell"), "the sky fell")]
)
def test_everything_is_kept_when_a_run_is_ended(
    error: BaseException, outcome: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    closed = []
    close = DummyVecEnv.close
    monkeypatch.setattr(DummyVecEnv, "close", lambda env: (closed.append(env), close(env)))
    folder = tmp_path / "run"
    with pytest.raises(type(error)):
        train(TrainSettings(run_folder=str(folder), **SMALL), callback=StopAt(330, error))
    assert len(closed) == 2, "of training and of evaluation"
    check_pictures(folder)
    check_loadable(folder)
    assert list(read_csv(folder / "training.csv")["step"]) == [50, 100, 150, 200, 250, 300]
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["steps"] == 330
    assert outcome in summary["outcome"]
    model = load_model(folder)
    assert model.replay_buffer.n_added == 329, "the transition of the step that failed was not stored yet"


def test_bad_settings_leave_no_folder(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with pytest.raises(ValueError, match="learning_starts"):
        train(run_folder=str(folder), **{**SMALL, "learning_starts": 10})
    assert not folder.exists()
    with pytest.raises(ValueError, match="challenge_ratio"):
        train(run_folder=str(folder), **SMALL, challenge_ratio=2.0)
    assert not folder.exists()
    with pytest.raises(ValueError, match="not both"):
        train(TrainSettings(), steps=5)


@pytest.mark.parametrize(
    "wrong",
    [
        *({"n_envs": 0}, {"steps": 0}, {"evaluations": -1}, {"evaluations": 1}, {"eval_episodes": 0}, {"threads": 0}),
        *({"seed": -1}, {"seed": FIRST_SEED}, {"seed": FIRST_SEED - 2, "n_envs": 2}, {"checkpoint_freq": 0}),
    ],
)
def test_settings_are_checked(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="expected"):
        specification(TrainSettings(**{"env": "CPMToy-v0", **wrong}))


def test_the_greatest_seed_is_none_of_the_evaluation() -> None:
    settings = TrainSettings(env="CPMToy-v0", seed=FIRST_SEED - 3, n_envs=2)
    built = specification(settings)[1].build(settings.seed, device="cpu")
    starts = built.env.reset()["state"]
    evaluation, _ = gym.make("CPMToy-v0").reset(seed=FIRST_SEED)
    assert not np.isclose(starts, evaluation["state"]).all(-1).any()
    built.env.close()


def test_a_run_without_an_update_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with pytest.raises(ValueError, match=r"steps=100 is no longer than learning_starts=100, .* Set steps above 100, or"):
        train(run_folder=str(folder), **{**SMALL, "steps": 100})
    assert not folder.exists()
    shortest = {**SMALL, "steps": 120, "evaluations": 0, "video": False}
    assert train(run_folder=str(folder), **shortest).player_updates > 0


def test_module_and_id(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """gymnasium's ``MODULE:ID``, for tasks that a package registers when it is imported."""
    (tmp_path / "brings_a_task.py").write_text(
        "import gymnasium\n"
        "gymnasium.register('Brought-v0', entry_point='gymnasium.envs.classic_control:PendulumEnv', max_episode_steps=20)\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.chdir(tmp_path)
    changes = {"env": "brings_a_task:Brought-v0", "steps": 60, "learning_starts": 40, "evaluations": 0}
    summary = train(**{**SMALL, **changes})
    assert Path(summary.folder) == Path("runs/Brought-v0-cpm_sac-seed0") and summary.episodes == 3
    with pytest.raises(ValueError, match=r"brings_a_task registers no 'Braught-v0'\. Did you mean 'Brought-v0'"):
        train(env="brings_a_task:Braught-v0")
    with pytest.raises(ValueError, match="cannot import 'brings_no_task'"):
        train(env="brings_no_task:Brought-v0")


@pytest.mark.slow
def test_two_processes_and_tqc(tmp_path: Path) -> None:
    changes = {"n_envs": 2, "agent": "cpm_tqc", "steps": 300, "evaluations": 0, "video": False}
    summary = train(run_folder=str(tmp_path / "run"), **{**SMALL, **changes})
    assert (summary.steps, summary.episodes) == (300, 6)
    assert summary.success is None and summary.mean_return is None
    assert summary.proposed > 0
    assert "evaluated success    -" in summary.as_text()


def test_vectors_only_with_td3_and_progress_bar(tmp_path: Path) -> None:
    """Pendulum has a Box, no images, no success and no clouds; the gallery says so instead of failing."""
    changes = {"env": "Pendulum-v1", "agent": "cpm_td3", "steps": 450, "learning_starts": 200, "progress_bar": True}
    summary = train(run_folder=str(tmp_path / "run"), **{**SMALL, **changes})
    assert summary.steps == 450
    assert summary.success is None
    assert summary.mean_return is not None and summary.mean_return < 0
    check_pictures(tmp_path / "run") if summary.proposed > 1 else None


def test_images_only(tmp_path: Path) -> None:
    changes = {"env_kwargs": {"keys": ["camera"]}, "steps": 150, "evaluations": 0, "video": False}
    summary = train(run_folder=str(tmp_path / "run"), **{**SMALL, **changes})
    assert summary.player_updates > 0
    gallery = imageio.imread(tmp_path / "run" / "challenge_gallery.png")
    assert gallery.std() > 1, "without proposals it says why it is empty"


def test_discrete_actions_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"CartPole-v1 has the action space Discrete\(2\)"):
        train(env="CartPole-v1", run_folder=str(tmp_path / "run"))
    assert not (tmp_path / "run").exists()


def test_one_name_per_task() -> None:
    assert task_id("PickCube-v1") == task_id("CPM/PickCube-v1") == "CPM/PickCube-v1"
    assert task_id("CPMToy-v0") == "CPMToy-v0" and task_id("Pendulum-v1") == "Pendulum-v1"
    with pytest.raises(ValueError, match=r"Unknown environment 'PikCube-v1'\. Did you mean 'PickCube-v1'"):
        task_id("PikCube-v1")


@pytest.mark.slow
@pytest.mark.maniskill
def test_pick_cube(tmp_path: Path) -> None:
    changes = {"env": "PickCube-v1", "steps": 200, "evaluations": 2, "eval_episodes": 1}
    summary = train(run_folder=str(tmp_path / "run"), **{**SMALL, **changes})
    assert (summary.steps, summary.episodes) == (200, 4)
    assert summary.success is not None
    assert summary.proposed > 0
    image = imageio.imread(tmp_path / "run" / "challenge_gallery.png")[..., :3]
    assert image.std() > 20
    assert len(read_video(tmp_path / "run" / "evaluation.mp4")) == 51


def test_a_recurrent_player_keeps_its_memory_within_an_episode() -> None:
    """``predict`` of Dreamer without its state would judge every observation as the first of an episode."""
    env = gym.make("CPMToy-v0", keys=("state",))
    model = Dreamer("MultiInputPolicy", env, preset={"deter_size": 16, "hidden_size": 16}, learning_starts=50, seed=0)
    model.learn(60)
    with_memory = evaluate(model, DummyVecEnv([lambda: Monitor(gym.make("CPMToy-v0", keys=("state",)))]), 1, 7)[0]
    expected, _ = evaluate_policy(model, SeededReset(env, 7), n_eval_episodes=1, warn=False)
    assert with_memory.episode_return == pytest.approx(expected, rel=1e-5)
    memoryless = [model.predict(env.reset(seed=7)[0], deterministic=True)[0]]
    total, done = 0.0, False
    while not done:
        observation, reward, terminated, truncated, _ = env.step(memoryless[-1])
        memoryless.append(model.predict(observation, deterministic=True)[0])
        total, done = total + float(reward), terminated or truncated
    assert total != pytest.approx(with_memory.episode_return, rel=1e-5)


class SeededReset(gym.Wrapper):
    """Resets with the same seed always: ``evaluate_policy`` gives none."""

    def __init__(self, env: gym.Env, seed: int) -> None:
        super().__init__(env)
        self.seed = seed

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        return self.env.reset(seed=self.seed, options=options)


def test_csv_table_is_complete_after_every_row(tmp_path: Path) -> None:
    table = GrownTable(tmp_path / "t.csv")
    table.add_row({"a": 1, "b": None})
    table.add_row({"b": 1 / 3, "a": 2.5})
    found = read_csv(tmp_path / "t.csv")  # before it is closed
    assert list(found["a"]) == [1, 2.5]
    assert np.isnan(found["b"][0]) and found["b"][1] == pytest.approx(1 / 3, rel=1e-5)
    table.close()
    assert read_csv(tmp_path / "missing.csv") == {}
    (tmp_path / "empty.csv").touch()
    assert read_csv(tmp_path / "empty.csv") == {}


def test_running_mean() -> None:
    values = np.array([1.0, 2.0, np.nan, 4.0, 6.0])
    assert running_mean(values, 2) == pytest.approx([1, 1.5, 2, 4, 5])
    assert running_mean(values, 99) == pytest.approx([1, 1.5, 1.5, 7 / 3, 13 / 4])


def test_times_are_complete_and_in_order() -> None:
    table = complete_times({"C trains": 2.0, "own": 1.0, "simulate+render": 3.0}, total=10.0)
    assert table == {"simulate+render": 3.0, "C trains": 2.0, "own": 1.0, "other": 4.0}
    assert list(table) == ["simulate+render", "C trains", "own", "other"]


def test_gif_where_there_is_no_ffmpeg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from sb3_cpm.run.video import write_video

    frames = [np.full((33, 20, 3), value, dtype=np.uint8) for value in (0, 100, 200)]
    assert write_video(tmp_path, "film", frames).suffix == ".mp4"
    mimwrite = imageio.mimwrite

    def without_ffmpeg(path: Path, images: list[np.ndarray], format: str, **kwargs: Any) -> None:
        if format == "FFMPEG":
            raise RuntimeError("No ffmpeg exe could be found")
        mimwrite(path, images, format=format, **kwargs)

    monkeypatch.setattr(imageio, "mimwrite", without_ffmpeg)
    path = write_video(tmp_path, "film", frames)
    assert path.suffix == ".gif"
    assert len(read_video(path)) == 3
    with pytest.raises(ValueError, match="at least one frame"):
        write_video(tmp_path, "film", [])
