"""The challenger as a whole: acting, judging, learning, saving, and what it says to bad input."""

import pathlib

import numpy as np
import pytest
import torch
from challenger_helpers import BOTH, IMAGES, SMALL, VECTOR, MovingSquare, box, image, random_batch, small, vector, weights
from gymnasium import spaces

from sb3_cpm.challenger import Challenger
from sb3_cpm.type_aliases import SequenceBatch
from sb3_cpm.uncertainty import Transitions, Uncertainty
from sb3_cpm.world_model.rssm import LatentState

N_COLUMNS = 3


def columns(space: spaces.Dict, length: int = 9) -> SequenceBatch:
    return random_batch(space, 2, length, N_COLUMNS)


def follow(challenger: Challenger, state: LatentState, batch: SequenceBatch, rows: slice, **kwargs: bool) -> LatentState:
    observations = {key: value[rows] for key, value in batch.observations.items()}
    return challenger.follow(state, observations, batch.actions[rows], batch.is_first[rows], batch.mask[rows], **kwargs)


# ---- acting and following --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("space", [VECTOR, IMAGES, BOTH])
def test_following_in_parts_is_following_the_whole(space: spaces.Dict) -> None:
    challenger, batch = small(space), columns(space)
    batch.mask[2:5, 1] = batch.mask[6:, 2] = False
    whole = follow(challenger, challenger.initial_state(N_COLUMNS), batch, slice(0, 9), deterministic=True)
    state = challenger.initial_state(N_COLUMNS)
    for rows in (slice(0, 1), slice(1, 4), slice(4, 9)):
        state = follow(challenger, state, batch, rows, deterministic=True)
    for one, other in zip(whole, state, strict=True):
        assert torch.allclose(one, other, atol=1e-5)


def test_a_first_row_forgets_and_a_masked_row_changes_nothing() -> None:
    challenger, batch = small(), columns(VECTOR, 2)
    noise = LatentState(*(torch.randn_like(part) for part in challenger.initial_state(N_COLUMNS)))
    batch.is_first[:] = [[True, False, False], [False] * 3]
    batch.mask[:, 2] = False
    from_noise = follow(challenger, noise, batch, slice(0, 2), deterministic=True)
    from_zero = follow(challenger, challenger.initial_state(N_COLUMNS), batch, slice(0, 2), deterministic=True)
    assert torch.equal(from_noise.feat[0], from_zero.feat[0])
    assert not torch.allclose(from_noise.feat[1], from_zero.feat[1])
    assert torch.equal(from_noise.feat[2], noise.feat[2])


def test_following_samples_and_is_random_only_through_torch() -> None:
    challenger, batch = small(), columns(VECTOR)
    states = []
    for seed in (1, 1, 2):
        torch.manual_seed(seed)
        states.append(follow(challenger, challenger.initial_state(N_COLUMNS), batch, slice(0, 9)))
    assert torch.equal(states[0].stoch, states[1].stoch) and not torch.equal(states[0].stoch, states[2].stoch)


@pytest.mark.parametrize("n", [1, 5])
def test_actions_are_numpy_within_bounds(n: int) -> None:
    challenger = small(action_dim=4)
    action = challenger.act(challenger.initial_state(n))
    assert isinstance(action, np.ndarray) and action.dtype == np.float32 and action.shape == (n, 4)
    assert np.abs(action).max() <= 1.0
    mode = challenger.act(challenger.initial_state(n), deterministic=True)
    assert np.array_equal(mode, challenger.act(challenger.initial_state(n), deterministic=True))


def test_channel_first_images_are_the_same_to_it() -> None:
    """SB3's VecTransposeImage hands images channel-first."""
    results = []
    for channel_first in (False, True):
        torch.manual_seed(0)
        shape = (3, 32, 32) if channel_first else (32, 32, 3)
        challenger = small(spaces.Dict({"camera": spaces.Box(0, 255, shape, np.uint8)}))
        batch = random_batch(spaces.Dict({"camera": image()}), 2)
        if channel_first:
            batch = batch._replace(observations={"camera": np.moveaxis(batch.observations["camera"], -1, -3)})
        results.append(challenger.train(batch))
    assert results[0] == pytest.approx(results[1], rel=1e-4)


