"""Experiments: resumable runs, their folders, the grid, and figures from CSV alone."""

import json
import shutil
import subprocess
import sys
import time
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
import yaml
from stable_baselines3.common.vec_env import unwrap_vec_normalize

pytest.importorskip("rl_zoo3")
pytest.importorskip("rliable")

from sb3_cpm import checkpoint as checkpoints
from sb3_cpm.__main__ import main
from sb3_cpm.agents import load_agent
from sb3_cpm.experiments import EXPERIMENTS, draw, ensure_data, find_data, find_experiment, run_experiment, summary_table
from sb3_cpm.experiments.catalog import challenger
from sb3_cpm.experiments.collect import Data, collect
from sb3_cpm.experiments.figures import COLOURS, DRAWINGS, SCORES, write_title
from sb3_cpm.experiments.grid import attempt, perform_all
from sb3_cpm.experiments.single_run import perform
from sb3_cpm.experiments.specification import Contender, Experiment, Plan, RunSpec, Task
from sb3_cpm.experiments.statistics import binned, estimate, per_seed
from sb3_cpm.files import LockedError, locked
from sb3_cpm.run.evaluation import evaluate
from sb3_cpm.run.folder import description
from sb3_cpm.run.player_losses import player_losses
from sb3_cpm.run.watcher import Watcher
from sb3_cpm.seeds import FIRST_SEED

TINY = {
    "policy": "MultiInputPolicy",
    "policy_kwargs": {"net_arch": [8]},
    "learning_starts": 60,
    "batch_size": 8,
    "buffer_size": 500,
    "train_freq": 10,
    "gradient_steps": 1,
    "env_kwargs": {"keys": ["state"]},
}
TINY_CPM = {
    **TINY,
    **challenger(train_freq=20, challenger_kwargs={"batch_size": 2, "sequence_length": 8, "imagination_starts": 4}),
}


def make_spec(agent="sac", seed=0, steps=200, overrides=None, **changes):
    return RunSpec(
        experiment="test",
        agent=agent,
        env="toy",
        seed=seed,
        config=agent,
        env_id="CPMToy-v0",
        overrides={**(TINY_CPM if "cpm" in agent else TINY), **(overrides or {})},
        steps=steps,
        eval_every=80,
        eval_episodes=2,
        **changes,
    )


class Killed(BaseException):
    """As abrupt as a signal: nothing of ours catches it."""


def kill_at(monkeypatch, step):
    """The next run is killed when it comes to this step."""
    unbroken = Watcher._on_step

    def on_step(self):
        if self.num_timesteps == step:
            raise Killed
        return unbroken(self)

    monkeypatch.setattr(Watcher, "_on_step", on_step)
    return lambda: monkeypatch.setattr(Watcher, "_on_step", unbroken)


def csv_files(folder):
    return {path.name: path.read_text() for path in sorted(folder.glob("*.csv"))}


# ---------------------------------------------------------------------- one run


def test_run_leaves_tidy_tables(tmp_path):
    spec = make_spec()
    lines = []
    result = perform(spec, tmp_path, lines.append)
    assert result.outcome == "finished"
    table = pd.read_csv(result.folder / "evaluations.csv")
    assert list(table.columns) == [
        "experiment", "agent", "env", "seed", "step", "episode", "return", "length", "success_once", "success_at_end",
    ]  # fmt: skip
    assert table["step"].unique().tolist() == [0, 80, 160, 200]
    assert table.groupby("step").size().tolist() == [2] * 4
    assert (table["success_once"] >= table["success_at_end"]).all()
    training = pd.read_csv(result.folder / "training.csv")
    assert (training["length"] == 50).all()
    diagnostics = pd.read_csv(result.folder / "diagnostics.csv")
    assert {"train/critic_loss", "rollout/ep_rew_mean"} <= set(diagnostics["name"])
    config = yaml.safe_load((result.folder / "config.yml").read_text())
    assert config["protocol"]["hyperparameters"]["batch_size"] == 8
    assert config["sb3_cpm"] and config["versions"]["torch"]
    assert not (result.folder / "checkpoint").exists()
    assert len(lines) == 4 and "step 200/200" in lines[-1]


@pytest.mark.parametrize("agent, killed_at", [("sac", 130), ("cpm_sac", 190), ("sac", 30)])
def test_a_killed_run_goes_on_as_if_unbroken(tmp_path, monkeypatch, agent, killed_at):
    spec = make_spec(agent)
    unbroken = perform(spec, tmp_path / "unbroken")
    revive = kill_at(monkeypatch, killed_at)
    with pytest.raises(Killed):
        perform(spec, tmp_path / "broken")
    revive()
    loads = []
    original = checkpoints.load_extra
    monkeypatch.setattr(checkpoints, "load_extra", lambda path: loads.append(path) or original(path))
    resumed = perform(spec, tmp_path / "broken")
    assert loads, "started from the beginning instead of the checkpoint"
    assert csv_files(resumed.folder) == csv_files(unbroken.folder)


def check_resumed_equals_unbroken(spec, tmp_path, monkeypatch, killed_at):
    unbroken = perform(spec, tmp_path / "unbroken")
    revive = kill_at(monkeypatch, killed_at)
    with pytest.raises(Killed):
        perform(spec, tmp_path / "broken")
    revive()
    assert csv_files(perform(spec, tmp_path / "broken").folder) == csv_files(unbroken.folder)


def test_hindsight_agent_resumes_too(tmp_path, monkeypatch):
    """SB3's HerReplayBuffer must have its running episode cut at a checkpoint, which is a fresh start."""
    pytest.importorskip("gymnasium_robotics")
    pytest.importorskip("mujoco")
    overrides = {**TINY, "env_kwargs": {"max_episode_steps": 40}}
    spec = replace(make_spec("sac_her", overrides=overrides), env_id="PointMaze_UMaze-v3", env="maze")
    check_resumed_equals_unbroken(spec, tmp_path, monkeypatch, killed_at=185)


