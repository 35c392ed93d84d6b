"""The command line."""

from pathlib import Path

import pytest

from sb3_cpm import __main__ as cli
from sb3_cpm import __version__
from sb3_cpm.run.settings import TrainSettings, field_documentation

GIVEN = "What is given on top of cpm_sac.yml, CPMToy-v0"


def settings_of(*arguments: str) -> TrainSettings:
    options = vars(cli.make_parser().parse_args(["train", *arguments]))
    options.pop("command")
    return TrainSettings(**options)


def test_defaults_are_those_of_the_settings() -> None:
    assert settings_of() == TrainSettings()


def test_every_kind_of_option() -> None:
    settings = settings_of(
        *("--env", "CPMToy-v0", "--steps", "12", "--tau", "0.5", "--unit", "episode", "--no-video", "--progress-bar"),
        *("--env-kwargs", "keys=[state, camera]", "n_points=3", "--env-kwargs", "task=push"),
    )
    assert (settings.env, settings.steps, settings.tau, settings.unit) == ("CPMToy-v0", 12, 0.5, "episode")
    assert (settings.video, settings.progress_bar) == (False, True)
    assert settings.env_kwargs == {"keys": ["state", "camera"], "n_points": 3, "task": "push"}
    assert settings_of().env_kwargs == {}, "options of one call don't leak into the next"


def test_help_explains_everything(capsys: pytest.CaptureFixture[str]) -> None:
    assert set(field_documentation()) == set(TrainSettings().as_dict())
    for arguments in (["--help"], ["train", "--help"], ["setup-rendering", "--help"], ["--version"]):
        with pytest.raises(SystemExit) as stop:
            cli.main(arguments)
        assert stop.value.code == 0
    text = capsys.readouterr().out
    assert "--challenge-ratio" in text and "doctor" in text and "CPMToy-v0" in text
    assert ":func:" not in text and "``" not in text
    assert __version__ in text


@pytest.mark.parametrize("arguments", [["fly"], ["train", "--env-kwargs", "x"], ["train", "--env-kwargs", "x=[1"]])
def test_wrong_command_lines(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(arguments)
    assert stop.value.code == 2
    assert "error" in capsys.readouterr().err


def test_without_arguments_it_shows_what_there_is(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main([]) == 0
    text = capsys.readouterr().out
    assert len(text.splitlines()) <= 24 and max(map(len, text.splitlines())) <= 120
    commands = cli.make_parser()._subparsers._group_actions[0].choices  # type: ignore[union-attr]
    shown = {line.split()[3] for line in text.splitlines() if line.startswith("  python -m sb3_cpm")}
    assert shown <= set(commands) and {"demo", "train", "reproduce", "doctor"} <= shown
    assert "cpm_rlpd_quick" in text and "quickstart.md" in text


def test_errors_of_the_user_have_no_traceback(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    full = tmp_path / "full"
    full.mkdir()
    (full / "notes.txt").touch()
    assert cli.main(["train", "--env", "CPMToy-v0", "--run-folder", str(full)]) == 1
    assert capsys.readouterr().err.startswith("error: The run folder")
    assert [path.name for path in full.iterdir()] == ["notes.txt"]


@pytest.mark.parametrize(
    "options, told",
    [
        (["--seed", "-1"], "seed=-1: expected 0 or more"),
        (["--model-kwargs", "learning_ratee=1"], f"{GIVEN}: unknown key 'learning_ratee'. Did you mean 'learning_rate'?"),
        (
            ["--model-kwargs", "policy_kwargs={net_arc: [4]}"],
            f"{GIVEN}, policy_kwargs: unknown key 'net_arc'. Did you mean 'net_arch'?",
        ),
        (["--env-kwargs", "keyss=[state]"], f"{GIVEN}, env_kwargs: unknown key 'keyss'. Did you mean 'keys'?"),
        (["--buffer-kwargs", "mixx=row"], f"{GIVEN}, replay_buffer_kwargs: unknown key 'mixx'. Did you mean 'mix'?"),
        (
            ["--buffer-kwargs", "filter_kwargs={widht: 1}"],
            f"{GIVEN}, replay_buffer_kwargs: filter_kwargs: unknown key 'widht'",
        ),
        (
            ["--callback-kwargs", "train_frek=1"],
            f"{GIVEN}, callback sb3_cpm.ChallengerCallback: unknown key 'train_frek'. Did you mean 'train_freq'?",
        ),
        (
            ["--callback-kwargs", "uncertainty_kwargs={metrik: log}"],
            f"{GIVEN}, callback sb3_cpm.ChallengerCallback: uncertainty_kwargs: unknown key 'metrik'. Did you mean 'metric'?",
        ),
        (["--steps", "40"], "steps=40 is no longer than learning_starts=200"),
        (["--agent", "cpm_sacc"], "Unknown agent 'cpm_sacc'. Did you mean 'cpm_sac'?"),
        (["--env", "CPMTroy-v0"], "Unknown environment 'CPMTroy-v0'. Did you mean 'CPMToy-v0'?"),
        (["--device", "cuda:7"], "device='cuda:7' cannot be used here"),
        (["--resume", "runs/none"], "resume='runs/none' goes on with that run as it is, but env, evaluations came with it"),
    ],
)
def test_slips_are_told_and_leave_nothing(
    options: list[str], told: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert cli.main(["train", "--env", "CPMToy-v0", "--evaluations", "0", "--no-video", *options]) == 1
    assert capsys.readouterr().err.startswith(f"error: {told}")
    assert not list(tmp_path.glob("runs/*"))


def test_train_and_ctrl_c(monkeypatch: pytest.MonkeyPatch) -> None:
    trained = []

    def interrupted(settings: TrainSettings) -> None:
        trained.append(settings)
        raise KeyboardInterrupt

    monkeypatch.setattr("sb3_cpm.run.training.train", interrupted)
    assert cli.main(["train", "--seed", "7"]) == 130
    assert trained[0].seed == 7


def test_doctor_and_rendering_are_called(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sb3_cpm.machine.doctor.run_doctor", lambda: 3)
    monkeypatch.setattr("sb3_cpm.machine.rendering.setup_rendering", lambda private, system: 4 + private + 2 * system)
    assert cli.main(["doctor"]) == 3
    assert cli.main(["setup-rendering"]) == 4
    assert cli.main(["setup-rendering", "--private"]) == 5
    assert cli.main(["setup-rendering", "--system"]) == 6
