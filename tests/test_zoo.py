"""The bridge to rl_zoo3: ids, configurations, checks, search spaces, continued runs, and its commands from end to end."""

import argparse
import copy
import os
import pickle
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import optuna
import pytest
import standin_assets
import torch as th
import yaml
from gymnasium import spaces
from rl_zoo3 import exp_manager
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from rl_zoo3.utils import ALGOS
from stable_baselines3 import SAC
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.envs import BitFlippingEnv
from warm_python import WarmPython

from sb3_cpm import ChallengerCallback, CPMBuffer
from sb3_cpm.agents import load_agent
from sb3_cpm.agents.configs import read_entries
from sb3_cpm.agents.tasks import ENV_IDS, TASKS, env_id_of
from sb3_cpm.challenger import Challenger
from sb3_cpm.dreamer import Dreamer, Plan2Explore
from sb3_cpm.extractors import PointNetExtractor
from sb3_cpm.extras import config_folder
from sb3_cpm.presets import CHALLENGES
from sb3_cpm.zoo import search
from sb3_cpm.zoo.__main__ import complete, main
from sb3_cpm.zoo.bridge import install
from sb3_cpm.zoo.policies import CameraExtractor
from sb3_cpm.zoo.resume import challenger_file
from sb3_cpm.zoo.wrappers import RGBD, TerminationIsSuccess, as_dict

CONFIGS = sorted(config_folder().glob("*.yml"))
ENTRIES = [(path.stem, name) for path in CONFIGS for name in read_entries(path) if not name.startswith(".")]
TOY = "CPMToy-v0"
Command = Callable[[str, list[str], Path], str]


def known(env_id: str) -> bool:
    return env_id in gym.registry or env_id == "default"


@pytest.fixture(scope="module")
def imported(tmp_path_factory: pytest.TempPathFactory) -> set[str]:
    """What importing the bridge brings into a fresh interpreter."""
    return set(run(["-c", "import sys, sb3_cpm.zoo; print(*sys.modules)"], tmp_path_factory.mktemp("imported")).split())


# ---------------------------------------------------------------------- ids and names
def test_tasks_are_registered_without_importing_maniskill(imported: set[str]) -> None:
    assert len(ENV_IDS) == 2 * len(TASKS) == 14 and all(env_id in gym.registry for env_id in ENV_IDS)
    assert env_id_of("TurnFaucet-v1", state=True) == "CPM/TurnFaucetState-v1"
    assert not imported & {"mani_skill", "sapien"}


def test_rl_zoo3_knows_our_names() -> None:
    before = {algo: HYPERPARAMS_SAMPLER[algo] for algo in search.PLAYERS}
    method = exp_manager.ExperimentManager.learn
    install()  # once more: nothing is wrapped twice
    assert before == {algo: HYPERPARAMS_SAMPLER[algo] for algo in search.PLAYERS}
    assert exp_manager.ExperimentManager.learn is method
    assert eval("CPMHerReplayBuffer", vars(exp_manager)) is CPMBuffer
    assert (ALGOS["dreamer"], ALGOS["plan2explore"], ALGOS["sac"], ALGOS["rlpd"]) == (Dreamer, Plan2Explore, SAC, SAC)


# ---------------------------------------------------------------------- the files
@pytest.mark.parametrize("name, env_id", ENTRIES)
def test_entries_have_only_keys_that_somebody_takes(name: str, env_id: str) -> None:
    if env_id.startswith("PointMaze"):
        pytest.importorskip("gymnasium_robotics")
    agent = load_agent(name, TOY if env_id == "default" else env_id)
    assert agent.n_timesteps >= 2_000 and agent.n_envs >= 1


def test_every_file_of_the_report_has_the_seven_tasks_and_a_default() -> None:
    others = {"cpm_sac_quick", "cpm_td3", "cpm_tqc", "sac_layernorm", "sac_simba"}
    demonstrated = {"bc_ppo", "dapg", "rlpd", "cpm_rlpd", "cpm_rlpd_quick"}
    assert len(CONFIGS) == 21
    for path in CONFIGS:
        if path.stem == "gail_sac":  # rewards are its own: constants for any environment would be none
            continue
        if path.stem in others | demonstrated:
            assert {"default", "CPM/PickCube-v1"} <= set(read_entries(path)), path
            continue
        assert {"default", *(env_id_of(task) for task in TASKS)} <= set(read_entries(path)), path


def test_agents_that_are_compared_differ_in_what_is_compared() -> None:
    cpm, slow, plain = (
        read_entries(config_folder() / f"{name}.yml") for name in ("cpm_sac", "cpm_sac_high_exploration", "sac")
    )
    for env_id, entry in cpm.items():
        if env_id in slow:
            assert {**entry, "callback": None} == {**slow[env_id], "callback": None}
            assert entry["callback"] != slow[env_id]["callback"]
        if env_id in plain:
            same = set(entry) - {"callback", "replay_buffer_class", "replay_buffer_kwargs", "env_wrapper", "policy"}
            assert {key: entry[key] for key in same} == {key: plain[env_id][key] for key in same}, env_id
    assert cpm["CPM/PickCube-v1"]["policy"] == plain["CPM/PickCube-v1"]["policy"] == "sb3_cpm.PointNetPolicy"


def test_rlpd_with_a_challenger_differs_in_it_only() -> None:
    plain, cpm = (read_entries(config_folder() / f"{name}.yml") for name in ("rlpd", "cpm_rlpd"))
    assert plain.keys() == cpm.keys()
    for env_id, entry in cpm.items():
        *callbacks, challenger = entry["callback"]
        assert "sb3_cpm.ChallengerCallback" in challenger and callbacks == plain[env_id]["callback"]
        buffer = {**plain[env_id]["replay_buffer_kwargs"], "challenge_ratio": 0.25, "max_challenges": 10}
        assert entry == {**plain[env_id], "callback": entry["callback"], "replay_buffer_kwargs": buffer}, env_id


def test_arguments_for_one_of_several_callbacks_leave_the_others() -> None:
    plain = load_agent("cpm_rlpd_quick", TOY).hyperparameters["callback"]
    challenger = {"sb3_cpm.ChallengerCallback": {"decay": "cosine"}}
    clone, bc, changed = load_agent("cpm_rlpd_quick", TOY, {"callback": challenger}).hyperparameters["callback"]
    assert [clone, bc] == plain[:2]
    assert changed == {"sb3_cpm.ChallengerCallback": {"demonstration_challenges": 0.25, "decay": "cosine"}}
    without = {"callback": {"sb3_cpm.imitation.BCLossCallback": None}}
    assert load_agent("cpm_rlpd_quick", TOY, without).hyperparameters["callback"] == [plain[0], plain[2]]
    assert load_agent("cpm_rlpd_quick", TOY, {"callback": [challenger]}).hyperparameters["callback"] == [challenger]


def test_tuned_differs_in_its_challenges_only() -> None:
    simple, tuned = (read_entries(config_folder() / f"{name}.yml") for name in ("cpm_sac", "cpm_sac_tuned"))
    assert set(tuned) == {*simple, ".challenges"} - {"CPMToy-v0"}
    for env_id, entry in simple.items():
        if env_id not in tuned:
            continue
        expected = {**entry, "replay_buffer_kwargs": {**entry["replay_buffer_kwargs"], **CHALLENGES["tuned"]}}
        assert tuned[env_id] == expected, env_id