def test_read_only_arrays_are_fine_and_stay_as_they_are() -> None:
    challenger, batch = small(BOTH), random_batch(BOTH, 2)
    for array in (*batch.observations.values(), *batch[1:]):
        array.flags.writeable = False
    follow(challenger, challenger.initial_state(4), batch, slice(0, 8))
    challenger.train(batch)


# ---- judging ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_steps", [1, 2, 50])
def test_evaluation_has_one_opinion_per_transition(n_steps: int) -> None:
    challenger = small(BOTH)
    batch = random_batch(BOTH, 2, n_steps + 1, 1)
    observations = {key: value[:, 0] for key, value in batch.observations.items()}
    before = torch.get_rng_state()
    evaluation = challenger.evaluate(observations, batch.actions[1:, 0])
    assert torch.equal(before, torch.get_rng_state()), "judging uses no random numbers"
    assert evaluation.disagreement.shape == evaluation.kl.shape == (n_steps,)
    assert evaluation.embeddings.shape == (n_steps + 1, challenger.world_model.embed_dim)
    assert (evaluation.disagreement >= 0).all() and (evaluation.kl >= 0).all()
    again = challenger.evaluate(observations, batch.actions[1:, 0])
    assert all(np.array_equal(one, other) for one, other in zip(evaluation, again, strict=True))


def test_evaluation_is_that_of_following_step_by_step() -> None:
    challenger, batch = small(), random_batch(VECTOR, 2, 6, 1)
    batch.is_first[1:] = False
    observations = batch.observations["state"][:, 0]
    evaluation = challenger.evaluate({"state": observations}, batch.actions[1:, 0])
    state = challenger.initial_state(1)
    for t in range(6):
        before, state = state, follow(challenger, state, batch, slice(t, t + 1), deterministic=True)
        if t > 0:
            with torch.no_grad():
                kl = challenger.world_model.kl(state)
                pair = Transitions(before.feat, torch.as_tensor(batch.actions[t]), state.stoch, state.deter)
                novelty = challenger.uncertainty.novelty(pair)
            assert evaluation.kl[t - 1] == pytest.approx(kl.item(), abs=1e-5)
            assert evaluation.disagreement[t - 1] == pytest.approx(novelty.item(), rel=1e-4)


def test_episodes_of_unequal_lengths_are_refused() -> None:
    with pytest.raises(ValueError, match="An episode of 4 actions has 5 observations, got 4"):
        small().evaluate({"state": np.zeros((4, 3), np.float32)}, np.zeros((4, 2), np.float32))


def test_an_evaluation_that_is_not_finite_is_refused() -> None:
    with pytest.raises(RuntimeError, match="not finite"):
        small().evaluate({"state": np.full((5, 3), np.nan, np.float32)}, np.zeros((4, 2), np.float32))


# ---- learning --------------------------------------------------------------------------------------------------------


def test_same_seed_same_learning() -> None:
    results = []
    for _ in range(2):
        torch.manual_seed(3)
        challenger = small(BOTH)
        results.append([challenger.train(random_batch(BOTH, 2, seed=seed)) for seed in range(3)])
    assert results[0] == results[1]
    assert {"world_model_loss", "kl", "image_loss", "vector_loss", "reward_loss", "disagreement", "exp_scale"} <= set(
        results[0][0]
    )


def square_challenger(square: MovingSquare) -> Challenger:
    """Its behaviour is not what is tested: little imagination saves two thirds of the time."""
    preset = {"batch_size": 8, "sequence_length": 16, "model_lr": 2e-3, "horizon": 3, "imagination_starts": 16}
    return Challenger(square.space, box(2), device="cpu", preset=preset)