def test_dreamer_resumes_too(tmp_path, monkeypatch):
    small = {"batch_size": 2, "sequence_length": 8, "imagination_starts": 4}
    wanted = ("policy", "learning_starts", "buffer_size", "env_kwargs")
    dreamer = {**{key: TINY[key] for key in wanted}, "train_freq": 20, "preset": small}
    spec = replace(make_spec("dreamer"), overrides=dreamer)
    check_resumed_equals_unbroken(spec, tmp_path, monkeypatch, killed_at=190)


def test_on_policy_agent_resumes_too(tmp_path, monkeypatch):
    ppo = {
        "policy": "MultiInputPolicy",
        "policy_kwargs": {"net_arch": [8]},
        "n_envs": 2,
        "n_steps": 20,
        "batch_size": 20,
        "n_epochs": 1,
        "target_kl": None,
        "env_kwargs": {"keys": ["state"]},
    }
    spec = replace(make_spec("ppo_rgbd"), overrides=ppo)
    check_resumed_equals_unbroken(spec, tmp_path, monkeypatch, killed_at=130)


def test_state_dependent_noise_is_resumed_too(tmp_path, monkeypatch):
    """SB3 draws it before it tells anybody that a rollout begins, so that a fresh start has to draw it again."""
    agent = next(one for one in EXPERIMENTS["mountaincar"].contenders if one.overrides.get("use_sde"))
    short = {"env_kwargs": {"max_episode_steps": 50}}
    overrides = {**agent.overrides, **short, "buffer_size": 500, "batch_size": 8, "gradient_steps": 1}
    spec = replace(make_spec(), overrides=overrides, env_id="MountainCarContinuous-v0", env="car", eval_episodes=1)
    check_resumed_equals_unbroken(spec, tmp_path / "sac", monkeypatch, killed_at=110)
    ppo = {"policy": "MultiInputPolicy", "policy_kwargs": None, "n_envs": 2, "n_steps": 20, "batch_size": 20, "use_sde": True}
    spec = replace(
        make_spec("ppo_rgbd"), overrides={**ppo, **short}, env_id="MountainCarContinuous-v0", env="car", eval_episodes=1
    )
    check_resumed_equals_unbroken(spec, tmp_path / "ppo", monkeypatch, killed_at=150)


def test_the_seed_decides(tmp_path):
    one, other = (perform(make_spec(seed=seed), tmp_path) for seed in (0, 1))
    assert csv_files(one.folder)["training.csv"] != csv_files(other.folder)["training.csv"]


def test_a_finished_run_is_skipped(tmp_path):
    spec = make_spec(steps=80)
    first = perform(spec, tmp_path)
    before = csv_files(first.folder)
    started = time.process_time()
    assert perform(spec, tmp_path).outcome == "skipped"
    assert time.process_time() - started < 2
    assert csv_files(first.folder) == before


def test_a_run_of_two_experiments_is_made_once(tmp_path):
    spec = make_spec(steps=80)
    other = replace(spec, experiment="other", agent="Player", env="task")
    first = perform(spec, tmp_path)
    expected = perform(other, tmp_path / "made")
    taken = perform(other, tmp_path)
    assert taken.outcome == "skipped" and "taken from test/sac/toy/seed0" in taken.message
    assert csv_files(taken.folder) == csv_files(expected.folder) != csv_files(first.folder)
    config = yaml.safe_load((taken.folder / "config.yml").read_text())
    assert config.pop("taken_from") == "test/sac/toy/seed0"
    assert config == yaml.safe_load((expected.folder / "config.yml").read_text())
    assert perform(other, tmp_path).message == "its result is there"


def test_a_run_with_other_settings_is_not_taken(tmp_path):
    spec = make_spec(steps=80)
    perform(replace(spec, experiment="seed", seed=1), tmp_path)
    perform(replace(spec, experiment="settings", overrides={**TINY, "batch_size": 16}), tmp_path)
    unfinished = perform(replace(spec, experiment="unfinished"), tmp_path).folder
    (unfinished / "finished.yml").unlink()
    assert perform(replace(spec, experiment="version"), tmp_path).outcome == "finished"
    config = tmp_path / "version/sac/toy/seed0/config.yml"
    config.write_text(yaml.safe_dump({**yaml.safe_load(config.read_text()), "sb3_cpm": "0.0.1"}))
    assert perform(spec, tmp_path).outcome == "finished"


def test_runs_that_experiments_of_the_report_share():
    def fingerprints(name):
        runs = EXPERIMENTS[name].runs()
        loaded = {spec.name: description(spec, load_agent(spec.config, spec.env_id, spec.overrides)) for spec in runs}
        return {(one["run"]["agent"], one["run"]["env"], one["run"]["seed"]): one["fingerprint"] for one in loaded.values()}

    state, controllers = fingerprints("pickcube-state"), fingerprints("controllers")
    shared = set(state) & set(controllers)
    assert len(shared) == 6 and all(state[key] == controllers[key] for key in shared)
    linear = fingerprints("decays")["CPM linear", "MountainCarContinuous-v0", 0]
    assert linear == fingerprints("mountaincar")["CPM-SAC", "MountainCarContinuous-v0", 0]


def test_other_hyperparameters_are_refused_by_name(tmp_path):
    perform(make_spec(steps=80), tmp_path)
    result = attempt(make_spec(steps=80, overrides={"batch_size": 16}), tmp_path)
    assert result.outcome == "refused"
    assert "batch_size: there 8, here 16" in result.message and "--results" in result.message
    assert not (result.folder / "crashed.txt").exists()


