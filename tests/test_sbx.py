"""Players of SBX (JAX) with our buffer and callback; skipped where SBX is not installed."""

import gymnasium as gym
import numpy as np
import pytest
from challenger_helpers import SMALL

sbx = pytest.importorskip("sbx", reason="SBX is not installed: pip install sbx-rl")

from sb3_cpm import ChallengerCallback, CPMBuffer  # noqa: E402
from sb3_cpm.envs import DictObservation  # noqa: E402


def environment() -> gym.Env:
    return DictObservation(gym.make("Pendulum-v1", max_episode_steps=30))


@pytest.mark.filterwarnings("ignore")  # JAX's and Flax's own
@pytest.mark.slow  # JAX compiles
@pytest.mark.parametrize(
    "algorithm, policy", [("SAC", "MultiInputPolicy"), ("SAC", "SimbaPolicy"), ("CrossQ", "MultiInputPolicy")]
)
def test_players_of_sbx(algorithm, policy, tmp_path):
    kind = getattr(sbx, algorithm)
    arguments = dict(learning_starts=60, buffer_size=600, train_freq=10, policy_kwargs=dict(net_arch=[16]), seed=0)
    # all challenges are kept, so that the player has learnt from some
    lenient = dict(filter_kwargs=dict(novelty_tolerance=1e5, relevance_tolerance=1e5), challenge_ratio=0.5, mix="row")
    model = kind(policy, environment(), replay_buffer_class=CPMBuffer, replay_buffer_kwargs=lenient, **arguments)
    callback = ChallengerCallback(SMALL, decay="constant", train_freq=20)
    model.learn(150, callback=callback)
    assert callback.challenger.trained_updates >= 3 and model._n_updates >= 5
    assert 0.5 < callback.explored_share < 1.0 and len(model.replay_buffer.challenges) > 0
    model.save(tmp_path / "model")
    model.save_replay_buffer(tmp_path / "buffer.pkl")
    loaded = kind.load(tmp_path / "model", environment())
    loaded.load_replay_buffer(tmp_path / "buffer.pkl")
    loaded.learn(40, callback=callback, reset_num_timesteps=False)
    action, _ = loaded.predict(loaded.env.reset(), deterministic=True)
    assert np.isfinite(action).all() and len(loaded.replay_buffer.episodes) == 6