@pytest.mark.slow
def test_a_trained_world_model_predicts_frames_it_has_not_seen() -> None:
    """After five frames it predicts the next ten from the actions alone, on held-out episodes."""
    square, rng = MovingSquare(), np.random.default_rng(0)
    challenger, held_out = square_challenger(square), square.batch(rng, 32, 15)

    def error() -> float:
        observations = {"camera": held_out.observations["camera"][:5]}
        state = challenger.initial_state(32)
        state = challenger.follow(state, observations, held_out.actions[:5], held_out.is_first[:5], deterministic=True)
        with torch.no_grad():
            frames = challenger.world_model.open_loop(state, torch.as_tensor(held_out.actions[5:]))["camera"].numpy()
        return float(np.abs(frames - held_out.observations["camera"][5:]).mean() / 255)

    untrained = error()
    data = [square.batch(rng, 8, 15) for _ in range(40)]
    # the best that does not follow the square: the mean picture of everything
    picture = np.concatenate([batch.observations["camera"].reshape(-1, 16, 16, 1) for batch in data]).mean(0)
    mean_picture = float(np.abs(held_out.observations["camera"][5:] - picture).mean() / 255)
    for update in range(250):
        metrics = challenger.train(data[update % len(data)])
    assert error() < 0.6 * untrained
    assert error() < 0.75 * mean_picture
    assert metrics["reward_loss"] < 0.02


@pytest.mark.slow
def test_disagreement_is_lower_on_data_seen_often() -> None:
    """Trained on a square that stays on the left, it finds the right half of the image new."""
    square, rng = MovingSquare(), np.random.default_rng(0)
    challenger = square_challenger(square)
    data = [square.batch(rng, 8, 15, right_half=False) for _ in range(20)]
    for update in range(300):
        challenger.train(data[update % len(data)])

    def opinion(right_half: bool) -> np.ndarray:
        evaluations = [challenger.evaluate(images, actions) for images, actions in episodes(right_half)]
        return np.mean([(evaluation.disagreement.mean(), evaluation.kl.mean()) for evaluation in evaluations], axis=0)

    def episodes(right_half: bool) -> list[tuple[dict[str, np.ndarray], np.ndarray]]:
        return [
            ({"camera": images}, actions) for images, actions, _ in (square.episode(rng, 15, right_half) for _ in range(16))
        ]

    (seen_disagreement, seen_kl), (new_disagreement, new_kl) = opinion(right_half=False), opinion(right_half=True)
    assert new_disagreement > 1.1 * seen_disagreement
    assert new_kl > 2.0 * seen_kl


def test_the_exploration_actor_seeks_what_is_new() -> None:
    """In a world where only positive actions lead to something unknown it learns to take them."""
    challenger = small(action_dim=1, preset={**SMALL, "imagination_starts": None}, uncertainty_class=Signed, actor_lr=1e-2)
    batch = random_batch(VECTOR, 1)
    for _ in range(100):
        challenger.train(batch)
    state = follow(challenger, challenger.initial_state(4), batch, slice(0, 8))
    assert challenger.act(state, deterministic=True).mean() > 0.5


class Signed(Uncertainty):
    """A measure of one's own: positive actions are new. Also shows how little the seam asks for."""

    def __init__(self, sizes: tuple) -> None:
        super().__init__(sizes)  # type: ignore[arg-type]
        self.weight = torch.nn.Parameter(torch.zeros(()))

    def novelty(self, transitions: Transitions) -> torch.Tensor:
        return transitions.action.sum(-1) + 1.0

    def loss(self, transitions: Transitions) -> torch.Tensor:
        return self.weight.square()


def test_a_loss_that_is_not_finite_names_its_term_and_leaves_the_weights() -> None:
    challenger, batch = small(), random_batch(VECTOR, 2)
    before = weights(challenger)
    batch.rewards[3, 1] = np.nan
    with pytest.raises(RuntimeError, match=r"terms \{'reward': nan\}.*No weight was changed"):
        challenger.train(batch)
    assert all(np.array_equal(value, weights(challenger)[key]) for key, value in before.items())


def test_a_batch_without_a_valid_row_is_refused() -> None:
    batch = random_batch(VECTOR, 2)
    batch.mask[:] = False
    with pytest.raises(ValueError, match="no valid row"):
        small().train(batch)


def test_a_batch_without_any_transition_still_trains_the_rest() -> None:
    batch = random_batch(VECTOR, 2)
    batch.is_first[:] = True
    metrics = small().train(batch)
    assert "uncertainty_loss" not in metrics and np.isfinite(metrics["world_model_loss"])