def test_report_has_the_constants_of_the_report() -> None:
    agent = load_agent("cpm_sac_report", "CPM/PickCube-v1")
    constants = agent.hyperparameters
    assert constants["buffer_size"] == 50 * 50 and constants["gradient_steps"] == 6
    assert constants["replay_buffer_kwargs"] == {"challenge_ratio": 0.25, "mix": "batch", "max_challenges": 10}
    assert constants["gamma"] == 0.99
    assert constants["callback"]["sb3_cpm.ChallengerCallback"]["preset"] == "report_images"
    assert load_agent("cpm_sac_report", "CPM/TurnFaucet-v1").hyperparameters["buffer_size"] == 50 * 200
    assert load_agent("cpm_sac_report", "CPM/OpenCabinetDoor-v1").hyperparameters["buffer_size"] == 50 * 100


SHORT = {
    "ppo": {"n_envs": 1, "n_steps": 60, "batch_size": 60, "n_epochs": 1},
    "off-policy": {"learning_starts": 50, "train_freq": 20, "gradient_steps": 1},
}


def short(name: str) -> dict[str, Any]:
    return SHORT["ppo" if "ppo" in name or name == "dapg" else "off-policy"]


@pytest.mark.parametrize("name", [path.stem for path in CONFIGS if path.stem != "sac_her"])
def test_default_entry_trains_on_a_dict_environment(name: str) -> None:
    built = load_agent(name, TOY, {**short(name), "batch_size": 32} if "sac" in name else short(name)).build(0, device="cpu")
    if name == "cpm_sac_report":  # an update of a challenger of that size takes seconds
        built.callbacks[0].gradient_steps = 0  # type: ignore[attr-defined]
    built.model.learn(60, callback=built.callbacks)
    assert built.model._n_updates > 0
    if name.startswith("cpm"):
        (challenger,) = (one for one in built.callbacks if isinstance(one, ChallengerCallback))
        assert challenger.challenger is not None
    evaluation = built.make_eval_env()
    action, _ = built.model.predict(evaluation.reset(), deterministic=True)  # type: ignore[arg-type]
    evaluation.step(action)
    evaluation.close()
    built.env.close()


def test_default_entry_of_hindsight_trains_on_goals_and_refuses_others() -> None:
    if "BitFlips-v0" not in gym.registry:
        gym.register(
            "BitFlips-v0", entry_point=lambda **kwargs: BitFlippingEnv(continuous=True, **kwargs), max_episode_steps=8
        )
    built = load_agent("sac_her", "BitFlips-v0", {"learning_starts": 20, "batch_size": 8}).build(0, device="cpu")
    built.model.learn(30)
    assert built.model._n_updates == 10
    with pytest.raises(ValueError, match="desired_goal"):
        load_agent("sac_her", TOY).build(0, device="cpu")


@pytest.mark.parametrize("name", ["sac", "cpm_sac", "dreamer", "plan2explore"])
def test_mountain_car_trains(name: str) -> None:
    overrides = {"learning_starts": 1000, "env_kwargs": {"max_episode_steps": 20}}
    built = load_agent(name, "MountainCarContinuous-v0", overrides).build(0, device="cpu")
    built.model.learn(25, callback=built.callbacks)
    assert built.model.num_timesteps == 25
    built.env.close()


@pytest.mark.parametrize("name", ["sac", "sac_her", "cpm_sac"])
def test_point_maze_trains(name: str) -> None:
    pytest.importorskip("gymnasium_robotics")
    built = load_agent(name, "PointMaze_UMaze-v3").build(0, device="cpu")
    built.model.learn(4, callback=built.callbacks)
    built.env.close()


