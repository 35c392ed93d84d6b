"""Watching the world model: open-loop predictions, their pictures, and the command that draws them."""

import shutil
from pathlib import Path
from typing import Any

import imageio.v2 as imageio
import numpy as np
import pytest
import torch
from challenger_helpers import BOTH, VECTOR, random_batch, small, weights
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from sb3_cpm.__main__ import main
from sb3_cpm.callbacks import ChallengerCallback
from sb3_cpm.challenger import Challenger
from sb3_cpm.run import TrainSettings, train
from sb3_cpm.run.watch import watch
from sb3_cpm.run.watch_callback import WatchCallback

RUN: dict[str, Any] = {
    "env": "CPMToy-v0",
    "steps": 250,
    "learning_starts": 100,
    "train_freq": 50,
    "batch_size": 16,
    "evaluations": 0,
    "video": False,
    "progress_bar": False,
    "callback_kwargs": {"challenger_kwargs": {"batch_size": 4, "sequence_length": 16, "imagination_starts": 8, "horizon": 5}},
}


def episode(challenger: Challenger, rows: int = 9) -> tuple[dict[str, np.ndarray], np.ndarray]:
    batch = random_batch(challenger.observation_space, 2, rows, 1)
    return {key: value[:, 0] for key, value in batch.observations.items()}, batch.actions[1:, 0]


# ---- open loop ---------------------------------------------------------------------------------------------------------


def test_open_loop_sees_the_context_and_nothing_else() -> None:
    challenger = small(BOTH)
    observations, actions = episode(challenger)
    drawn = challenger.open_loop(observations, actions, context=4)
    assert drawn.context == 4 and drawn.rewards.shape == (8,)
    assert {key: value.shape for key, value in drawn.observations.items()} == {k: v.shape for k, v in observations.items()}
    assert drawn.observations["base"].min() >= 0.0 and drawn.observations["base"].max() <= 255.0
    later = {key: value.copy() for key, value in observations.items()}
    for value in later.values():
        value[4:] = 7
    for other in (later, {key: value[:4] for key, value in observations.items()}):
        again = challenger.open_loop(other, actions, context=4)
        assert all(np.array_equal(value, again.observations[key]) for key, value in drawn.observations.items())
    seen = challenger.open_loop(observations, actions, context=9)
    assert all(np.allclose(value[:4], drawn.observations[key][:4], atol=1e-3) for key, value in seen.observations.items())
    assert not np.allclose(seen.observations["state"][4:], drawn.observations["state"][4:], atol=1e-3)


def test_open_loop_is_what_the_world_model_imagines() -> None:
    challenger = small()
    observations, actions = episode(challenger)
    drawn = challenger.open_loop(observations, actions, context=3)
    rows = np.concatenate([np.zeros((1, 2), np.float32), actions])[:, None]
    first = np.arange(9)[:, None] == 0
    seen = {key: value[:3, None] for key, value in observations.items()}
    state = challenger.follow(challenger.initial_state(1), seen, rows[:3], first[:3], deterministic=True)
    expected = challenger.world_model.open_loop(state, torch.as_tensor(actions[2:, None]))["state"][:, 0]
    assert np.allclose(drawn.observations["state"][3:], expected.detach().numpy(), atol=1e-5)


@pytest.mark.parametrize("context", [0, 10])
def test_open_loop_with_a_context_that_is_not_there(context: int) -> None:
    challenger = small(VECTOR)
    with pytest.raises(ValueError, match="`context` must lie between 1 and the episode's 9 states"):
        challenger.open_loop(*episode(challenger), context)


def test_errors_are_logged_for_every_key() -> None:
    metrics = small(BOTH).train(random_batch(BOTH, 2))
    both = (metrics["error_base"] + metrics["error_hand"]) / 2
    assert metrics["pixel_error"] == pytest.approx(both, rel=1e-5) and metrics["error_state"] > 0
    assert {"kl", "raw_disagreement", "exp_scale"} <= set(metrics)


def test_reward_errors_are_on_the_scale_of_the_environment() -> None:
    """Figure 10f: also where the head learns symlog(reward)."""
    batch = random_batch(BOTH, 2)
    batch = batch._replace(rewards=np.full_like(batch.rewards, 40.0))
    metrics = small(BOTH, symlog_rewards=True).train(batch)
    assert metrics["reward_error"] == pytest.approx(40.0, abs=3.0)  # a new head says nearly 0
    assert metrics["relative_reward_error"] == pytest.approx(metrics["reward_error"] / 40.0, rel=1e-5)
    nothing = small(BOTH).train(batch._replace(rewards=np.zeros_like(batch.rewards)))
    assert nothing["relative_reward_error"] == 0.0 and np.isfinite(nothing["reward_error"])


# ---- the command -------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "toy"
    train(run_folder=str(folder), **RUN)
    return folder


