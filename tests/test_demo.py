"""The two-minute demo, shortened; its claim is that of ``results/exploration``."""

import json
import re
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest

from sb3_cpm.__main__ import main
from sb3_cpm.run.demo import AGENTS, GOAL, Shown, demo, draw


@pytest.mark.slow
def test_the_command_trains_both_and_leaves_a_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["demo", "--folder", str(tmp_path / "demo"), "--steps", "1050", "--seed", "3"]) == 0
    said = capsys.readouterr().out
    for name in AGENTS:
        assert re.search(rf"^{re.escape(name)}: (never )?reached the goal.*episodes", said, re.MULTILINE), said
    assert said.endswith(f"Drawn: {tmp_path / 'demo' / 'demo.png'}\n")
    numbers = json.loads((tmp_path / "demo" / "demo.json").read_text())
    assert numbers["steps"] == 1050 and [one["name"] for one in numbers["agents"]] == list(AGENTS)
    assert imageio.imread(tmp_path / "demo" / "demo.png").shape[1] > 1000


def test_the_picture_shows_where_they_were(tmp_path: Path) -> None:
    generator = np.random.default_rng(0)
    near = generator.uniform((-0.6, -0.01), (-0.4, 0.01), (500, 2))
    far = generator.uniform((-1.2, -0.07), (0.6, 0.07), (500, 2))
    pictures = []
    for states, goals in ((near, []), (far, [7, 90])):
        draw([Shown("one", states, goals, float(bool(goals)), 0.0, 1.0)], tmp_path / "demo.png")
        pictures.append(np.ptp(imageio.imread(tmp_path / "demo.png")[..., :3], axis=2) > 60)  # coloured
    columns = [len(np.unique(coloured.nonzero()[1])) for coloured in pictures]
    assert far[:, 0].max() > GOAL and columns[1] > 1.5 * columns[0]


@pytest.mark.parametrize("wrong, message", [({"steps": 0}, "steps must be"), ({"seed": -1}, "seed")])
def test_bad_input(wrong: dict[str, int], message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        demo(tmp_path / "demo", **wrong)
    assert not (tmp_path / "demo").exists()