# ---- saving ----------------------------------------------------------------------------------------------------------


def test_save_and_load(tmp_path: pathlib.Path) -> None:
    challenger = small(BOTH, uncertainty_class="plan2explore", uncertainty_kwargs={"target": "stoch"})
    challenger.train(random_batch(BOTH, 2))
    path = tmp_path / "new" / "challenger.pt"
    challenger.save(path)
    challenger.save(path)
    assert [file.name for file in path.parent.iterdir()] == ["challenger.pt"], "no temporary file is left"
    loaded = Challenger.load(path, "cpu")
    assert loaded.keys == challenger.keys and loaded.preset == challenger.preset and loaded.trained_updates == 1
    assert loaded.action_space == challenger.action_space and loaded.uncertainty.target == "stoch"
    other = small(BOTH, uncertainty_class="plan2explore", uncertainty_kwargs={"target": "stoch"})
    other.load_state(path)
    for key, value in weights(challenger).items():
        assert np.array_equal(value, weights(loaded)[key]) and np.array_equal(value, weights(other)[key]), key


@pytest.mark.parametrize("number", [np.float64, np.float32])
def test_numpy_scalars_do_not_spoil_the_file(tmp_path: pathlib.Path, number: type) -> None:
    kwargs = {"mean_range": (number(0.25), 1.5), "heads": np.int64(3)}
    challenger = small(gamma=number(0.5), uncertainty_kwargs=kwargs)
    challenger.save(tmp_path / "challenger.pt")
    loaded = Challenger.load(tmp_path / "challenger.pt", "cpu")
    assert loaded.preset.gamma == 0.5 and loaded.uncertainty_kwargs["mean_range"] == (0.25, 1.5)


def test_loading_keeps_learning_rates_that_were_asked_for_anew(tmp_path: pathlib.Path) -> None:
    """All others are the file's, also where a schedule has moved them away from the preset's."""
    challenger, path = small(train_task_behavior=True, actor_lr=2e-4), tmp_path / "challenger.pt"
    for group in challenger.optimizers["task_actor"].adam.param_groups:
        group["lr"] = 1e-5
    challenger.train(random_batch(VECTOR, 2))
    challenger.save(path)
    other = small(train_task_behavior=True, actor_lr=2e-4, model_lr=1e-6, uncertainty_lr=0.0)
    other.load_state(path)
    rates = {name: optimizer.adam.param_groups[0]["lr"] for name, optimizer in other.optimizers.items()}
    assert (rates["world_model"], rates["uncertainty"]) == (1e-6, 0.0)
    assert (rates["task_actor"], rates["exploration_actor"], rates["task_critic"]) == (1e-5, 2e-4, other.preset.critic_lr)
    other.save(path)
    again = Challenger.load(path, "cpu")
    assert again.preset.model_lr == again.optimizers["world_model"].adam.param_groups[0]["lr"] == 1e-6
    assert again.optimizers["task_actor"].adam.param_groups[0]["lr"] == 1e-5