# ---------------------------------------------------------------------- all agents on all tasks
@pytest.fixture(scope="module")
def standins(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("assets")
    standin_assets.make_all(folder)
    return folder


def run(arguments: list[str], folder: Path, **environment: str) -> str:
    """:return: what the command printed; it must end well"""
    root = str(Path(__file__).resolve().parents[1])
    variables = {**os.environ, "PYTHONPATH": root, "MPLBACKEND": "Agg", "OMP_NUM_THREADS": "1", **environment}
    command = [sys.executable, "-W", "ignore", *arguments]
    done = subprocess.run(
        command, env=variables, cwd=folder, capture_output=True, text=True, timeout=900, stdin=subprocess.DEVNULL
    )
    return check(done)


def check(done: "subprocess.CompletedProcess[str]") -> str:
    assert done.returncode == 0, f"{' '.join(done.args)}\n{done.stdout[-3000:]}\n{done.stderr[-5000:]}"
    return done.stdout


@pytest.mark.slow
@pytest.mark.maniskill
def test_all_agents_on_all_tasks(standins: Path, tmp_path: Path) -> None:
    here = Path(__file__).parent
    output = run(
        [
            "-m",
            "pytest",
            "-q",
            "-p",
            "no:cacheprovider",
            "-c",
            str(here.parent / "pyproject.toml"),
            str(here / "zoo_on_assets.py"),
        ],
        tmp_path,
        MS_ASSET_DIR=str(standins),
    )
    assert "skipped" not in output


# ---------------------------------------------------------------------- bad input
def edited(folder: Path, change: Callable[[dict[str, Any]], None]) -> Path:
    entries = yaml.safe_load((config_folder() / "cpm_sac.yml").read_text())
    change(entries["default"])
    path = folder / "my_sac.yml"
    path.write_text(yaml.safe_dump({"default": entries["default"]}))
    return path


@pytest.mark.parametrize(
    "change, message",
    [
        ({"gama": 0.9}, "unknown key 'gama'. Did you mean 'gamma'"),
        ({"n_timestep": 5}, "Did you mean 'n_timesteps'"),
        ({"replay_buffer_kwargs": {"challange_ratio": 0.1}}, "replay_buffer_kwargs: .*Did you mean 'challenge_ratio'"),
        ({"policy_kwargs": {"net_arhc": [3]}}, "policy_kwargs: .*Did you mean 'net_arch'"),
        ({"callback": {"sb3_cpm.ChallengerCallback": {"trainfreq": 1}}}, "ChallengerCallback: .*Did you mean 'train_freq'"),
        ({"replay_buffer_kwargs": "dict(challange_ratio=0.1)"}, "replay_buffer_kwargs: .*Did you mean 'challenge_ratio'"),
        ({"replay_buffer_kwargs": {"device": "cpu"}}, "replay_buffer_kwargs: 'device' is set elsewhere"),
        (
            {"replay_buffer_kwargs": {"reward_kwargs": {"scal": 1}}},
            "replay_buffer_kwargs: reward_kwargs: .*Did you mean 'scale'",
        ),
        ({"replay_buffer_kwargs": {"challenge_ratio": "quarter"}}, "challenge_ratio must be .* got 'quarter'"),
        ({"replay_buffer_class": "CPMHerReplayBufer"}, "cannot evaluate .*Did you mean 'CPMHerReplayBuffer'"),
        ({"policy_kwargs": "dict(net_arhc=[3])"}, "policy_kwargs: .*Did you mean 'net_arch'"),
        ({"policy_kwargs": "dict(net_arch=[3]"}, r"policy_kwargs: Python cannot evaluate 'dict\(net_arch=\[3\]'"),
        ({"policy_kwargs": {"features_extractor_kwargs": {"state_ach": [3]}}}, "Did you mean 'state_arch'"),
        (
            {"policy_kwargs": {"features_extractor_class": "sb3_cpm.PointNetExtractor"}},
            r'must be a class, .* in quotes: "dict\(features_extractor_class=PointNetExtractor\)"',
        ),
        ({"callback": {"sb3_cpm.ChallengerCallback": {"preset": "defalt"}}}, "ChallengerCallback: .*Did you mean 'default'"),
        ({"callback": {"sb3_cpm.ChallengerCallback": {"preset": {"horizn": 3}}}}, "Did you mean 'horizon'"),
        ({"callback": {"sb3_cpm.ChallengerCallback": {"decay_kwargs": {"strat": 0.9}}}}, "Did you mean 'start'"),
        ({"callback": {"sb3_cpm.ChallengerCallback": None}}, "must be a mapping, got None: write {} for none"),
        ({"callback": {"ChallengerCallback": {}}}, "'ChallengerCallback' must begin with its module"),
        ({"policy": "MultiInputPolcy"}, "sac has no policy 'MultiInputPolcy'. Did you mean 'MultiInputPolicy'"),
        ({"policy": "sb3_cpm.PointNetPolcy"}, "sb3_cpm has no 'PointNetPolcy'. Did you mean 'PointNetPolicy'"),
        ({"env_kwargs": {"n_point": 3}}, "env_kwargs: unknown key 'n_point'. Did you mean 'n_points'"),
        ({"callback": "sb3_cpm.ChalengerCallback"}, "sb3_cpm has no 'ChalengerCallback'. Did you mean 'ChallengerCallback'"),
        ({"callback": "sb3_cmp.ChallengerCallback"}, "cannot import 'sb3_cmp.ChallengerCallback'"),
        ({"env_wrapper": {"sb3_cpm.zoo.wrappers.RGBD": {"max_dept": 1}}}, "RGBD: .*Did you mean 'max_depth'"),
        ({"policy": None}, "policy must be there"),
    ],
)
def test_misspelt_keys_name_the_nearest(change: dict[str, Any], message: str, tmp_path: Path) -> None:
    def apply(entry: dict[str, Any]) -> None:
        entry.update(change)
        for key in [key for key, value in change.items() if value is None]:
            del entry[key]

    path = edited(tmp_path, apply)
    with pytest.raises(ValueError, match=message):
        load_agent(path, TOY)
    with pytest.raises(ValueError, match=message):
        manager_of("sac", tmp_path, 10, config=str(path)).setup_experiment()
    assert not list(tmp_path.glob("sac/*")), "something was built before the error"


NUMBER_KEYS = ("n_timesteps", "n_envs", "buffer_size", "learning_starts", "batch_size", "learning_rate", "gamma", "tau")
NUMBER_KEYS = (*NUMBER_KEYS, "train_freq", "gradient_steps", "noise_std", "ent_coef", "target_update_interval")


@pytest.mark.parametrize("key", NUMBER_KEYS)
@pytest.mark.parametrize("text", ["1e3", "'3.0e-4'", '"0.5"', "2E+4"])
def test_numbers_that_yaml_takes_for_text(key: str, text: str, tmp_path: Path) -> None:
    path = edited(tmp_path, lambda entry: entry.update({key: yaml.safe_load(text)}))
    with pytest.raises(ValueError, match=rf"{TOY}: {key} must be .* That is text: leave quotes away, and give an exponent a"):
        load_agent(path, TOY)


@pytest.mark.parametrize(
    "change, where",
    [
        ({"replay_buffer_kwargs": {"warmup_steps": "1e1"}}, "replay_buffer_kwargs, warmup_steps"),
        ({"callback": [{"stable_baselines3.common.callbacks.CheckpointCallback": {"save_freq": "1e4"}}]}, "save_freq"),
        ({"env_kwargs": {"n_points": "4e1"}}, "env_kwargs, n_points"),
        ({"policy_kwargs": {"net_arch": ["1e2", 32]}}, "policy_kwargs, net_arch"),
        ({"train_freq": ["1e1", "step"]}, "train_freq"),
    ],
)
def test_numbers_as_text_deeper_down(change: dict[str, Any], where: str, tmp_path: Path) -> None:
    path = edited(tmp_path, lambda entry: entry.update(change))
    with pytest.raises(ValueError, match=f"{where} must be a number.* That is text"):
        load_agent(path, TOY)


@pytest.mark.parametrize(
    "change, message",
    [
        ({"buffer_size": 1.0e4}, "buffer_size must be an integer of at least 1, got 10000.0. Write 10000."),
        ({"n_timesteps": 0.5}, "n_timesteps must be a whole number"),
        ({"gamma": 99}, "gamma must be a number from 0 to 1, got 99"),
        ({"n_envs": 0}, "n_envs must be"),
        ({"learning_starts": True}, "learning_starts must be"),
        ({"n_steps": 3}, "one-step returns only"),
        ({"replay_buffer_kwargs": {"n_steps": 3}}, "one-step returns only"),
    ],
)
def test_numbers_that_no_run_can_work_with(change: dict[str, Any], message: str, tmp_path: Path) -> None:
    path = edited(tmp_path, lambda entry: entry.update(change))
    with pytest.raises(ValueError, match=message):
        load_agent(path, TOY)


def test_texts_that_are_meant_as_such(tmp_path: Path) -> None:
    given = {"learning_rate": "lin_3e-4", "n_timesteps": 1.0e6, "ent_coef": "auto_0.1", "gradient_steps": -1}
    path = edited(tmp_path, lambda entry: entry.update(given))
    assert load_agent(path, TOY).hyperparameters["learning_rate"] == "lin_3e-4"


def test_misspelt_environments_name_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="Unknown environment 'CPM/PickCub-v1'. Did you mean 'CPM/PickCube-v1'"):
        load_agent("sac", "CPM/PickCub-v1")
    path = tmp_path / "my_sac.yml"
    entry = read_entries(config_folder() / "sac.yml")["default"]
    path.write_text(yaml.safe_dump({"CPM/PickCub-v1": entry, "default": entry}))
    with pytest.raises(ValueError, match="no environment 'CPM/PickCub-v1'. Did you mean 'CPM/PickCube-v1'"):
        load_agent(path, "CPM/PickCube-v1")
    # it may be another package's: there is no knowing, so the one that was asked for is not refused
    path.write_text(yaml.safe_dump({"MountainCarContinous-v0": entry, "default": {**entry, "gamma": 0.5}}))
    with pytest.warns(UserWarning, match="gets the default.*did you mean 'MountainCarContinuous-v0'"):
        assert load_agent(path, "MountainCarContinuous-v0").hyperparameters["gamma"] == 0.5
    path.write_text(yaml.safe_dump({TOY: entry}))
    with pytest.raises(ValueError, match="neither an entry 'Pendulum-v1' nor a default"):
        load_agent(path, "Pendulum-v1")
    # another version is no slip, and neither is what another package registers
    path.write_text(yaml.safe_dump({"Pendulum-v0": entry, "MinitaurBulletEnv-v0": entry, "default": entry}))
    assert load_agent(path, "Pendulum-v1").algo == "sac"