def test_a_finished_run_that_cannot_be_checked_is_left_alone(tmp_path):
    spec = make_spec(steps=80)
    folder = perform(spec, tmp_path).folder
    before = csv_files(folder)
    result = attempt(make_spec(steps=80, overrides={"bach_size": 8}), tmp_path)  # a slip in a file looks like that
    assert result.outcome == "unchecked" and "Did you mean 'batch_size'" in result.message
    assert csv_files(folder) == before and not (folder / "crashed.txt").exists()
    (folder / "crashed.txt").write_text("of an earlier version, which wrote one then")
    assert attempt(spec, tmp_path).outcome == "skipped"
    assert not (folder / "crashed.txt").exists()


def test_no_crash_is_told_in_a_folder_that_another_process_writes(tmp_path):
    spec = make_spec(steps=80, overrides={"bach_size": 8})
    with locked(spec.folder(tmp_path)):
        result = attempt(spec, tmp_path)
        assert result.outcome == "crashed" and "Did you mean 'batch_size'" in result.message
        assert not list(result.folder.iterdir()) and "crashed.txt" not in result.message
    assert "Traceback" in (attempt(spec, tmp_path).folder / "crashed.txt").read_text()


def test_seeds_of_the_evaluation_are_refused(tmp_path):
    for seed in (-1, FIRST_SEED - 1, FIRST_SEED):
        with pytest.raises(ValueError, match=f"seed={seed}: expected 0 or more, and less than 999999"):
            perform(make_spec(seed=seed), tmp_path)
    assert not list(tmp_path.iterdir())


def test_another_version_is_mentioned(tmp_path):
    spec = make_spec(steps=80)
    folder = perform(spec, tmp_path).folder
    config = yaml.safe_load((folder / "config.yml").read_text())
    (folder / "config.yml").write_text(yaml.safe_dump({**config, "sb3_cpm": "0.0.1"}))
    result = perform(spec, tmp_path)
    assert result.outcome == "skipped" and "0.0.1" in result.message