def test_a_crash_while_saving_leaves_the_old_file(tmp_path: pathlib.Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "challenger.pt"
    small().save(path)
    before = path.read_bytes()

    def crash(*args: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("os.fsync", crash)
    with pytest.raises(KeyboardInterrupt):
        small().save(path)
    assert path.read_bytes() == before and len(list(tmp_path.iterdir())) == 1


def test_files_that_are_none(tmp_path: pathlib.Path) -> None:
    path = tmp_path / "challenger.pt"
    with pytest.raises(ValueError, match="There is no file"):
        Challenger.load(path)
    small().save(path)
    whole = path.read_bytes()
    for content in (whole[: len(whole) // 2], whole[:10], b"", b"something else"):
        path.write_bytes(content)
        with pytest.raises(ValueError, match="is damaged or no saved challenger"):
            Challenger.load(path, "cpu")
    torch.save({"a": torch.zeros(2)}, path)
    with pytest.raises(ValueError, match="is no saved challenger"):
        Challenger.load(path, "cpu")


def test_another_size_names_the_first_mismatch_and_changes_nothing(tmp_path: pathlib.Path) -> None:
    path = tmp_path / "challenger.pt"
    small().save(path)
    other = small(deter_size=17)
    before = weights(other)
    with pytest.raises(
        ValueError, match=r"other sizes: world_model\.rssm\.gru\.gates\.weight is \(48, 32\) there and \(51, 33\)"
    ):
        other.load_state(path)
    assert all(np.array_equal(value, weights(other)[key]) for key, value in before.items())
    with pytest.raises(ValueError, match=r"no weight task\."):
        small(train_task_behavior=True).load_state(path)
    with pytest.raises(ValueError, match="was saved for the observations"):
        small(spaces.Dict({"other": vector()})).load_state(path)


def test_an_uncertainty_class_of_ones_own_has_to_be_named_when_loading(tmp_path: pathlib.Path) -> None:
    path = tmp_path / "challenger.pt"
    small(uncertainty_class=Signed).save(path)
    with pytest.raises(ValueError, match=r"a file cannot hold a class: Challenger\.load\(.*uncertainty_class=.*Signed\)"):
        Challenger.load(path, "cpu")
    assert isinstance(Challenger.load(path, "cpu", uncertainty_class=Signed).uncertainty, Signed)


# ---- bad input -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "space, action_space, kwargs, message",
    [
        (vector(), box(2), {}, "Dict observation space"),
        (VECTOR, spaces.Discrete(3), {}, r"continuous action space \(Box\)"),
        (VECTOR, spaces.Box(-np.inf, np.inf, (2,)), {}, "must be bounded"),
        (VECTOR, spaces.Box(-1, 1, (0,)), {}, "no dimension"),
        (VECTOR, spaces.Box(np.float32([-1, 0.5]), np.float32([1, 0.5])), {}, r"dimension 1 .* from 0.5 to 0.5.* no room"),
        (VECTOR, spaces.Box(-3e38, 3e38, (2, 3)), {}, r"dimension \(0, 0\) .* from -3e\+38 .* too wide.*RescaleAction"),
        (spaces.Dict({"a": image(32), "b": image(64)}), box(2), {}, "a: 32x32, b: 64x64"),
        (spaces.Dict({"d": spaces.Discrete(3)}), box(2), {}, "No observation key is usable"),
        (VECTOR, box(2), {"horizn": 3}, "Did you mean 'horizon'"),
        (VECTOR, box(2), {"latent": "uniform"}, "'latent' must be"),
        (VECTOR, box(2), {"uncertainty_class": "rnd2"}, "Unknown uncertainty class 'rnd2'. Did you mean 'rnd'"),
        (VECTOR, box(2), {"uncertainty_kwargs": {"head": 3}}, "uncertainty_kwargs: .*Did you mean 'heads'"),
        (VECTOR, box(2), {"uncertainty_class": int}, "subclass of Uncertainty"),
    ],
)
def test_what_it_cannot_work_with(space: spaces.Space, action_space: spaces.Space, kwargs: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Challenger(space, action_space, device="cpu", **kwargs)  # type: ignore[arg-type]


def test_the_report_preset_has_the_reports_sizes() -> None:
    challenger = Challenger(BOTH, box(7), device="cpu", preset="report")
    model = challenger.world_model
    assert (model.rssm.deter_size, model.latent.size, model.feat_dim) == (200, 50, 250)
    assert model.encoder.cnn is not None and model.encoder.cnn.output_dim == 32 * 32
    assert challenger.uncertainty.ensemble.heads == 10
    assert (challenger.batch_size, challenger.sequence_length) == (16, 50)


def test_the_reports_own_world_model_reads_images_only_and_has_two_heads() -> None:
    challenger = Challenger(BOTH, box(7), device="cpu", preset="report_images")
    model = challenger.world_model
    assert challenger.spec.image_keys == challenger.keys and challenger.keys
    assert model.continue_head is None and model.encoder.mlp is None and model.decoder.mlp is None
    assert Challenger(BOTH, box(7), device="cpu", preset="report").spec.vector_keys
    named = Challenger(BOTH, box(7), device="cpu", preset=SMALL, keys=list(BOTH), read_vectors=False)
    assert set(named.keys) == set(BOTH), "keys that are named are read"
    with pytest.raises(ValueError, match="No observation key is an image .* read_vectors=False leaves vectors out"):
        Challenger(VECTOR, box(2), device="cpu", preset="report_images")


# ---- leaving out what is not needed, starting from another one -------------------------------------------------------------


def test_without_exploration_it_follows_plays_and_learns_the_task_only() -> None:
    lean = small(train_exploration_behavior=False, train_task_behavior=True)
    assert not lean.explores and list(lean.behaviors) == ["task"] and list(lean.networks) == ["world_model", "task"]
    assert list(lean.optimizers) == ["world_model", "task_actor", "task_critic"]
    metrics = lean.train(random_batch(VECTOR, 2))
    assert "task_actor_loss" in metrics and not any("exploration" in name or "uncertainty" in name for name in metrics)
    assert lean.act(lean.initial_state(3), behavior="task").shape == (3, 2)
    batch = random_batch(VECTOR, 2)
    episode = {key: value[:, 0] for key, value in batch.observations.items()}, batch.actions[1:, 0]
    for call in (lambda: lean.act(lean.initial_state(1)), lambda: lean.evaluate(*episode), lambda: lean.exploration):
        with pytest.raises(ValueError, match="train_exploration_behavior"):
            call()


def test_a_lean_challenger_is_saved_and_loaded(tmp_path: pathlib.Path) -> None:
    lean = small(train_exploration_behavior=False, train_task_behavior=True)
    lean.train(random_batch(VECTOR, 2))
    lean.save(tmp_path / "lean.pt")
    loaded = Challenger.load(tmp_path / "lean.pt", device="cpu")
    assert all(np.array_equal(value, weights(loaded)[key]) for key, value in weights(lean).items())
    with pytest.raises(ValueError, match="no weight uncertainty"):
        small(train_task_behavior=True).load_state(tmp_path / "lean.pt")


def test_acting_for_the_task_and_acting_for_novelty_are_two_behaviors() -> None:
    challenger = small(train_task_behavior=True)
    state = challenger.initial_state(2)
    explores, plays = (challenger.act(state, deterministic=True, behavior=name) for name in ("exploration", "task"))
    assert not np.array_equal(explores, plays)
    assert np.array_equal(challenger.act(state, deterministic=True), explores), "a challenger explores unless told otherwise"
    with pytest.raises(ValueError, match="train_task_behavior"):
        small().act(small().initial_state(1), behavior="task")


def test_adopting_takes_what_both_have_and_shares_nothing() -> None:
    first, second = small(), small(train_task_behavior=True, model_lr=0.5)
    first.train(random_batch(VECTOR, 2))
    task = weights(second)
    assert second.adopt(first) == ("world_model", "uncertainty", "exploration") and second.trained_updates == 1
    mine, theirs = weights(second), weights(first)
    assert all(np.array_equal(mine[key], value) for key, value in theirs.items())
    assert all(np.array_equal(mine[key], value) for key, value in task.items() if key.startswith("task."))
    assert second.optimizers["world_model"].adam.param_groups[0]["lr"] == 0.5
    second.train(random_batch(VECTOR, 2, seed=1))
    assert all(np.array_equal(weights(first)[key], value) for key, value in theirs.items())
    moments = [one.optimizers["world_model"].adam.state_dict()["state"][0]["exp_avg"] for one in (first, second)]
    assert not torch.equal(*moments)


@pytest.mark.parametrize(
    "kwargs, message",
    [
        ({"space": spaces.Dict({"state": vector(4)})}, "reads the observations"),
        ({"actor_units": 17}, r"exploration\.actor\.net\.0\.weight"),
        ({"action_dim": 3}, "other sizes"),
        ({"uncertainty_class": "rnd"}, "has the uncertainty rnd"),
    ],
)
def test_adopting_from_a_stranger_changes_nothing(kwargs: dict, message: str) -> None:
    mine = small()
    before = weights(mine)
    with pytest.raises(ValueError, match=message):
        mine.adopt(small(**kwargs))
    assert all(np.array_equal(value, before[key]) for key, value in weights(mine).items())