@pytest.mark.parametrize(
    "text, message", [("a: [", "is not YAML"), ("- a", "expected hyperparameters by environment"), ("default: 3", "a mapping")]
)
def test_files_that_are_no_configurations(text: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "my_sac.yml"
    path.write_text(text)
    with pytest.raises(ValueError, match=message):
        load_agent(path, TOY)


@pytest.mark.parametrize(
    "name, changes, message",
    [
        ("dreamer", {"preset": "defalt"}, "Did you mean 'default'"),
        ("dreamer", {"preset": {"uncertainty": {"plan2explor": {}}}}, "Did you mean 'plan2explore'"),
        ("dreamer", {"preset": {"uncertainty": {"rnd": {"unit": 3}}}, "start_from": "explorer.zip"}, "Did you mean 'units'"),
        ("dreamer", {"replay_buffer_kwargs": {"memap_dir": "d"}}, "replay_buffer_kwargs: .*Did you mean 'memmap_dir'"),
        ("plan2explore", {"uncertainty_class": "rmd"}, "Did you mean 'rnd'"),
        ("plan2explore", {"uncertainty_kwargs": {"head": 3}}, "uncertainty_kwargs: .*Did you mean 'heads'"),
        ("ppo_pointcloud", {"policy_kwargs": {"features_extractor_kwargs": {"size": 3}}}, "Did you mean 'sizes'"),
    ],
)
def test_misspelt_keys_of_other_algorithms(name: str, changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        load_agent(name, TOY, changes)
    explored = {
        "start_from": "explorer.zip",
        "uncertainty_kwargs": {"inputs": "stoch"},
    }  # of its class, which is not known yet
    assert load_agent("plan2explore", TOY, explored).algo == "plan2explore"


@pytest.mark.parametrize("algo", ["td3", "ddpg", "tqc"])
def test_policies_of_other_algorithms_are_refused(algo: str, tmp_path: Path) -> None:
    entry = read_entries(config_folder() / "cpm_sac.yml")["default"]
    path = tmp_path / f"my_{algo}.yml"
    path.write_text(yaml.safe_dump({"default": {key: value for key, value in entry.items() if key != "ent_coef"}}))
    message = f"PointNetPolicy is a policy of sac, rlpd, not of {algo}.*take policy: MultiInputPolicy"
    with pytest.raises(ValueError, match=message):
        load_agent(path, TOY)
    advised = {"policy": "MultiInputPolicy", "policy_kwargs": "dict(features_extractor_class=PointNetExtractor)"}
    built = load_agent(path, TOY, advised).build(0, device="cpu")
    assert isinstance(built.model.policy.actor.features_extractor, PointNetExtractor)
    built.env.close()


def test_arguments_of_our_tasks_are_checked() -> None:
    with pytest.raises(ValueError, match="env_kwargs: unknown key 'image_sise'. Did you mean 'image_size'"):
        load_agent("sac", "CPM/PickCube-v1", {"env_kwargs": {"image_sise": 16}})
    assert load_agent("sac", "CPM/PickCube-v1", {"env_kwargs": {"robot_init_qpos_noise": 0.1}}).algo == "sac"  # ManiSkill's


# ---------------------------------------------------------------------- wrappers and policies
def test_wrappers() -> None:
    env = as_dict(gym.make("Pendulum-v1"))
    assert list(env.observation_space.spaces) == ["state"]  # type: ignore[attr-defined]
    assert as_dict(env) is env
    car = TerminationIsSuccess(gym.make("MountainCarContinuous-v0"))
    car.reset(seed=0)
    assert car.step(car.action_space.sample())[-1]["is_success"] is False
    car.unwrapped.state = np.array([0.449, 0.07])  # type: ignore[attr-defined]
    assert car.step(np.array([1.0], dtype=np.float32))[-1]["is_success"] is True
    with pytest.raises(ValueError, match="RGBD needs a task of make_maniskill_env with cameras"):
        RGBD(gym.make("Pendulum-v1"))


@pytest.mark.maniskill
def test_depth_is_how_far_away_things_are() -> None:
    plain = gym.make("CPM/PickCube-v1", image_size=32, n_points=0)
    env = RGBD(plain, max_depth=2.0)
    observation, _ = env.reset(seed=5)
    assert env.observation_space.contains(observation)
    first = observation["base_camera"]
    env.step(np.array([0, 0, 1, 0, 0, 0, 1], dtype=np.float32))
    twice, _ = env.reset(seed=5)
    assert (twice["base_camera"] == first).all()
    camera = plain.get_wrapper_attr("batch").env._sensors["base_camera"]
    # the middle of the picture shows the table: where the camera's axis meets z = 0
    pose = camera.camera.get_model_matrix()[0].cpu().numpy()
    eye, forward = pose[:3, 3], -pose[:3, 2]
    expected = -eye[2] / forward[2]
    assert first[20:, :, 3].max() < 255 and first[0, :, 3].max() == 255  # table below, the horizon above
    assert np.median(first[15:17, :8, 3]) * 2.0 / 255 == pytest.approx(expected, rel=0.15)
    seen, _ = plain.reset(seed=5)
    assert (seen["base_camera"] == first[..., :3]).all()
    assert RGBD(plain, max_depth=1.0).observation(seen)["base_camera"][20:, :, 3] == pytest.approx(
        2.0 * first[20:, :, 3], abs=2
    )
    with pytest.raises(ValueError, match="expected more than 0 metres"):
        RGBD(plain, max_depth=0)
    with pytest.raises(ValueError, match="with cameras"):
        RGBD(gym.make("CPM/PickCubeState-v1"))


def test_camera_extractor_reads_pictures_and_vectors() -> None:
    space = spaces.Dict(
        {
            "cloud": spaces.Box(-1, 1, (20, 6), np.float32),
            "camera": spaces.Box(0, 255, (4, 32, 32), np.uint8),
            "state": spaces.Box(-1, 1, (5,), np.float32),
        }
    )
    extractor = CameraExtractor(space)
    assert extractor.player_keys == ("camera", "state") and extractor.features_dim == 128 + 64
    assert CameraExtractor(space, keys=["state"]).features_dim == 64
    model = load_agent("ppo_rgbd", TOY, short("ppo")).build(0, device="cpu").model
    assert isinstance(model.policy.features_extractor, CameraExtractor)
    assert model.policy.features_extractor.cloud_keys == []


# ---------------------------------------------------------------------- search spaces
class FixedTrial:
    """A trial of Optuna that takes the first or the lowest of everything."""

    def __init__(self) -> None:
        self.params: dict[str, Any] = {}

    def suggest_float(self, name: str, low: float, high: float, log: bool = False) -> float:
        return self.params.setdefault(name, low)

    def suggest_int(self, name: str, low: int, high: int) -> int:
        return self.params.setdefault(name, low)

    def suggest_categorical(self, name: str, choices: list[Any]) -> Any:
        return self.params.setdefault(name, choices[0])

    def set_user_attr(self, name: str, value: Any) -> None:
        pass


def manager_of(algo: str, folder: Path, n_timesteps: int, **kwargs: Any) -> exp_manager.ExperimentManager:
    """What ``python -m rl_zoo3.train`` makes, without evaluations."""
    arguments = {"eval_freq": -1, "log_interval": -1, "verbose": 0, "device": "cpu", **kwargs}
    return exp_manager.ExperimentManager(argparse.Namespace(), algo, TOY, str(folder), n_timesteps=n_timesteps, **arguments)


@pytest.mark.parametrize("algo", search.PLAYERS)
def test_trials_merge_with_the_configuration(algo: str, tmp_path: Path) -> None:
    manager = manager_of(algo, tmp_path, 10)
    manager._hyperparams = {
        "policy_kwargs": {"share_features_extractor": False},
        "replay_buffer_kwargs": {"filter_kwargs": {"novelty_tolerance": 3.0}},
    }
    manager.specified_callbacks = [
        "rl_zoo3.callbacks.RawStatisticsCallback",
        {"sb3_cpm.ChallengerCallback": {"preset": "report"}},
    ]
    before = copy.deepcopy(vars(manager)["_hyperparams"])
    trial = FixedTrial()
    with search.sampled(manager, trial) as changed:
        of_player = HYPERPARAMS_SAMPLER[algo](trial, 2, 1, {"using_her_replay_buffer": False, "her_kwargs": {}})
    buffer = changed._hyperparams["replay_buffer_kwargs"]
    assert buffer == {
        "filter_kwargs": {"novelty_tolerance": 3.0},
        "challenge_ratio": 0.05,
        "mix": "batch",
        "max_challenges": 5,
    }
    (path, kwargs) = next(iter(changed.specified_callbacks[1].items()))
    assert path == "sb3_cpm.ChallengerCallback"
    assert kwargs["preset"] == "report" and kwargs["train_freq"] == 10 and kwargs["unit"] == "step"
    assert kwargs["decay_kwargs"] == {"start": 0.3, "floor": 0.01, "rate": 1.0}
    ChallengerCallback(**kwargs)
    assert of_player["policy_kwargs"] == {"share_features_extractor": False, "net_arch": [64, 64]} | (
        {"n_quantiles": 5} if algo == "tqc" else {}
    )
    assert manager._hyperparams == before and manager.specified_callbacks[1] == {
        "sb3_cpm.ChallengerCallback": {"preset": "report"}
    }
    # and back from the names that the study shows
    converted = HYPERPARAMS_CONVERTER[algo](dict(trial.params))
    assert converted.pop(search.OURS).keys() == {*search.BUFFER_SPACE, *search.CALLBACK_SPACE}
    assert not set(converted) & {*search.BUFFER_SPACE, *search.CALLBACK_SPACE}


def test_decays_of_trials_are_possible() -> None:
    start, floor = (search.CALLBACK_SPACE[name].suggest for name in ("decay_start", "decay_floor"))

    class Highest(FixedTrial):
        def suggest_float(self, name: str, low: float, high: float, log: bool = False) -> float:
            return high

    assert floor(Highest(), "floor") <= start(FixedTrial(), "start")


def test_a_player_without_challenger_is_searched_as_ever(tmp_path: Path) -> None:
    manager = manager_of("sac", tmp_path, 10)
    manager._hyperparams, manager.specified_callbacks = {"policy_kwargs": {}}, []
    trial = FixedTrial()
    with search.sampled(manager, trial) as changed:
        assert changed._hyperparams == {"policy_kwargs": {}} and changed.specified_callbacks == []
    assert trial.params == {}


def test_dreamer_trials_keep_the_preset(tmp_path: Path) -> None:
    manager = manager_of("dreamer", tmp_path, 10)
    manager.specified_callbacks = []
    for preset, deter_size in (({"deter_size": 77}, 77), ("report", 200)):
        manager._hyperparams = {"preset": preset}
        with search.sampled(manager, FixedTrial()):
            found = HYPERPARAMS_SAMPLER["dreamer"](FixedTrial(), 2, 1, {})
        assert found["preset"]["deter_size"] == deter_size and found["preset"]["horizon"] == 8 and found["train_freq"] == 2
    trial = FixedTrial()
    HYPERPARAMS_SAMPLER["plan2explore"](trial, 2, 1, {})
    assert HYPERPARAMS_CONVERTER["dreamer"](trial.params)["preset"]["gamma"] == 0.9


CONFIGURED = {
    "n_timesteps": 10,
    "policy": "MultiInputPolicy",
    "policy_kwargs": {"share_features_extractor": False},
    "replay_buffer_class": "CPMBuffer",
    "replay_buffer_kwargs": {"filter_kwargs": {"novelty_tolerance": 3.0}},
    "callback": {"sb3_cpm.ChallengerCallback": {"preset": "report"}},
}


@pytest.fixture
def study(tmp_path: Path) -> dict[str, Any]:
    """What ``--storage --study-name --trial-id`` say of a study with two trials, the second of which is ours."""
    storage = optuna.storages.journal.JournalFileBackend(str(tmp_path / "study.log"))
    made = optuna.create_study(storage=optuna.storages.JournalStorage(storage), study_name="s")
    sampled = FixedTrial()
    HYPERPARAMS_SAMPLER["sac"](sampled, 2, 1, {"using_her_replay_buffer": False, "her_kwargs": {}})
    params = {**sampled.params, "challenge_ratio": 0.4, "challenge_mix": "row", "decay": "linear"}
    trial = optuna.trial.create_trial(
        params=params,
        distributions={name: optuna.distributions.CategoricalDistribution([value]) for name, value in params.items()},
        value=1.0,
    )
    made.add_trials([trial, trial])
    return {"storage": str(tmp_path / "study.log"), "study_name": "s", "trial_id": 1}


@pytest.mark.parametrize("kind", ["yml", "py", "module"])
def test_a_trial_goes_into_any_configuration(
    kind: str, study: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"trial_of_sac.{'yml' if kind == 'yml' else 'py'}"
    entries = {TOY: CONFIGURED}
    path.write_text(yaml.safe_dump(entries) if kind == "yml" else f"hyperparams = {entries!r}")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "trial_of_sac", raising=False)
    config = "trial_of_sac" if kind == "module" else str(path)
    found, _ = manager_of("sac", tmp_path, 10, config=config, **study).read_hyperparameters()
    assert found["policy_kwargs"]["share_features_extractor"] is False and "net_arch" in found["policy_kwargs"]
    assert found["replay_buffer_kwargs"] == {"filter_kwargs": {"novelty_tolerance": 3.0}, "challenge_ratio": 0.4, "mix": "row"}
    assert found["callback"] == [{"sb3_cpm.ChallengerCallback": {"preset": "report", "decay": "linear"}}]
    assert search.OURS not in found


def test_the_command_line_wins_over_a_trial(study: dict[str, Any], tmp_path: Path) -> None:
    path = tmp_path / "my_sac.yml"
    path.write_text(yaml.safe_dump({TOY: CONFIGURED}))
    given = {"replay_buffer_kwargs": {"challenge_ratio": 0.1}, "policy_kwargs": {"net_arch": [3]}, "gamma": 0.5}
    found, saved = manager_of("sac", tmp_path, 10, config=str(path), hyperparams=given, **study).read_hyperparameters()
    assert {name: found[name] for name in given} == {name: saved[name] for name in given} == given
    assert found["callback"] == [{"sb3_cpm.ChallengerCallback": {"preset": "report", "decay": "linear"}}]


# ---------------------------------------------------------------------- continued runs
class AtStart(BaseCallback):
    """What a run begins with."""

    def _on_training_start(self) -> None:
        callback = next(one for one in self.locals["callback"].callbacks if isinstance(one, ChallengerCallback))
        assert callback.challenger is not None
        buffer = callback.buffer
        self.found = {
            "step": self.model.num_timesteps,
            "updates": callback.challenger.trained_updates,
            "weights": [p.detach().clone() for p in callback.challenger.networks["world_model"].parameters()],
            "coefficients": state_of(buffer),
            "proposed": buffer.counters.proposed,
            "transitions": buffer.n_added,
            "start": self.model._last_obs["state"].copy(),  # type: ignore[index,union-attr]
        }

    def _on_step(self) -> bool:
        return True


def state_of(buffer: CPMBuffer) -> bytes:
    return pickle.dumps(buffer.curator)


def train(folder: Path, n_timesteps: int, **kwargs: Any) -> tuple[Any, Any]:
    changes = {"learning_starts": 100, "batch_size": 8, "gradient_steps": 1, "train_freq": 5}
    config = str(config_folder() / "cpm_sac.yml")
    manager = manager_of("sac", folder, n_timesteps, config=config, hyperparams=changes, save_replay_buffer=True, **kwargs)
    made = manager.setup_experiment()
    assert made is not None
    start = AtStart()
    manager.callbacks.append(start)
    manager.learn(made[0])
    manager.save_trained_model(made[0])
    return made[0], (manager, start)


@pytest.mark.filterwarnings("ignore:The exploration probability had fallen:UserWarning")  # told of in a test of its own
@pytest.mark.slow
def test_a_continued_run_goes_on_with_everything(tmp_path: Path) -> None:
    model, (manager, start) = train(tmp_path, 300, save_freq=100, eval_freq=100, n_eval_episodes=1)
    assert start.found["step"] == start.found["updates"] == 0
    at_first = start.found["start"]
    challenger = manager.callbacks[0].challenger
    first = Path(manager.save_path)
    assert challenger.trained_updates > 0 and model.replay_buffer.counters.proposed > 0
    for name in ("challenger.pt", "replay_buffer.pkl", "rl_model_challenger_100_steps.pt", "rl_model_challenger_300_steps.pt"):
        assert (first / name).is_file(), name
    assert challenger_file(first / "rl_model_100_steps.zip") == first / "rl_model_challenger_100_steps.pt"
    assert challenger_file(first / "best_model.zip") == first / "challenger.pt"
    at_100 = Challenger.load(first / "rl_model_challenger_100_steps.pt", "cpu").trained_updates
    assert at_100 < challenger.trained_updates

    agent = str(first / f"{TOY}.zip")
    more, (again, start) = train(tmp_path, 40, trained_agent=agent, eval_freq=20, n_eval_episodes=1)
    assert start.found["step"] == 300 and more.num_timesteps == 340
    assert start.found["transitions"] == 300 and start.found["proposed"] == model.replay_buffer.counters.proposed
    assert start.found["coefficients"] == state_of(model.replay_buffer)
    assert start.found["updates"] == challenger.trained_updates
    for was, now in zip(challenger.networks["world_model"].parameters(), start.found["weights"], strict=True):
        assert th.equal(was, now)
    # no random warm-up: P was updated in every round
    assert more.learning_starts == 100 and more._n_updates == model._n_updates + 40 // 5
    with np.load(Path(again.save_path) / "evaluations.npz") as log:
        assert log["timesteps"].tolist() == [100, 200, 300, 320, 340] and len(log["results"]) == len(log["successes"]) == 5
    assert (start.found["start"] != at_first).any(), "the continued run began with the same start state"


def test_a_continued_run_without_buffer_and_challenger_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    _, (manager, _) = train(tmp_path, 120)
    first = Path(manager.save_path)
    for name in ("replay_buffer.pkl", "challenger.pt"):
        (first / name).unlink()
    with pytest.warns(UserWarning, match="begins again at .*decay_steps="):
        model, (_, start) = train(tmp_path, 130, trained_agent=str(first / f"{TOY}.zip"))
    printed = capsys.readouterr().out
    assert "there is no challenger.pt" in printed and "there is no replay_buffer.pkl" in printed
    assert "train with --save-replay-buffer" in printed and "the 100 random steps of learning_starts" in printed
    assert start.found["step"] == 120 and start.found["transitions"] == 0 and model.num_timesteps == 250


def test_what_stops_a_run_does_not_keep_the_challenger_from_being_saved(tmp_path: Path) -> None:
    class Stop(BaseCallback):
        def _on_step(self) -> bool:
            if self.num_timesteps == 110:
                raise KeyboardInterrupt
            return True

    manager = manager_of("sac", tmp_path, 200, config=str(config_folder() / "cpm_sac.yml"))
    made = manager.setup_experiment()
    assert made is not None
    manager.callbacks.append(Stop())
    manager.learn(made[0])
    assert made[0].num_timesteps == 110 and (Path(manager.save_path) / "challenger.pt").is_file()


TINY = {
    "n_timesteps": 60,
    "policy": "MultiInputPolicy",
    "policy_kwargs": {"net_arch": [8]},
    "env_kwargs": {"keys": ["state"]},
    "replay_buffer_class": "CPMHerReplayBuffer",
    "replay_buffer_kwargs": {"challenge_ratio": 0.25},
    "callback": {"sb3_cpm.ChallengerCallback": {"train_freq": 50}},
    "buffer_size": 500,
    "learning_starts": 50,
    "batch_size": 8,
    "train_freq": 10,
}


def tiny(folder: Path, **changes: Any) -> str:
    """:return: a configuration for short runs; None removes an entry"""
    path = folder / "tiny_sac.yml"
    entry = {key: value for key, value in {**TINY, **changes}.items() if value is not None}
    path.write_text(yaml.safe_dump({TOY: entry}))
    return str(path)


def run_tiny(folder: Path, n_timesteps: int, algo: str = "sac", **kwargs: Any) -> tuple[Any, Path]:
    """:return: the model, and the run's folder"""
    config = kwargs.pop("config", None) or tiny(folder)
    arguments = {"config": config, "n_eval_episodes": 1, "save_replay_buffer": True, **kwargs}
    manager = manager_of(algo, folder, n_timesteps, **arguments)
    made = manager.setup_experiment()
    assert made is not None
    manager.learn(made[0])
    manager.save_trained_model(made[0])
    return made[0], Path(manager.save_path)


@pytest.fixture(scope="module")
def _stopped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_tiny(tmp_path_factory.mktemp("stopped"), 60, eval_freq=55)[1]


@pytest.fixture
def stopped(_stopped: Path, tmp_path: Path) -> Path:
    """The folder of a run of 60 steps, as rl_zoo3 has left it, for a test of its own."""
    return Path(shutil.copytree(_stopped, tmp_path / "stopped"))


@pytest.mark.filterwarnings("ignore:The last trajectory")
@pytest.mark.filterwarnings("ignore:The exploration probability had fallen:UserWarning")  # told of in a test of its own
class TestGoingOn:
    def test_the_buffer_takes_what_can_change_and_the_rest_is_told(
        self, stopped: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        agent = stopped / f"{TOY}.zip"
        other = {"replay_buffer_kwargs": {"challenge_ratio": 0.0, "mix": "row", "max_challenges": 3}, "buffer_size": 900}
        model, second = run_tiny(tmp_path, 10, trained_agent=str(agent), hyperparams=other)
        printed = capsys.readouterr().out
        buffer = model.replay_buffer
        assert (buffer.challenge_ratio, buffer.mix, buffer.max_challenges, buffer.buffer_size) == (0.0, "row", 10, 500)
        assert "challenge_ratio of the replay buffer is 0.0 from here on, it was 0.25" in printed
        assert "WARNING: replay_buffer_kwargs max_challenges stays 10, not 3" in printed
        assert "WARNING: buffer_size stays 500, not 900" in printed
        # the next run is told what holds, not what was asked for
        model, _ = run_tiny(tmp_path, 10, trained_agent=str(second / f"{TOY}.zip"), hyperparams=other)
        printed = capsys.readouterr().out
        assert "max_challenges stays 10, not 3" in printed and "buffer_size stays 500" in printed
        assert "challenge_ratio of" not in printed

    def test_an_unchanged_configuration_warns_of_nothing(
        self, stopped: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        run_tiny(tmp_path, 10, trained_agent=str(stopped / f"{TOY}.zip"), eval_freq=5)
        printed = capsys.readouterr().out
        assert "WARNING" not in printed and "newest" not in printed and "from here on" not in printed

    def test_tensorboard_has_a_folder_for_every_run(self, stopped: Path, tmp_path: Path) -> None:
        for run_id in (1, 2):
            (tmp_path / "tb" / TOY / f"SAC_{run_id}").mkdir(parents=True)
        run_tiny(tmp_path, 10, trained_agent=str(stopped / f"{TOY}.zip"), tensorboard_log=str(tmp_path / "tb"))
        assert [path.parent.name for path in tmp_path.glob("tb/*/*/events*")] == ["SAC_3"]

    def test_learning_starts_does_not_pile_up(self, stopped: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        agent, config = stopped / f"{TOY}.zip", tiny(tmp_path, learning_starts=None)
        for n_steps in (60, 120):
            (agent.parent / "replay_buffer.pkl").unlink()
            model, folder = run_tiny(tmp_path, 60, trained_agent=str(agent), config=config)
            printed = capsys.readouterr().out
            assert f"Going on at step {n_steps}" in printed and "the 50 random steps of learning_starts" in printed
            assert model.learning_starts == 50 and model._n_updates > 0
            agent = folder / f"{TOY}.zip"

    @pytest.mark.filterwarnings("ignore:unclosed file.*replay_buffer:ResourceWarning")  # by SB3, if it cannot be read
    def test_damaged_files_are_named(self, stopped: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        agent = str(stopped / f"{TOY}.zip")
        evaluations, buffer = stopped / "evaluations.npz", stopped / "replay_buffer.pkl"
        evaluations.write_bytes(evaluations.read_bytes()[:300])
        _, folder = run_tiny(tmp_path, 10, trained_agent=agent, eval_freq=5)
        assert f"WARNING: {evaluations} cannot be read (BadZipFile" in capsys.readouterr().out
        with np.load(folder / "evaluations.npz") as log:
            assert log["timesteps"].tolist() == [65, 70]
        for size in (3000, 0):
            buffer.write_bytes(buffer.read_bytes()[:size])
            with pytest.raises(ValueError, match=r"replay_buffer\.pkl is no complete replay buffer .* move it away"):
                run_tiny(tmp_path, 10, trained_agent=agent)

    def test_evaluations_of_other_lengths_are_told(
        self, stopped: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        agent = str(stopped / f"{TOY}.zip")
        run_tiny(tmp_path, 5, trained_agent=agent, eval_freq=5, n_eval_episodes=2)
        assert "evaluations.npz has evaluations of 1 episodes, now it is 2 (--eval-episodes)" in capsys.readouterr().out

    def test_what_another_model_of_the_run_goes_on_with_is_told(
        self, stopped: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        run_tiny(tmp_path, 5, trained_agent=str(stopped / "best_model.zip"))
        assert "best_model.zip is of step 55, and goes on with the run's newest challenger.pt and replay_buffer.pkl" in (
            capsys.readouterr().out
        )
        saved = (stopped / "challenger.pt").rename(tmp_path / "other.pt")
        config = tiny(tmp_path, callback={"sb3_cpm.ChallengerCallback": {"load_path": str(saved)}})
        run_tiny(tmp_path, 5, trained_agent=str(stopped / f"{TOY}.zip"), config=config)
        assert f"there is no challenger.pt in {stopped}: the challenger starts from {saved}" in capsys.readouterr().out

    def test_dreamer_takes_other_rates(self, tmp_path: Path) -> None:
        keys = ("n_timesteps", "policy", "env_kwargs", "buffer_size", "learning_starts", "train_freq")
        entry = {key: TINY[key] for key in keys}
        small = {"deter_size": 8, "hidden_size": 8, "vector_units": 8, "head_units": 8, "actor_units": 8, "critic_units": 8}
        path = tmp_path / "dreamer.yml"

        def run_dreamer(preset: dict[str, Any], **kwargs: Any) -> tuple[Any, Path]:
            path.write_text(yaml.safe_dump({TOY: {**entry, "preset": {**small, **preset}}}))
            return run_tiny(tmp_path, 60, algo="dreamer", config=str(path), **kwargs)

        _, folder = run_dreamer({})
        agent = str(folder / f"{TOY}.zip")
        model, _ = run_dreamer({"model_lr": 5e-4, "horizon": 4}, trained_agent=agent)
        assert model.challenger.preset.model_lr == model.lr_schedule(1.0) == 5e-4
        assert model.challenger.preset.horizon == 4 and model.num_timesteps == 120
        with pytest.raises(ValueError, match=r"cannot be loaded with \{'deter_size': 9\}"):
            run_dreamer({"deter_size": 9}, trained_agent=agent)


def test_the_missing_callback_is_told_in_the_words_of_a_configuration(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"a configuration of rl_zoo3 has the line `callback: sb3_cpm\.ChallengerCallback`"):
        run_tiny(tmp_path, 10, config=tiny(tmp_path, callback=None))


# ---------------------------------------------------------------------- our command
def test_agents_stand_for_algorithm_and_file() -> None:
    path = str(config_folder() / "cpm_sac.yml")
    assert complete("train", ["--agent", "cpm_sac", "-n", "5"]) == ["--algo", "sac", "--conf-file", path, "-n", "5"]
    assert complete("enjoy", ["--agent", "cpm_sac"]) == ["--algo", "sac"]
    assert complete("enjoy", ["--agent=cpm_sac", "--env=A"]) == ["--algo", "sac", "--env", "A"]
    dreamer = str(config_folder() / "dreamer.yml")
    assert complete("train", ["--algo", "dreamer"]) == ["--algo", "dreamer", "--conf-file", dreamer]
    assert complete("train", ["--algo=dreamer"]) == ["--algo", "dreamer", "--conf-file", dreamer]
    assert complete("train", ["--env-kwargs", "a:'b=c'"]) == ["--env-kwargs", "a:'b=c'"]
    assert complete("train", ["--algo", "dreamer", "-conf", "my.yml"]) == ["--algo", "dreamer", "-conf", "my.yml"]
    assert complete("train", ["--algo", "sac"]) == ["--algo", "sac"]
    rlpd = str(config_folder() / "rlpd.yml")
    assert complete("train", ["--algo", "rlpd"]) == ["--algo", "rlpd", "--conf-file", rlpd]
    assert complete("train", ["--agent", "cpm_rlpd"])[:2] == complete("enjoy", ["--agent", "cpm_rlpd"]) == ["--algo", "rlpd"]
    for option in ("--conf", "--c", "-c", "-conf=my.yml", "--conf-file=my.yml"):  # argparse takes them all
        assert str(config_folder() / "dreamer.yml") not in complete("train", ["--algo", "dreamer", option, "my.yml"]), option


@pytest.fixture
def _same_arguments(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", ["python -m sb3_cpm.zoo"])


@pytest.mark.usefixtures("_same_arguments")
def test_errors_of_our_command_are_sentences(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0 and "train, enjoy" in capsys.readouterr().out
    assert main(["trian"]) == 2 and "one of: train" in capsys.readouterr().err
    assert main(["train", "--agent", "cpm_sak"]) == 1 and "Did you mean 'cpm_sac'" in capsys.readouterr().err
    assert main(["train", "--agent"]) == 1 and "--agent needs the name" in capsys.readouterr().err
    assert main(["train", "--agent", "sac", "--env", "CPM/PickCub-v1"]) == 1
    assert "CPM/PickCube-v1" in capsys.readouterr().err


class Broken(gym.Env):
    """Fails in the middle of a run, in code that is not ours."""

    observation_space = spaces.Dict({"state": spaces.Box(-1, 1, (2,), np.float32)})
    action_space = spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        return self.observation_space.sample(), {}

    def step(self, action: np.ndarray) -> Any:
        raise ValueError("cannot open gripper")


@pytest.mark.usefixtures("_same_arguments")
def test_errors_of_a_run_keep_their_traceback(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    if "Broken-v0" not in gym.registry:
        gym.register("Broken-v0", entry_point=Broken)
    path = tmp_path / "my_sac.yml"
    entry = {"n_timesteps": 5, "policy": "MultiInputPolicy"}
    arguments = ["train", "--algo", "sac", "--env", "Broken-v0", "-f", str(tmp_path), "--device", "cpu", "--conf", str(path)]
    path.write_text(yaml.safe_dump({"Broken-v0": entry}))
    with pytest.raises(ValueError, match="cannot open gripper"):
        main(arguments)
    path.write_text(yaml.safe_dump({"Broken-v0": {**entry, "gama": 1}}))
    assert main(arguments) == 1 and "unknown key 'gama'. Did you mean 'gamma'" in capsys.readouterr().err


# ---------------------------------------------------------------------- rl_zoo3's commands, from end to end
COMMON = ["--device", "cpu", "--eval-episodes", "2", "--save-replay-buffer", "-tb", "tb"]


@pytest.mark.slow
@pytest.mark.parametrize("program", ["ours", "theirs"])
def test_gymnasium_robotics_is_imported_where_it_is_needed(program: str, imported: set[str], tmp_path: Path) -> None:
    pytest.importorskip("gymnasium_robotics")
    pytest.importorskip("mujoco")
    assert "sb3_cpm.zoo" in imported and not imported & {"gymnasium_robotics", "mujoco"}
    end = ["--env", "PointMaze_UMaze-v3", "-n", "60", "-f", "logs", "--device", "cpu", "--eval-freq", "-1"]
    if program == "ours":
        run(["-m", "sb3_cpm.zoo", "train", "--agent", "sac_her", *end], tmp_path)
    else:
        packages = ["--gym-packages", "sb3_cpm.zoo", "gymnasium_robotics"]
        config = str(config_folder() / "sac_her.yml")
        run(["-m", "rl_zoo3.train", *packages, "--algo", "sac", "--conf-file", config, *end], tmp_path)
    assert (tmp_path / "logs" / "sac" / "PointMaze_UMaze-v3_1" / "PointMaze_UMaze-v3.zip").exists()


@pytest.fixture(scope="module")
def warm() -> Iterator[Command]:
    """Runs a module in a folder, and gives back what it printed; it must end well."""
    python = WarmPython()

    def run_warm(module: str, arguments: list[str], folder: Path) -> str:
        return check(python.run(module, arguments, folder))

    yield run_warm
    python.close()


RL_ZOO3 = ["rl_zoo3.{command}", "--gym-packages", "sb3_cpm.zoo"]
OURS = ["sb3_cpm.zoo", "{command}"]
SMALL = "env_kwargs:dict(ignore_terminations=True, n_points=0, image_size=32, max_episode_steps=10)"
#: program, algorithm, environment, steps of the first run, of its continuation, what makes them short, length of an episode
CHAINS = {
    "cpm_sac": (RL_ZOO3, "sac", TOY, 200, 100, ["learning_starts:100", "batch_size:8"], 50),
    "ppo_rgbd": (
        RL_ZOO3,
        "ppo",
        "CPM/PickCube-v1",
        40,
        40,
        ["n_envs:1", "n_steps:20", "batch_size:20", "n_epochs:1", SMALL],
        10,
    ),
    "dreamer": (OURS, "dreamer", TOY, 200, 100, ["learning_starts:100", "train_freq:50"], 50),
    "cpm_rlpd": (OURS, "rlpd", TOY, 200, 100, ["learning_starts:100", "batch_size:8", "train_freq:4"], 50),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["cpm_sac", pytest.param("ppo_rgbd", marks=pytest.mark.maniskill), "dreamer", "cpm_rlpd"])
def test_train_enjoy_resume_plot(name: str, warm: Command, tmp_path: Path) -> None:
    program, algo, env_id, n_steps, n_more, parameters, length = CHAINS[name]

    def command(what: str, *arguments: str) -> str:
        module, *start = [word.format(command=what) for word in program]
        return warm(module, [*start, "--algo", algo, "--env", env_id, "-f", name, *arguments], tmp_path)

    config = ["--conf-file", str(config_folder() / f"{name}.yml"), "-params", *parameters, *COMMON]
    output = command("train", *config, "-n", str(n_steps), "--eval-freq", str(n_steps // 2), "--seed", "1")
    assert output.count("Eval num_timesteps") == 2
    file_name = env_id.replace("/", "-")
    first, second = (tmp_path / name / algo / f"{file_name}_{i}" for i in (1, 2))
    assert (first / f"{file_name}.zip").is_file() and list(tmp_path.glob("tb/*/*/events*"))
    assert (first / "challenger.pt").is_file() == name.startswith("cpm")

    output = command("enjoy", "-n", str(length), "--no-render")
    assert f"Episode Length {length}" in output

    agent = str(first / f"{file_name}.zip")
    output = command("train", *config, "-n", str(n_more), "--eval-freq", str(n_more // 2), "--seed", "1", "-i", agent)
    assert f"Going on at step {n_steps}" in output and "WARNING" not in output
    with np.load(second / "evaluations.npz") as log:
        assert log["timesteps"].tolist() == [n_steps // 2, n_steps, n_steps + n_more // 2, n_steps + n_more]
    plots = ["all_plots", "-a", algo, "-e", file_name, "-f", name, "-l", name, "--no-display"]
    if name == "cpm_sac":
        # rliable wants two seeds; with as many evaluations, since rl_zoo3 plots the longest runs only
        total = n_steps + n_more
        command("train", *config, "-n", str(total), "--eval-freq", str(total // 4), "--seed", "2")
        assert f"|{file_name}|" in warm("rl_zoo3.cli", [*plots, "-k", "successes"], tmp_path).replace(" ", "")
    output = warm("rl_zoo3.cli", [*plots, "--no-million", "-print", "-o", "curves"], tmp_path)
    assert f"{file_name}-{algo.upper()}-{name}: {2 if name == 'cpm_sac' else 1}" in output
    if name == "cpm_sac":
        warm("rl_zoo3.cli", ["plot_from_file", "-i", "curves.pkl", "-r", "-iqm", "-l", name], tmp_path)


@pytest.mark.slow
def test_optimize_and_train_with_a_trial(warm: Command, tmp_path: Path) -> None:
    config = str(config_folder() / "cpm_sac.yml")
    start = ["--gym-packages", "sb3_cpm.zoo", "--algo", "sac", "--env", TOY, "--conf-file", config]
    start += ["-f", "logs", "--device", "cpu", "--storage", "study.log", "--study-name", "s", "-params", "learning_starts:100"]
    searching = [
        "-n",
        "130",
        "-optimize",
        "--n-trials",
        "2",
        "--n-evaluations",
        "1",
        "--eval-episodes",
        "1",
        "--no-optim-plots",
    ]
    output = warm("rl_zoo3.train", [*start, *searching, "--sampler", "random", "--seed", "3"], tmp_path)
    assert "Number of finished trials:  2" in output
    report = next((tmp_path / "logs" / "sac").glob("report_*.csv")).read_text()
    assert report.count("COMPLETE") == 2
    assert all(f"params_{name}" in report for name in (*search.BUFFER_SPACE, *search.CALLBACK_SPACE, "net_arch"))
    warm("rl_zoo3.train", [*start, "-n", "110", "--eval-freq", "-1", "--trial-id", "1"], tmp_path)
    saved = next((tmp_path / "logs" / "sac").glob(f"{TOY}_*/{TOY}/config.yml")).read_text()
    values = dict(yaml.unsafe_load(saved))
    assert search.OURS not in values and {"challenge_ratio", "mix"} <= set(values["replay_buffer_kwargs"])
    assert "decay" in values["callback"][0]["sb3_cpm.ChallengerCallback"]


def test_pink_noise_is_what_sac_tries_and_not_what_it_learns_from(tmp_path: Path) -> None:
    policy = {"policy": "sb3_cpm.zoo.pink_noise.PinkNoisePolicy", "policy_kwargs": {"noise_length": 200}}
    built = load_agent("sac", "MountainCarContinuous-v0", {**policy, "learning_starts": 0}).build(0, device="cpu")
    model, observation = built.model, np.zeros((2, 2), dtype=np.float32)
    tried = np.array([model.predict(observation)[0] for _ in range(400)])
    assert np.corrcoef(tried[:-1, 0, 0], tried[1:, 0, 0])[0, 1] > 0.3, "steps in a row are alike"
    assert abs(np.corrcoef(tried[:, 0, 0], tried[:, 1, 0])[0, 1]) < 0.5, "environments are not"
    assert np.array_equal(model.predict(observation, deterministic=True)[0], model.predict(observation, deterministic=True)[0])
    learnt, _ = model.actor.action_log_prob(th.zeros(400, 2))  # type: ignore[attr-defined]
    series = learnt.detach().numpy().ravel()
    assert abs(np.corrcoef(series[:-1], series[1:])[0, 1]) < 0.15
    model.save(tmp_path / "model")
    assert SAC.load(tmp_path / "model", device="cpu").policy.noise_length == 200
    built.env.close()