def test_two_runs_never_write_one_folder(tmp_path):
    spec = make_spec(steps=80)
    code = (
        "import sys, time, pathlib\nfrom sb3_cpm.files import locked\n"
        "with locked(pathlib.Path(sys.argv[1])):\n    print('held', flush=True)\n    time.sleep(60)"
    )
    folder = spec.folder(tmp_path)
    with subprocess.Popen([sys.executable, "-c", code, str(folder)], stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None and holder.stdout.readline() == b"held\n"
        with pytest.raises(RuntimeError, match="is being written by another process"):
            perform(spec, tmp_path)
        assert attempt(spec, tmp_path).outcome == "refused"
        holder.kill()
    with locked(folder):  # the lock went with its process
        pass


def test_diagnosis_changes_nothing(tmp_path, monkeypatch):
    spec = make_spec("cpm_sac", overrides={"replay_buffer_kwargs": {"challenge_ratio": 0.9}})
    diagnosed = perform(spec, tmp_path / "a")
    names = set(pd.read_csv(diagnosed.folder / "diagnostics.csv")["name"])
    assert {"player/q_D", "player/q_I", "player/critic_loss_I", "player/actor_loss_D"} <= names
    monkeypatch.setattr("sb3_cpm.run.watcher.log_player_losses", lambda model: None)
    plain = perform(spec, tmp_path / "b")
    assert csv_files(diagnosed.folder)["training.csv"] == csv_files(plain.folder)["training.csv"]
    assert csv_files(diagnosed.folder)["evaluations.csv"] == csv_files(plain.folder)["evaluations.csv"]
    logged, expected = (pd.read_csv(run.folder / "diagnostics.csv") for run in (diagnosed, plain))
    logged = logged[~logged["name"].str.startswith("player/")].reset_index(drop=True)
    assert (logged["name"] == "challenge/sampled_age").any()
    pd.testing.assert_frame_equal(logged, expected)


def test_player_losses_are_those_of_sac():
    """With a learning rate of zero SAC.train changes nothing, and logs the losses of the batch that it drew."""
    overrides = {**TINY, "learning_rate": 0.0, "batch_size": 4096, "ent_coef": 0.2}
    built = load_agent("sac", "CPMToy-v0", overrides).build(seed=0)
    built.model.learn(100)
    model = built.model
    model.train(gradient_steps=5, batch_size=4096)
    ours = player_losses(model, model.replay_buffer.sample(4096))
    assert ours["critic_loss"] == pytest.approx(model.logger.name_to_value["train/critic_loss"], rel=0.1)
    assert ours["actor_loss"] == pytest.approx(model.logger.name_to_value["train/actor_loss"], rel=0.1)
    built.env.close()


def test_evaluation_seeds_every_episode():
    built = load_agent("sac", "CPMToy-v0", TINY).build(seed=0)
    env = built.make_eval_env()
    first = evaluate(built.model, env, 3)
    assert evaluate(built.model, env, 3) == first
    assert len({outcome.episode_return for outcome in first}) == 3
    env.seed(FIRST_SEED)
    start = env.reset()["state"]
    evaluate(built.model, env, 1)
    env.seed(FIRST_SEED)
    assert np.array_equal(env.reset()["state"], start)
    env.close()
    built.env.close()


@pytest.mark.parametrize("keys", [["state"], ["camera", "state"]])
def test_evaluation_is_normalized_as_training_is(keys):
    """With images, too, where the normalization is not the outermost of the environments."""
    ppo = {
        "policy": "sb3_cpm.zoo.policies.CameraActorCriticPolicy",
        "policy_kwargs": None,
        "n_envs": 1,
        "n_steps": 60,
        "batch_size": 60,
        "n_epochs": 1,
        "normalize": "{'norm_obs': True, 'norm_reward': True, 'norm_obs_keys': ['state']}",
        "env_kwargs": {"keys": keys},
    }
    built = load_agent("ppo_rgbd", "CPMToy-v0", ppo).build(seed=0, device="cpu")
    env = built.make_eval_env()
    built.model.learn(60)
    evaluate(built.model, env, 1)
    ours, theirs = unwrap_vec_normalize(env), unwrap_vec_normalize(built.env)
    assert theirs.obs_rms["state"].count > 60
    assert np.array_equal(ours.obs_rms["state"].mean, theirs.obs_rms["state"].mean)
    assert not ours.training and not ours.norm_reward and theirs.training and theirs.norm_reward
    env.close()
    built.env.close()


# ---------------------------------------------------------------------- many runs


@pytest.fixture
def tiny_experiment(monkeypatch):
    """A catalog entry that takes seconds."""
    plan = Plan((Task("toy", "CPMToy-v0"),), 120, 60, 2, 2, {"sac": TINY_CPM})
    player = {key: None for key in ("callback",)}
    experiment = Experiment(
        "tiny", "99", "A test", "nothing", (Contender("SAC", "sac", player), Contender("CPM", "cpm_sac")), "curves", plan, plan
    )
    broken = replace(
        experiment, name="broken", contenders=(Contender("bad", "sac", {"batch_size": "eight"}), experiment.contenders[0])
    )
    for one in (experiment, broken):
        monkeypatch.setitem(EXPERIMENTS, one.name, one)
    return experiment


@pytest.mark.slow
def test_from_nothing_to_figure_and_table(tmp_path, tiny_experiment):
    results = run_experiment("tiny", "full", results=tmp_path, jobs=0, tell=lambda line: None)
    assert [result.outcome for result in results] == ["finished"] * 4
    figure = draw("99", tmp_path)
    labels = {text.get_text() for text in figure.legends[0].get_texts()}
    assert labels == {"SAC (2 seeds)", "CPM (2 seeds)"}
    of_return = next(axes for axes in figure.axes if axes.get_title(loc="left") == "return")
    table = pd.read_csv(tmp_path / "tiny" / "SAC" / "toy" / "seed0" / "evaluations.csv")
    other = pd.read_csv(tmp_path / "tiny" / "SAC" / "toy" / "seed1" / "evaluations.csv")
    means = pd.concat([table, other]).groupby("step")["return"].mean()
    assert np.allclose(of_return.lines[0].get_ydata(), means)
    summary = summary_table("tiny", tmp_path)
    assert summary["agent"].tolist() == ["SAC", "CPM"] and (summary["step"] == 120).all()
    assert f"{means.iloc[-1]:.2f} [" in summary["return"][0]
    shutil.rmtree(tmp_path / "figures", ignore_errors=True)
    assert main(["reproduce", "--figure", "tiny", "--draw-only", "--results", str(tmp_path)]) == 0
    assert (tmp_path / "figures" / "figure_99_tiny.png").stat().st_size > 5000


def test_other_settings_than_most_are_left_out(tmp_path, tiny_experiment):
    specs = list(tiny_experiment.runs(seeds=3, agents=["SAC"]))
    for spec in specs[:2]:
        perform(spec, tmp_path)
    perform(replace(specs[2], overrides={**specs[2].overrides, "gamma": 0.5}), tmp_path)
    data = collect(tiny_experiment, tmp_path)
    assert data.notes == ["left out, made with other settings than the rest: SAC/toy/seed2"]
    assert set(data.tables["evaluations"]["seed"]) == {0, 1}


@pytest.fixture
def two_runs(tmp_path, tiny_experiment):
    specs = list(tiny_experiment.runs(seeds=2, agents=["SAC"]))
    for spec in specs:
        perform(spec, tmp_path)
    return specs


def cut(name, start, end):
    def damage(folder):
        lines = (folder / name).read_text().splitlines(keepends=True)
        (folder / name).write_text("".join(lines[start:end]))

    return damage


def overwrite(name, change):
    return lambda folder: (folder / name).write_bytes(change((folder / name).read_bytes()))


DAMAGES = {
    "an episode is gone": cut("evaluations.csv", 0, -1),
    "the last evaluation is gone": cut("evaluations.csv", 0, -2),
    "the header is gone": cut("evaluations.csv", 1, None),
    "cut in its last row": overwrite("evaluations.csv", lambda text: text[:-4]),
    "empty": overwrite("evaluations.csv", lambda text: b""),
    "not text": overwrite("evaluations.csv", lambda text: b"\xff\xfe\n" + text),
    "no evaluations": lambda folder: (folder / "evaluations.csv").unlink(),
    "no diagnostics": lambda folder: (folder / "diagnostics.csv").unlink(),
    "no settings": lambda folder: (folder / "config.yml").unlink(),
    "empty settings": overwrite("config.yml", lambda text: b""),
    "cut settings": overwrite("config.yml", lambda text: text[:200]),
    "edited settings": overwrite("config.yml", lambda text: text.replace(b"batch_size: 8", b"batch_size: 9")),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_results_are_neither_drawn_nor_kept_silently_nor_taken(tmp_path, tiny_experiment, two_runs, damage):
    whole = summary_table("tiny", tmp_path)["seeds"].tolist()
    folder = two_runs[0].folder(tmp_path)
    DAMAGES[damage](folder)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    data = collect(tiny_experiment, tmp_path)
    assert set(data.tables["evaluations"]["seed"]) == set(data.tables["diagnostics"]["seed"]) == {1}
    assert len(data.notes) == 1 and data.notes[0].startswith("left out, damaged: SAC/toy/seed0 (")
    assert (whole, summary_table("tiny", tmp_path)["seeds"].tolist()) == ([2], [1])
    again = attempt(two_runs[0], tmp_path, lambda line: None)
    assert again.outcome in ("refused", "unchecked") and str(folder) in again.message
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    twin = attempt(replace(two_runs[0], experiment="other"), tmp_path, lambda line: None)
    assert twin.outcome == "finished", "made, not taken from the damaged one"


def test_folders_that_are_no_runs_are_named(tmp_path, tiny_experiment, two_runs):
    folder = two_runs[0].folder(tmp_path)
    shutil.copytree(folder, folder.with_name("seed0 copy"))
    data = collect(tiny_experiment, tmp_path)
    assert data.notes == ["left out, damaged: SAC/toy/seed0 copy (the folder of a run is called seedN)"]
    assert len(data.tables["evaluations"]) == 2 * 3 * 2


def test_a_diverged_run_is_told_and_no_earlier_step_passed_off(tmp_path, tiny_experiment, two_runs):
    path = two_runs[0].folder(tmp_path) / "evaluations.csv"
    table = pd.read_csv(path)
    table.loc[table.index[-1], "return"] = np.nan
    table.to_csv(path, index=False, na_rep="nan", lineterminator="\r\n")
    assert collect(tiny_experiment, tmp_path).notes == ["returns that are no numbers, at which curves end: SAC/toy/seed0"]
    row = summary_table("tiny", tmp_path).iloc[0]
    scores = pd.concat([pd.read_csv(spec.folder(tmp_path) / "evaluations.csv") for spec in two_runs]).query("step == 60")
    assert row["step"] == 60 and row["return"].startswith(f"{scores['return'].mean():.2f} [")
    assert row["success_once"].startswith(f"{scores['success_once'].mean():.2f} [")


def test_one_seed_has_no_interval(tmp_path, tiny_experiment, two_runs):
    both = summary_table("tiny", tmp_path).iloc[0]
    shutil.rmtree(two_runs[0].folder(tmp_path))
    one = summary_table("tiny", tmp_path).iloc[0]
    assert (both["seeds"], one["seeds"]) == (2, 1)
    assert "[" in both["return"] and one["return"] == f"{float(one['return']):.2f}"


def test_mixed_code_and_pytorch_are_noted(tmp_path, tiny_experiment, two_runs):
    config = two_runs[0].folder(tmp_path) / "config.yml"
    content = yaml.safe_load(config.read_text())
    config.write_text(yaml.safe_dump({**content, "code": "older", "versions": {**content["versions"], "torch": "2.0"}}))
    code, torch = collect(tiny_experiment, tmp_path).notes
    assert "several states of its code are mixed" in code and "older: 1 runs" in code
    assert "several versions of PyTorch are mixed" in torch and "2.0: 1 runs" in torch
    made = attempt(replace(two_runs[0], experiment="other"), tmp_path, lambda line: None)
    assert made.outcome == "finished", "not taken from a run of older code"


def test_crashed_runs_are_not_just_unfinished(tmp_path, tiny_experiment, monkeypatch, two_runs):
    third = list(tiny_experiment.runs(seeds=3, agents=["SAC"]))[2]
    unbroken = kill_at(monkeypatch, 100)
    with pytest.raises(Killed):
        perform(third, tmp_path)
    unbroken()
    assert collect(tiny_experiment, tmp_path).notes == [
        "not finished yet, and drawn as far as they came: SAC/toy/seed2 (at step 60 of 120)"
    ]
    fourth = third.folder(tmp_path).with_name("seed3")
    fourth.mkdir()
    for folder in (third.folder(tmp_path), fourth):  # the last before it began: there is nothing to draw of it
        (folder / "crashed.txt").write_text("Traceback")
    assert collect(tiny_experiment, tmp_path).notes == [
        "crashed, and drawn as far as they came: SAC/toy/seed2 (at step 60 of 120)"
    ]


@pytest.mark.parametrize("damage", ["shorter", "edited", "gone", "settings", "state", "model", "pickles"])
def test_a_damaged_unfinished_run_does_not_go_on(tmp_path, monkeypatch, damage):
    spec = make_spec()
    unbroken = kill_at(monkeypatch, 190)
    with pytest.raises(Killed):
        perform(spec, tmp_path)
    unbroken()
    folder = spec.folder(tmp_path)
    tables = csv_files(folder)
    if damage == "shorter":
        cut("evaluations.csv", 0, 2)(folder)
    elif damage == "state":
        overwrite("checkpoint/state.npz", lambda content: content[:-20])(folder)
    elif damage == "edited":
        overwrite("training.csv", lambda text: text.replace(b"50", b"51", 1))(folder)
    elif damage == "model":
        overwrite("checkpoint/model.zip", lambda content: content[:1000] + b"x" + content[1001:])(folder)
    elif damage == "pickles":
        (folder / "checkpoint/state.npz").rename(folder / "checkpoint/state.pkl")
    else:
        (folder / {"gone": "evaluations.csv", "settings": "config.yml"}[damage]).unlink()
    again = attempt(spec, tmp_path, lambda line: None)
    assert again.outcome == "refused"
    assert str(folder) in again.message and "emove" in again.message
    assert ("earlier sb3_cpm, as pickles" in again.message) == (damage == "pickles")
    left = csv_files(folder)
    if damage == "edited":
        tables.pop("training.csv"), left.pop("training.csv")
    assert all(tables[name].startswith(text) for name, text in left.items()), "nothing was added or overwritten"
    assert len(left) == len(tables) - (damage == "gone") and not (folder / "crashed.txt").exists()
    assert not (folder / "finished.yml").exists()


def test_a_file_in_the_way_is_told_before_anything_runs(tmp_path, tiny_experiment, capsys):
    (tmp_path / "file").touch()
    for options in ([], ["--jobs", "0"], ["--draw-only"]):
        assert main(["reproduce", "--figure", "tiny", "--results", str(tmp_path / "file"), *options]) == 1
        assert f"{tmp_path / 'file'} is no folder" in capsys.readouterr().err
    (tmp_path / "tiny").touch()  # where the runs' folders would be: they crash one by one, and it is told
    assert main(["reproduce", "--figure", "tiny", "--results", str(tmp_path), "--jobs", "0", "--seeds", "1"]) == 1
    assert "None of the 2 runs" in capsys.readouterr().err


def test_trials_are_kept_apart(tmp_path, tiny_experiment, capsys):
    """``--steps``: neither results nor figure of the experiment are touched, and it can be run as planned afterwards."""

    def reproduce(*options):
        return main(["reproduce", "--figure", "99", "--seeds", "1", "--jobs", "0", "--results", str(tmp_path), *options])

    figures = tmp_path / "figures"
    assert reproduce("--agents", "SAC") == 0
    before = (figures / "figure_99_tiny.png").read_bytes()
    assert reproduce("--agents", "SAC", "--steps", "60") == 0
    assert (figures / "figure_99_tiny.png").read_bytes() == before
    assert {path.name for path in tmp_path.iterdir()} == {"tiny", "tiny-steps60", "figures"}
    assert reproduce("--agents", "SAC", "--steps", "60", "--draw-only") == 0
    assert summary_table("tiny", tmp_path, "full-steps60")["step"].tolist() == [60]
    assert reproduce("--quick", "--steps", "61", "--agents", "SAC") == 0
    assert {path.name for path in figures.iterdir()} == {
        f"figure_99_tiny{name}.png" for name in ("", "-steps60", "-quick-steps61")
    }
    assert reproduce("--agents", "SAC", "--steps", "120") == 0, "as planned is no trial"
    assert not (tmp_path / "tiny-steps120").exists()
    assert find_data(["tiny"], tmp_path) == {"tiny": "full"}
    capsys.readouterr()
    for steps in ("0", "-5"):
        assert reproduce("--steps", steps) == 1
        assert f"steps={steps}: expected 1 or more; leave it out for the plan's 120" in capsys.readouterr().err
    with pytest.raises(ValueError, match="reproduce --figure tiny --quick --steps 7 --results"):
        draw("tiny", tmp_path, "quick-steps7")
    with pytest.raises(ValueError, match="no version 'full-steps', but: full, quick"):
        draw("tiny", tmp_path, "full-steps")


def test_agents_that_were_run_differently_are_noted(tmp_path, tiny_experiment):
    first, second = tiny_experiment.runs(seeds=1)
    perform(first, tmp_path)
    perform(second, tmp_path)
    assert collect(tiny_experiment, tmp_path).notes == []
    shutil.rmtree(second.folder(tmp_path))
    perform(replace(second, steps=60, eval_episodes=1), tmp_path)
    assert collect(tiny_experiment, tmp_path).notes == [
        "runs with different steps are drawn together (60: CPM; 120: SAC)",
        "runs with different eval_episodes are drawn together (1: CPM; 2: SAC)",
    ]


def test_what_is_there_is_drawn_where_it_cannot_be_checked(tmp_path, tiny_experiment, monkeypatch, capsys):
    command = ["reproduce", "--figure", "tiny", "--seeds", "1", "--jobs", "0", "--results", str(tmp_path)]
    assert main(command) == 0
    (tmp_path / "figures" / "figure_99_tiny.png").unlink()
    slip = tuple(replace(one, overrides={**one.overrides, "gama": 0.9}) for one in tiny_experiment.contenders)
    monkeypatch.setitem(EXPERIMENTS, "tiny", replace(tiny_experiment, contenders=slip))
    assert main(command) == 1
    assert "unchecked: tiny/SAC/toy/seed0" in capsys.readouterr().out
    assert (tmp_path / "figures" / "figure_99_tiny.png").exists() and not list(tmp_path.rglob("crashed.txt"))


def test_figures_of_another_experiments_runs(tmp_path, tiny_experiment, capsys):
    assert ensure_data("tiny", tmp_path, seeds=1) == "quick"
    assert find_data(["mountaincar", "tiny"], tmp_path) == {"tiny": "quick"}
    assert draw("tiny", tmp_path, "quick").axes
    figure = draw("8", tmp_path, source="tiny", version="quick", task="toy")
    epsilon = next(axes for axes in figure.axes if axes.get_title(loc="left").startswith("epsilon"))
    assert [line.get_label() for line in epsilon.lines] == ["CPM (1 seed)"]
    values = epsilon.lines[0].get_ydata()
    assert 0 < values[-1] < values[0] < 1
    with pytest.raises(ValueError, match="no data for 'tiny' on 'toi'"):
        draw("8", tmp_path, source="tiny", version="quick", task="toi")
    assert main(["reproduce", "--figure", "tiny", "--draw-only", "--results", str(tmp_path)]) == 1
    error = capsys.readouterr().err
    assert "no data for 'tiny'" in error and "but there is of the quick version: add --quick to draw that, or make it" in error
    assert not (tmp_path / "figures").exists()
    shutil.move(tmp_path / "tiny-quick", tmp_path / "tiny")
    with pytest.raises(ValueError, match="there is of the full version: leave out --quick to draw that, or make it"):
        draw("tiny", tmp_path, "quick")
    assert ensure_data("tiny", tmp_path) == "full" == find_data(["tiny"], tmp_path)["tiny"]
    with pytest.raises(ValueError, match="tiny has no version 'short', but: full, quick"):
        draw("tiny", tmp_path, "short")


def test_a_crashed_run_is_recorded_and_the_others_go_on(tmp_path, tiny_experiment):
    lines = []
    results = run_experiment("broken", "full", results=tmp_path, jobs=0, seeds=1, tell=lines.append)
    assert [result.outcome for result in results] == ["crashed", "finished"]
    assert "Traceback" in (results[0].folder / "crashed.txt").read_text()
    assert main(["reproduce", "--figure", "broken", "--seeds", "1", "--jobs", "0", "--results", str(tmp_path)]) == 1


@pytest.mark.slow
def test_processes_of_their_own(tmp_path):
    """Two at a time; one is killed from outside."""
    specs = [make_spec(seed=0, steps=80), make_spec(seed=1, steps=10_000_000)]
    script = (
        "import json, sys, pathlib, threading, time, os, signal\n"
        "from sb3_cpm.experiments import grid\nfrom sb3_cpm.experiments.specification import RunSpec\n"
        "specs = [RunSpec(**one) for one in json.loads(sys.argv[1])]\nresults = pathlib.Path(sys.argv[2])\n"
        "pool = grid._Pool(specs, results, 2, print, 'cpu')\n"
        "def kill():\n"
        "    folder = specs[1].folder(results)\n"
        "    while not (folder / 'evaluations.csv').exists() or 0 in pool._running or not pool._running:\n"
        "        time.sleep(0.1)\n"
        "    pool._running[1].kill()\n"
        "threading.Thread(target=kill, daemon=True).start()\n"
        "print([one.outcome for one in pool.run()])\n"
    )
    job = json.dumps([spec.as_dict() for spec in specs])
    done = subprocess.run([sys.executable, "-c", script, job, str(tmp_path)], capture_output=True, text=True, timeout=600)
    assert done.stdout.splitlines()[-1] == "['finished', 'crashed']", done.stdout + done.stderr
    assert "signal 9" in (specs[1].folder(tmp_path) / "crashed.txt").read_text()


def test_runs_end_with_the_process_that_started_them(tmp_path):
    """Killed without a chance to say so; what it leaves can be gone on with."""
    spec = make_spec(steps=10_000_000)
    script = (
        "import json, sys, pathlib\n"
        "from sb3_cpm.experiments.grid import perform_all\nfrom sb3_cpm.experiments.specification import RunSpec\n"
        "perform_all([RunSpec(**json.loads(sys.argv[1]))], pathlib.Path(sys.argv[2]))\n"
    )
    folder = spec.folder(tmp_path)
    with subprocess.Popen([sys.executable, "-c", script, json.dumps(spec.as_dict()), str(tmp_path)]) as grid:
        try:
            wait_until(lambda: (folder / "checkpoint").exists())
            with pytest.raises(LockedError), locked(folder):
                pass
        finally:
            grid.kill()

    def is_free():
        try:
            with locked(folder):
                return True
        except LockedError:
            return False

    wait_until(is_free)


def wait_until(holds, seconds=600):
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.1)


def test_jobs_and_seeds_are_checked(tmp_path):
    with pytest.raises(ValueError, match="jobs=-1"):
        perform_all([], tmp_path, jobs=-1)
    with pytest.raises(ValueError, match="seeds=0"):
        run_experiment("4", seeds=0, results=tmp_path)


# ---------------------------------------------------------------------- names, statistics, catalog


def test_what_only_reads_results_does_without_pytorch():
    """Whose import costs more than drawing a figure."""
    script = "import sys, sb3_cpm.experiments.figures; print({'torch', 'stable_baselines3', 'rl_zoo3'} & {*sys.modules})"
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", script], capture_output=True, text=True, timeout=600)
    assert done.stdout.strip() == "set()", done.stderr


def test_misspelt_names(tmp_path, capsys):
    with pytest.raises(ValueError, match="Did you mean 'mountaincar'"):
        find_experiment("montaincar")
    assert main(["reproduce", "--figure", "12"]) == 1
    assert "figures: 3, 4, 5" in capsys.readouterr().err
    with pytest.raises(ValueError, match=r"make it with `python -m sb3_cpm reproduce --figure mountaincar --quick --results "):
        draw("mountaincar", tmp_path, "quick")
    assert main(["reproduce", "--figure", "mountaincar", "--short", "--results", str(tmp_path)]) == 1
    assert "mountaincar has no version 'short', but: full, quick." in capsys.readouterr().err and not list(tmp_path.iterdir())
    assert main(["reproduce", "--list"]) == 0
    assert "five-agents-training" in capsys.readouterr().out


def test_what_is_chosen_by_is_not_what_is_reported():
    """The runs that compare constants have seeds and evaluation episodes of their own."""
    chosen, reported = (list(EXPERIMENTS[name].runs()) for name in ("pickcube-parts", "pickcube-state"))
    assert not {spec.seed for spec in chosen} & {spec.seed for spec in reported}
    (first,), (other,) = ({spec.eval_seed for spec in specs} for specs in (chosen, reported))
    assert first >= other + 1000  # more than there are evaluation episodes


def test_evaluation_episodes_of_other_seeds_are_another_protocol(tmp_path):
    spec = make_spec(steps=80)
    perform(spec, tmp_path)
    with pytest.raises(ValueError, match="eval_seed: there None, here 2000000"):
        perform(replace(spec, eval_seed=2_000_000), tmp_path)
    perform(replace(spec, eval_seed=2_000_000), tmp_path / "other")
    first, other = (pd.read_csv(spec.folder(folder) / "evaluations.csv") for folder in (tmp_path, tmp_path / "other"))
    assert (first["step"] == other["step"]).all() and (first["return"] != other["return"]).any()


def test_some_agents_and_tasks_only(tmp_path, capsys):
    experiment = EXPERIMENTS["pickcube-state"]
    specs = list(experiment.runs(agents=["SAC+HER", "SAC"], tasks=["PickCubeState-v1-pd_ee_delta_pos"], seeds=1))
    assert [spec.agent for spec in specs] == ["SAC", "SAC+HER"] and {spec.env for spec in specs} == {specs[0].env}
    with pytest.raises(ValueError, match=r"no agent 'CPM_SAC' in this experiment. Did you mean 'CPM-SAC'\? Valid: SAC, CPM"):
        run_experiment("pickcube-state", agents=["CPM_SAC"], results=tmp_path)
    for options in ([], ["--draw-only"]):
        assert main(["reproduce", "--figure", "pickcube-state", "--agents", "SCA", "--results", str(tmp_path), *options]) == 1
        assert "Did you mean 'SAC'?" in capsys.readouterr().err
    assert main(["reproduce", "--figure", "pickcube-state", "--tasks", "PickCube", "--results", str(tmp_path)]) == 1
    assert "no task 'PickCube'" in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_short_versions_are_on_the_robot():
    short = {name: experiment.short for name, experiment in EXPERIMENTS.items() if experiment.short}
    assert {EXPERIMENTS[name].figure for name in short} == {"", *(str(number) for number in range(3, 12))}
    for name, plan in short.items():
        full = EXPERIMENTS[name].full
        assert all(task in full.tasks for task in plan.tasks) and plan.steps < full.steps
        assert EXPERIMENTS[name].folder_name("short").endswith("-short")


def test_figures_by_number():
    assert find_experiment("4").name == find_experiment("figure4").name == find_experiment("Figure 4").name == "five-agents"
    assert find_experiment("B.3").name == "controllers" and find_experiment("b.4").name == "decays"


@pytest.mark.parametrize("name, version", [(name, version) for name, one in EXPERIMENTS.items() for version in one.plans])
def test_every_planned_run_has_valid_hyperparameters(name, version):
    experiment = EXPERIMENTS[name]
    specs = list(experiment.runs(version))
    assert len({spec.name for spec in specs}) == len(specs)
    for spec in specs:
        if spec.seed == experiment.plan(version).first_seed:
            load_agent(spec.config, spec.env_id, spec.overrides)
    if experiment.source:
        of_source = {(spec.agent, spec.env) for spec in EXPERIMENTS[experiment.source].runs(version)}
        assert {(spec.agent, spec.env) for spec in specs} <= of_source


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_agent_has_a_colour_of_its_own(name):
    assert len(set(COLOURS)) == len(COLOURS) >= len(EXPERIMENTS[name].contenders)
    lines = draw_lines(EXPERIMENTS[name])
    assert len(set(lines)) == len(EXPERIMENTS[name].contenders)


@pytest.mark.parametrize("width", [5, 10, 15])
def test_titles_fit_into_their_figures(width):
    """matplotlib cuts off what is too long, on both sides."""
    for experiment in EXPERIMENTS.values():
        figure = plt.figure(figsize=(width, 4), layout="constrained")
        write_title(figure, f"Figure 9: {experiment.title}\nruns of five-agents, short version, on PickCube-v1")
        extent = figure._suptitle.get_window_extent()
        assert extent.x0 >= 0 and extent.x1 <= figure.bbox.width
        plt.close(figure)


def test_the_legend_has_every_agent_once():
    """Of one task there may be more seeds than of another."""
    seeds = {"SAC": (2, 1), "CPM-SAC": (1, 1)}
    rows = [
        {"agent": agent, "env": task, "seed": seed, "step": step, **dict.fromkeys(SCORES, 0.5)}
        for agent, numbers in seeds.items()
        for task, number in zip(("one", "other"), numbers, strict=True)
        for seed in range(number)
        for step in (0, 9)
    ]
    figure = DRAWINGS["curves"](EXPERIMENTS["pickcube-state"], Data({"evaluations": pd.DataFrame(rows)}, []))
    plt.close(figure)
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["SAC (1 to 2 seeds)", "CPM-SAC (1 seed)"]


def draw_lines(experiment):
    """The colours of a figure in which every agent has data."""
    names = [contender.name for contender in experiment.contenders]
    rows = [
        {"agent": name, "env": "task", "seed": 0, "step": step, **dict.fromkeys(SCORES, 0.5)}
        for name in names
        for step in (0, 9)
    ]
    figure = DRAWINGS["curves"](experiment, Data({"evaluations": pd.DataFrame(rows)}, []))
    plt.close(figure)
    return [line.get_color() for line in figure.axes[0].lines]


def test_estimate_is_interquartile_and_covers():
    generator = np.random.default_rng(0)
    scores = pd.DataFrame(generator.normal(3.0, 1.0, (2, 12)), index=[0, 100])
    scores.iloc[0, 0] = 1000.0  # an outlier that a mean would follow
    result = estimate(scores, repetitions=300)
    assert result.n_seeds == 12 and result.steps.tolist() == [0, 100]
    expected = [np.sort(row)[3:9].mean() for row in scores.to_numpy()]
    assert np.allclose(result.iqm, expected)
    assert (result.low < result.iqm).all() and (result.iqm < result.high).all() and result.high[0] < 10
    state = np.random.get_state()[1].copy()
    again = estimate(scores, repetitions=300)
    assert np.array_equal(again.low, result.low) and np.array_equal(np.random.get_state()[1], state)


def test_scores_are_of_steps_that_all_seeds_have():
    table = pd.DataFrame({"seed": [0, 0, 0, 1], "step": [0, 0, 10, 0], "return": [1.0, 3.0, 5.0, 4.0]})
    scores = per_seed(table, "return")
    assert scores.index.tolist() == [0] and scores.loc[0].tolist() == [2.0, 4.0]
    assert binned(pd.DataFrame({"step": [0, 1, 5, 10]}), 2)["step"].tolist() == [5, 5, 5, 10]