def check_picture(path: Path) -> None:
    image = imageio.imread(path)[..., :3]
    assert image.shape[1] == 1540 and image.shape[0] > 700 and image.std() > 10
    assert len(np.unique(image[::2, ::2].astype(int) @ [1, 256, 65536])) > 50


def test_the_command_draws_everything(finished: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["watch", str(finished), "--frames", "20", "--context", "4", "--device", "cpu"]) == 0
    text = capsys.readouterr().out
    assert "2 episode(s) of 20, 20 states, 4 of them shown" in text and "standing still" in text and "camera" in text
    names = ["open_loop_1.gif", "open_loop_1.png", "open_loop_2.gif", "open_loop_2.png", "training.png"]
    assert sorted(path.name for path in (finished / "watch").iterdir()) == names
    for name in names:
        if name.endswith(".png"):
            check_picture(finished / "watch" / name)
    with Image.open(finished / "watch" / "open_loop_1.gif") as animation:
        assert animation.n_frames == 20 and animation.is_animated  # type: ignore[attr-defined]
        assert animation.size[0] >= 3 * 192
    events = EventAccumulator(str(finished / "tensorboard" / "watch"))
    events.Reload()
    assert {f"watch/{name}" for name in names} == set(events.Tags()["images"])
    scalars = set(events.Tags()["scalars"])
    for name in ("reconstruction_error_camera", "open_loop_error_state", "kl", "disagreement", "exp_scale"):
        assert f"watch/{name}" in scalars
    main(["watch", str(finished), "--frames", "16", "--episodes", "1"])  # once more: files are replaced


class Watching(WatchCallback):
    """In a run the challenger's callback is made inside; find it when training starts."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(ChallengerCallback(), **kwargs)

    def _on_training_start(self) -> None:
        callbacks = self.locals["callback"].callbacks
        self.challenger = next(one for one in callbacks if isinstance(one, ChallengerCallback))


def test_watching_while_it_learns(finished: Path, tmp_path: Path) -> None:
    folder = tmp_path / "watched"
    train(TrainSettings(run_folder=str(folder), **RUN), callback=Watching(every=60, frames=16))
    events = EventAccumulator(str(folder / "tensorboard"))
    events.Reload()
    videos = events.Images("watch/open_loop")
    assert len(videos) >= 2 and videos[-1].encoded_image_string[:3] == b"GIF"
    assert {"watch/open_loop_error_camera", "challenger/error_camera"} <= set(events.Tags()["scalars"])
    unwatched, watched = (Challenger.load(path / "challenger.pt", "cpu") for path in (finished, folder))
    assert all(np.array_equal(value, weights(watched)[key]) for key, value in weights(unwatched).items()), "the same run"


@pytest.mark.parametrize("kwargs", [{"every": 0}, {"context": 0}, {"frames": 65}])
def test_wrong_arguments_of_the_callback(kwargs: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="expected"):
        WatchCallback(ChallengerCallback(), **kwargs)


@pytest.mark.slow
def test_states_alone_are_drawn_as_curves(tmp_path: Path) -> None:
    train(run_folder=str(tmp_path / "run"), **{**RUN, "env_kwargs": {"keys": ["state"]}})
    watched = watch(tmp_path / "run", episodes=1)
    assert [path.name for path in watched.files] == ["open_loop_1.png", "training.png"]
    check_picture(watched.files[0])


def test_what_cannot_be_watched(finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["watch", str(tmp_path / "nowhere")]) == 1
    assert "There is no run folder" in capsys.readouterr().err
    incomplete = tmp_path / "incomplete"
    incomplete.mkdir()
    with pytest.raises(ValueError, match=r"has no challenger\.pt"):
        watch(incomplete)
    shutil.copy(finished / "challenger.pt", incomplete)
    with pytest.raises(ValueError, match=r"has no replay_buffer\.npz"):
        watch(incomplete)
    (incomplete / "replay_buffer.pkl").write_bytes(b"broken")
    with pytest.raises(ValueError, match="of an earlier version, which pickled its replay buffer.*allow_pickle=True"):
        watch(incomplete)
    (incomplete / "replay_buffer.npz").write_bytes(b"broken")
    with pytest.raises(ValueError, match=r"replay_buffer\.npz .* is damaged"):
        watch(incomplete)
    for arguments in ({"frames": 65}, {"context": 0}, {"context": 50}, {"frames": 3}):
        with pytest.raises(ValueError, match="expected 1 <= context < frames <= 64"):
            watch(finished, **arguments)
    with pytest.raises(ValueError, match="episodes=0"):
        watch(finished, episodes=0)
    with pytest.raises(ValueError, match=r"longer than context=52 states.*the longest of 50 steps"):
        watch(finished, context=52, frames=60)
